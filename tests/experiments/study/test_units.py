"""A unit's folder is found again by later versions, whatever the default arm is."""

from __future__ import annotations

from sauna.experiments.study.command import comparison
from sauna.experiments.study.units import units_of


def test_units_of_0_1_0_are_found_again() -> None:
    """These names are of 0.1.0: a change of theirs trains everything again."""
    units = units_of(comparison("Hopper-v5", ("ppo", "sauna"), {"seeds": (0, 1)}), 3)
    assert [unit.name for unit in units] == [
        "Hopper-v5_ppo_0-1_195da775dc",
        "Hopper-v5_sauna_0-1_27087347b1",
    ]
