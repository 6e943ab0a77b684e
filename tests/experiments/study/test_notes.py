"""What is known of a study before it is trained is said before."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from sauna.config.checks import budget_note
from sauna.config.presets import resolve
from sauna.experiments.statistics import compare, least_seeds
from sauna.experiments.study.cells import Cell
from sauna.experiments.study.command import comparison
from sauna.experiments.study.execute.unit_process import LineDisplay
from sauna.experiments.study.notes import before_training
from sauna.experiments.study.spec import Spec
from sauna.experiments.study.verdicts import least_of

SIX = tuple(range(6))
ARMS = ("ppo", "vex-head", "sauna+random", "sauna")


def few_seeds(spec: Spec) -> list[str]:
    return [note for note in before_training(spec) if "seeds" in note]


@pytest.mark.parametrize("arms", [ARMS, ("ppo", "sauna")])
def test_a_comparison_of_too_few_seeds_is_named_underpowered(arms: tuple[str, ...]) -> None:
    needed = least_seeds(len(arms) - 1)
    for number in range(2, needed + 2):
        spec = comparison("x", arms, {"seeds": tuple(range(number))})
        said = few_seeds(spec)
        assert bool(said) == (number < needed)
        assert all(f"--seeds {needed}" in line and "too few seeds" in line for line in said)


def test_the_number_of_seeds_is_that_of_the_sentences() -> None:
    """One rule and its control are two families of one test each, and one ablation."""
    arms = ("ppo", "top-advantage", "top-advantage+random")
    (said,) = few_seeds(comparison("x", arms, {"seeds": (0, 1, 2)}))
    assert least_seeds(1) == 4 < least_seeds(2) and said.endswith("--seeds 4")
    cells = [Cell("x", arm, arm, "ppo" if arm != "ppo" else None, [], 0, 0, 0) for arm in arms]
    assert least_of(cells) == 4
    assert least_of([*cells, cells[1]._replace(label="other", arm="gigaflow")]) == 5


def test_it_says_so_exactly_when_no_result_could_be_found() -> None:
    """An oracle: even scores that are all above the baseline's give no verdict."""
    for number in (3, 4, 5):
        above = {str(arm): (np.arange(number) + 100.0, np.arange(number) * 1.0) for arm in range(3)}
        kinds = {found.kind for found in compare(above).values()}
        spec = comparison("x", ARMS, {"seeds": tuple(range(number))})
        assert (kinds == {"underpowered"}) == bool(few_seeds(spec))


def test_many_seeds_may_have_been_one_seed() -> None:
    said = before_training(comparison("x", ("ppo", "sauna"), {"seeds": tuple(range(42))}))
    assert said[0] == "note: 42 seeds, 0 to 41; for the one seed 42 write --seed 42"


def test_the_preset_and_what_a_small_budget_trains_are_said() -> None:
    def said(env: str, **settings: object) -> list[str]:
        return before_training(
            comparison(env, ("ppo", "top-advantage"), {"seeds": SIX, **settings})
        )

    assert said("CartPole-v1", steps=6000) == [
        "note: 4,096 of 6,000 env steps are trained, in 2 updates: a rollout has 2,048 steps, "
        "which --rollout-steps changes",
        "note: no preset is named: mujoco is taken; preset auto is cartpole for CartPole-v1",
    ]
    (note,) = said("Hopper-v5")
    assert note.endswith("mujoco is taken, with 1,000,000 env steps, as for Hopper-v5 in the zoo")
    assert said("x") == ["note: no preset is named: mujoco is taken, with 1,000,000 env steps"]
    assert said("x", preset="mujoco", steps=100_000) == [], "1,696 steps are 2% of them"


@pytest.mark.parametrize(
    "steps, text",
    [(2048, "all 2,048 env steps are trained, in 1 update:"), (20_480, ""), (22_500, "20,480 of")],
)
def test_leftover_steps_are_named_from_a_twentieth_of_the_budget(steps: int, text: str) -> None:
    note = budget_note(resolve({"env": "x", "steps": steps}))
    assert text in note if text else note == ""
    assert budget_note(resolve({"env": "x", "steps": steps, "arm": "sauna"})) == ""


def test_a_unit_repeats_no_note_of_its_study() -> None:
    out = io.StringIO()
    LineDisplay(out).say("note: as the study said")
    LineDisplay(out).say("warning: of this run")
    assert [json.loads(line) for line in out.getvalue().splitlines()] == [
        {"said": "warning: of this run"}
    ]
