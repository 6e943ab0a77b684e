"""What a message suggests to somebody who meant something else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import sauna
from sauna.config.other_names import flag_hint, spread_hint
from sauna.config.presets import ARMS
from sauna.config.settings import FIELDS, flag, parse
from sauna.envs.make import env_maker
from sauna.system.errors import BadInput, nearest

FLAGS = ["-h", *map(flag, FIELDS)]


def test_what_shares_little_is_not_suggested() -> None:
    assert flag_hint("--dry-run", FLAGS, "train") == ""
    assert flag_hint("--treshold=1", FLAGS, "train") == "; did you mean '--threshold'?"
    assert nearest("notebook", FIELDS) == ""


def test_capitals_are_no_difference() -> None:
    assert nearest("PPO", ARMS) == "; did you mean 'ppo'?"
    assert nearest("SAUNA", ARMS) == "; did you mean 'sauna'?"
    assert nearest("hopper-V5", ["Hopper-v4", "Hopper-v5"]) == "; did you mean 'Hopper-v5'?"


@pytest.mark.parametrize(
    "typed, unknown, said",
    [
        ("train E --seeds 0 1 2 --steps 9", "1", "separated by commas: --seeds 0,1,2"),
        ("train E --hidden 64 64", "64", "separated by commas: --hidden 64,64"),
        ("compare E --arms ppo sauna", "sauna", "separated by commas: --arms ppo,sauna"),
        ("train E --steps 9 1", "1", ""),
        ("train E F", "F", ""),
        ("train E --seed-s 0 1", "--seed-s", ""),
    ],
)
def test_values_of_a_list_that_are_spread_over_arguments(
    typed: str, unknown: str, said: str
) -> None:
    hint = spread_hint(typed.split(), unknown)
    assert said in hint and bool(said) == bool(hint)


@pytest.mark.parametrize(
    "name, value, said",
    [
        ("learning_rate", lambda left: left, "number; over the training learning_rate_schedule"),
        ("value_coef", lambda left: left, "a number; it does not change over the training"),
        ("seeds", "0-2", r"a count \(6 are the seeds 0 to 5\) or the seeds themselves \(0,1,2\)"),
        ("seeds", "first", "or the seeds themselves"),
        ("steps", "many", "a whole number$"),
    ],
)
def test_what_a_value_must_be(name: str, value: object, said: str) -> None:
    with pytest.raises(BadInput, match=f"{name}: cannot read .* as .*{said}"):
        parse(name, value)


def test_a_class_behind_a_dot_is_written_with_a_colon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("point_goal.py").write_text("raise SystemExit('nothing is imported')\n")
    with pytest.raises(BadInput, match=r"written 'point_goal:PointGoal'$"):
        env_maker("point_goal.PointGoal", {})
    with pytest.raises(BadInput, match=r"'not_here_at_all.PointGoal'$"):
        env_maker("not_here_at_all.PointGoal", {})


def test_the_package_shows_its_names_and_its_functions_their_settings() -> None:
    assert set(sauna.__all__) <= set(dir(sauna))
    for function in (sauna.train, sauna.compare):
        listed = {line.split(":")[0].strip() for line in (function.__doc__ or "").splitlines()}
        assert {"steps", "learning_rate", "threshold"} <= listed
    assert "drop_rate" in (sauna.train.__doc__ or "")


def test_to_look_at_the_names_imports_no_jax() -> None:
    code = "import sauna, sys; dir(sauna); print('jax' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
