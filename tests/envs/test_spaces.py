"""Spaces are compared by what a learner sees of them, however they are printed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces as gym

import sauna
from helpers import SMALL
from sauna.envs.spaces import Spaces, describe, difference, read_spaces
from sauna.system import run_directory
from sauna.system.errors import BadInput

ACTION = gym.Box(-1.0, 1.0, (2,), np.float32)
PARTS = {"a": gym.Box(0, 1, (2,)), "b": gym.Discrete(3)}


def of(observation: gym.Space, action: gym.Space = ACTION) -> Spaces:
    return describe(observation, action)


def stored(spaces: Spaces) -> Spaces:
    return read_spaces(json.loads(json.dumps(list(spaces))))


@pytest.mark.parametrize("space", [gym.Box(0, 1, (4,)), gym.Discrete(4), gym.Dict(PARTS)])
def test_what_was_stored_is_the_same(space: gym.Space) -> None:
    assert stored(of(space)) == of(space) and difference(stored(of(space)), of(space)) == ""


def test_how_numpy_prints_is_no_part_of_it() -> None:
    box = gym.Box(np.array([0.123456789, 1.0]), np.array([1.5, 2.0]), dtype=np.float64)
    before = of(box)
    with np.printoptions(precision=2, floatmode="fixed", threshold=1):
        assert difference(stored(before), of(box)) == ""


def test_bounds_and_types_that_are_not_read_are_no_part_of_it() -> None:
    before = of(gym.Box(-1, 1, (3,), np.float32))
    assert difference(before, of(gym.Box(-np.inf, 5, (3,), np.float64))) == ""
    assert difference(of(gym.Discrete(3)), of(gym.Discrete(3, start=5))) == ""


def test_the_part_that_differs_is_named() -> None:
    box = of(gym.Box(0, 1, (3,)))
    assert difference(box, of(gym.Box(0, 1, (4,)))) == "observation shape (3,) instead of (4,)"
    assert "observation kind" in difference(box, of(gym.Discrete(3)))
    wide = of(gym.Box(0, 1, (3,)), gym.Box(-1, 1, (5,)))
    assert difference(box, wide) == "action sizes (2,) instead of (5,)"
    renamed = of(gym.Dict({"a": gym.Box(0, 1, (2,)), "c": gym.Discrete(3)}))
    swapped = of(gym.Dict({"a": gym.Discrete(3), "b": gym.Box(0, 1, (2,))}))
    for other in (renamed, swapped):  # as long, but their numbers mean something else
        assert difference(of(gym.Dict(PARTS)), other).startswith("observation structure")


@pytest.mark.parametrize(
    "values", [[], ["vector", [9]], ["vector", [-1], "continuous", [2], "", ""], [1, 2, 3, 4, 5, 6]]
)
def test_what_is_no_space_is_refused(values: list) -> None:
    with pytest.raises((TypeError, ValueError)):
        read_spaces(values)


def test_a_run_resumes_under_other_print_options_and_a_run_of_before_too(tmp_path: Path) -> None:
    run = tmp_path / "run"
    sauna.train("small_envs:Scripted", out=run, quiet=True, checkpoint_every=2, **SMALL)
    (run / "summary.json").unlink()
    kept = run_directory.read_config(run)
    before = ["Box(-inf, inf, (3,), float64)", "Box(-1.0, 1.0, (2,), float32)"]
    run_directory.write_config(run, {**kept, "spaces": [*kept["spaces"][:4], *before]})
    with np.printoptions(precision=1, sign="+"):
        sauna.resume(run, quiet=True)
    run_directory.write_config(run, {**kept, "spaces": ["vector", [7], *kept["spaces"][2:]]})
    (run / "summary.json").unlink()
    with pytest.raises(BadInput, match=r"observation shape \(3,\) instead of \(7,\)"):
        sauna.resume(run, quiet=True)
