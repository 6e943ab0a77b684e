"""`results/collapse.py`: seeds that collapse late."""

from __future__ import annotations

from typing import Any

import pytest
from collapse import collapse_text, is_collapsed


def member(curve: list[float | None], final: float, status: str = "complete") -> dict[str, Any]:
    return {"status": status, "final_return": final, "curve": {"return_mean": curve}}


@pytest.mark.parametrize(
    ("curve", "final", "status", "expected"),
    [
        ([None, 10.0, 100.0, 49.0], 49.0, "complete", True),
        ([None, 10.0, 100.0, 51.0], 51.0, "complete", False),
        ([10.0, 20.0], 100.0, "complete", False),  # the best is where it ends
        ([10.0, 20.0], 100.0, "failed", True),
    ],
)
def test_a_seed_has_collapsed(
    curve: list[float | None], final: float, status: str, expected: bool
) -> None:
    assert is_collapsed(member(curve, final, status)) == expected


def results(base: int, other: int) -> dict[str, Any]:
    fine, low = member([1.0, 9.0], 9.0), member([1.0, 9.0], 1.0)
    seeds = {"ppo": base, "target-kl": other}
    cells = [
        {"label": label, "members": [low] * count + [fine] * (10 - count)}
        for label, count in seeds.items()
    ]
    return {"baseline": "ppo", "cells": cells}


def test_shares_are_counted_and_tested() -> None:
    text = collapse_text(results(10, 0))
    assert "| `ppo` | 10 of 10 | - |" in text
    # 2 of the C(20, 10) = 184,756 ways to draw are as extreme
    assert "| `target-kl` | 0 of 10 | 0.000 |" in text
    assert "Hypothesis D holds by its shares. The difference is decided for 1 of 1 arms." in text


def test_a_higher_share_is_no_support() -> None:
    text = collapse_text(results(0, 10))
    assert "does not hold by its shares. The difference is decided for 0 of 1 arms." in text


def test_a_lower_share_that_the_data_cannot_carry_is_said_to_be_so() -> None:
    # 1 of 10 against 0 of 10: p = 1
    text = collapse_text(results(1, 0))
    assert "| `target-kl` | 0 of 10 | 1.000 |" in text
    assert "holds by its shares. The difference is decided for 0 of 1 arms." in text
