"""What is said of arms at equal compute, and of what nothing is said."""

from __future__ import annotations

from typing import Any

from sauna.experiments.study.cells import Cell
from sauna.experiments.study.equal_compute import compute_verdicts

X = [0.0, 50.0, 100.0]


def cell(label: str, *seeds: list[float], baseline: str | None = "ppo") -> Cell:
    members: list[dict[str, Any]] = [
        {"curve": {"samples_backward": X, "return_mean": seed}} for seed in seeds
    ]
    return Cell("A-v0", label, label, baseline, members, 0, 0, 0)


def said(*cells: Cell) -> list[str]:
    return [verdict["text"] for verdict in compute_verdicts(cells)]


BASE = cell("ppo", [0.0, 5.0, 10.0], [0.0, 5.0, 11.0], [0.0, 6.0, 12.0], baseline=None)


def test_an_arm_that_is_there_sooner() -> None:
    (text,) = said(BASE, cell("mine", [0.0, 22.0, 30.0], [0.0, 22.0, 30.0], [0.0, 22.0, 30.0]))
    # 11 of 22 is half of the way to 50: a quarter of ppo's 100.
    assert text.startswith("mine: reaches ppo's final return on A-v0 with this multiple of ppo's")
    assert "compute: in samples 0.25 (interval from" in text


def test_nothing_is_said_of_a_baseline_that_has_not_learnt() -> None:
    """Two rows of noise: every arm is at the level at once."""
    flat = cell("ppo", [4.0, 5.0, 4.9], [4.0, 3.0, 3.8], baseline=None)
    arms = [cell(name, [3.0, 5.0, 4.0], [4.0, 5.0, 5.0]) for name in ("mine", "mine+random")]
    (text,) = said(flat, *arms)
    assert text.startswith("ppo: its return on A-v0 has not risen")


def test_an_open_interval_is_not_decided() -> None:
    (text,) = said(BASE, cell("mine", [0.0, 30.0, 30.0], [0.0, 2.0, 3.0], [0.0, 9.0, 9.0]))
    assert text.startswith("mine: not decided with how much compute it reaches ppo's final return")
    assert text.endswith(" to never).")
    (text,) = said(BASE, cell("mine", [0.0, 12.0, 14.0], [0.0, 2.0, 3.0], [0.0, 9.0, 9.0]))
    assert (
        "not decided" in text
        and "in samples the mean curve never gets there (interval from" in text
    )


def test_an_arm_that_never_gets_there() -> None:
    (text,) = said(BASE, cell("mine", [0.0, 2.0, 3.0], [0.0, 2.0, 3.0]))
    assert text == "mine: does not reach ppo's final return on A-v0."
    (text,) = said(BASE, cell("mine", [0.0, 22.0, 30.0]))  # one seed
    assert text.endswith("in samples 0.25, without an interval.")


def test_a_failed_seed_keeps_the_mean_from_the_level() -> None:
    """The seeds that are left are those that trained well: they alone would flatter the arm."""
    well = cell("mine", [0.0, 22.0, 30.0], [0.0, 22.0, 30.0])
    (found,) = compute_verdicts([BASE, well._replace(failed=1)])
    assert found["ratios"] == {"samples_backward": [None, None, None]}
    assert found["text"] == (
        "mine: does not reach ppo's final return on A-v0, as 1 of 3 seeds failed."
    )
    (text,) = said(BASE, cell("mine")._replace(failed=5))
    assert text.endswith("as 5 of 5 seeds failed.")


def test_a_baseline_with_a_failed_seed_gives_no_level() -> None:
    """Its mean is the worst outcome: every arm would be there at once."""
    well = cell("mine", [0.0, 22.0, 30.0], [0.0, 22.0, 30.0])
    (text,) = said(BASE._replace(failed=1), well)
    assert text.startswith("ppo: 1 of 4 seeds failed on A-v0, so no ratio of compute is given")
