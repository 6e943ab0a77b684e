"""A unit's folder is found again by later versions, whatever the default arm is."""

from __future__ import annotations

import pytest

from sauna.experiments.study import units
from sauna.experiments.study.command import comparison
from sauna.experiments.study.spec import load_spec
from sauna.experiments.study.units import units_of


def test_units_of_0_1_0_are_found_again() -> None:
    """These names are of 0.1.0: a change of theirs trains everything again."""
    found = units_of(comparison("Hopper-v5", ("ppo", "sauna"), {"seeds": (0, 1)}), 3)
    assert [unit.name for unit in found] == [
        "Hopper-v5_ppo_0-1_195da775dc",
        "Hopper-v5_sauna_0-1_27087347b1",
    ]


def names(study: str, task: str) -> dict[str, str]:
    """The names of a stored study's first three seeds on one task, by their label."""
    found = units_of(load_spec(study), 3)
    return {unit.label: unit.name for unit in found if unit.task == task and unit.seeds[0] == 0}


def test_a_rule_that_has_changed_is_trained_again_and_no_other() -> None:
    """These names are of before any rule had a revision. Rules that have one have left theirs."""
    hopper = names("selection-screen-mujoco", "Hopper-v5")
    before = {
        "ppo": "6820db2f56",
        "sauna": "ae9ba3f51f",
        "sauna+random": "695daedc35",
        "gigaflow": "826c2fcec2",
        "gigaflow+random": "a0f7643db0",
        "top-advantage": "35248df117",
        "gradient-norm": "a08f0aaf5b",
        "delight": "cdfdf03a27",
        "prioritized+random": "ff981e1cf0",  # draws evenly and without a weight
        "pods": "0e3b2d5747",  # 64 steps fit into its rollouts of 2048
    }
    assert {label: hopper[label].split("_")[-1] for label in before} == before
    former = {
        "kondo": "839e6bcfda",
        "kondo+random": "e619495812",
        "prioritized": "bc42554358",
        "vex-oracle": "974a703653",
        "vex-oracle+random": "eb6cbd22d6",
    }
    assert all(hopper[label] != f"Hopper-v5_{label}_0-2_{name}" for label, name in former.items())
    cartpole = names("selection-screen-cartpole", "CartPole-v1")
    assert cartpole["ppo"] == "CartPole-v1_ppo_0-2_c6ddb692ea"
    assert cartpole["pods"] != "CartPole-v1_pods_0-2_a3b6ff23fe"  # rollouts of 32 steps


def test_a_revision_makes_another_name(monkeypatch: pytest.MonkeyPatch) -> None:
    before = names("selection-screen-mujoco", "Hopper-v5")
    monkeypatch.setitem(units.REVISIONS, "gigaflow", 1)
    after = names("selection-screen-mujoco", "Hopper-v5")
    assert {label for label in before if before[label] != after[label]} == {
        "gigaflow",
        "gigaflow+random",
    }
