"""`results/selection_stage.py`: Holm's correction over a whole stage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from selection_stage import Stage, stage_of, stage_text

from selection_cells import BASE, cell, study

FIRST = study(cell("ppo", BASE), cell("gigaflow", BASE + 50), cell("gigaflow+random", BASE + 9))
SECOND = study(
    *(cell(name, BASE - i, task="B-v5") for i, name in enumerate(("ppo", "gigaflow", "spo")))
)
PLANNED = {
    (label, task): 5
    for task in ("A-v5", "B-v5")
    for label in ("ppo", "gigaflow", "gigaflow+random", "spo")
}
LOWEST = 2 / math.comb(10, 5)


def test_a_stage_has_the_tests_of_all_of_its_tasks_and_files() -> None:
    stage = stage_of([FIRST, SECOND], PLANNED)
    assert set(stage.p) == {
        "`gigaflow` against `ppo` on A-v5",
        "`gigaflow+random` against `ppo` on A-v5",
        "`gigaflow` against `gigaflow+random` on A-v5",
        "`gigaflow` against `ppo` on B-v5",
        "`spo` against `ppo` on B-v5",
    }
    # Three arms against ppo and one rule against its control, on two tasks.
    assert stage.planned == 8 and stage.least == pytest.approx(LOWEST)
    first = stage.corrected()["`gigaflow` against `ppo` on A-v5"]
    assert first == pytest.approx(8 * LOWEST)  # of one task alone it would be 3


def test_tests_to_come_count_as_decided_by_none() -> None:
    stage = Stage({"a": 0.01, "b": 0.02}, planned=4, least=0.0)
    assert stage.corrected() == pytest.approx({"a": 0.04, "b": 0.06})


def test_one_training_is_one_piece_of_evidence() -> None:
    """Two controls with the same numbers in every seed; the other two differ in one."""
    same = study(*(cell(f"{x}+random", BASE + 1) for x in ("pods", "gigaflow")), cell("ppo", BASE))
    planned = {(own["label"], "A-v5"): 5 for own in same["cells"]}
    stage = stage_of([same], planned)
    assert [*stage.p] == ["`pods+random` against `ppo` on A-v5"] and stage.planned == 1
    other = cell("gigaflow+random", BASE + 1 + np.array([0, 0, 0, 0, 1e-9]))
    stage = stage_of([study(*same["cells"][::2], other)], planned)
    assert len(stage.p) == 2 and stage.planned == 2


def test_the_text_says_what_is_decided() -> None:
    text = stage_text(stage_of([FIRST, SECOND], PLANNED))
    assert text.startswith("The stage has 8 tests: ") and "5 can be made so far." in text
    assert "can be below 0.008, which is 0.06 after the correction. So no test" in text
    text = stage_text(Stage({"`a` against `ppo` on A-v5": 0.001, "b": 0.04}, 8, 1e-6))
    assert text.endswith("below 0.05: `a` against `ppo` on A-v5.")
    text = stage_text(Stage({"a": 0.04}, 8, 1e-6))
    assert text.endswith(
        "The lowest p value after the correction is 0.32. No test decides anything."
    )
