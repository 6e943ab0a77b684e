"""Preset `auto` in comparisons and studies: only if it is named, and each task has its own."""

from __future__ import annotations

import pytest

from sauna.config.presets import COMPARED
from sauna.experiments.study.command import comparison
from sauna.experiments.study.notes import before_training
from sauna.experiments.study.spec import check, read_spec
from sauna.experiments.study.units import identity, study_identity
from sauna.system.errors import BadInput

TASKS = ["CartPole-v1", "LunarLander-v3", "Hopper-v5"]


def study(**values: object) -> dict[str, object]:
    return {"tasks": TASKS, "seeds": 6, "arms": [{"label": "ppo"}, {"label": "sauna"}], **values}


def test_each_task_has_its_own_preset_and_env_steps() -> None:
    spec = read_spec(study(preset="auto"))
    for arm in spec.arms:
        found = [(c.preset, c.steps) for c in (check(arm, task) for task in TASKS)]
        assert found == [("cartpole", 100_000), ("lunar-lander", 1_000_000), ("mujoco", 1_000_000)]
    notes = before_training(spec)
    assert notes[0] == "preset cartpole for CartPole-v1 (RL Zoo's numbers), 100,000 env steps"
    assert len([note for note in notes if note.startswith("preset")]) == 3
    with_steps = read_spec(study(preset="auto", steps=200_000))
    assert {check(arm, task).steps for arm in with_steps.arms for task in TASKS} == {200_000}


def test_without_auto_nothing_is_picked() -> None:
    spec = read_spec(study())
    assert {check(arm, task).preset for arm in spec.arms for task in TASKS} == {"mujoco"}
    assert not [note for note in before_training(spec) if note.startswith("preset")]
    named = read_spec(study(preset="mujoco"))
    assert (
        study_identity(spec)
        == study_identity(named)
        != study_identity(read_spec(study(preset="auto")))
    )


def test_auto_names_the_runs_as_the_preset_itself_does() -> None:
    """So that a run of one is found by the other, and MuJoCo tasks keep their names."""
    auto, named, plain = (
        read_spec(study(tasks=[task], **more)).arms[0]
        for task, more in (
            ("LunarLander-v3", {"preset": "auto"}),
            ("LunarLander-v3", {"preset": "lunar-lander"}),
            ("Hopper-v5", {}),
        )
    )
    assert identity(auto, "LunarLander-v3", (0,)) == identity(named, "LunarLander-v3", (0,))
    hopper = read_spec(study(tasks=["Hopper-v5"], preset="auto")).arms[0]
    assert identity(hopper, "Hopper-v5", (0,)) == identity(plain, "Hopper-v5", (0,))


def test_a_comparison_takes_auto_too() -> None:
    spec = comparison("LunarLander-v3", COMPARED, {"preset": "auto"})
    assert {check(arm, "LunarLander-v3").preset for arm in spec.arms} == {"lunar-lander"}
    with pytest.raises(BadInput, match="the zoo knows no small_envs:Scripted"):
        comparison("small_envs:Scripted", COMPARED, {"preset": "auto"})
