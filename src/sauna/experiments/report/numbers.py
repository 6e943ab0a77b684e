"""Numbers as text, as papers print them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def digits_of(values: Iterable[float | None]) -> int:
    """Decimals that leave three or four digits of the largest, as papers print returns."""
    largest = max((abs(v) for v in values if v is not None), default=0.0)
    return 0 if largest >= 500 else 1 if largest >= 10 else 2 if largest >= 1 else 3


def digits_of_tasks(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Returns, for each task of a summary's table, decimals that all its arms share."""
    return {
        task: digits_of(row["final_iqm"][0] for row in rows if row["task"] == task)
        for task in dict.fromkeys(row["task"] for row in rows)
    }


def number(value: float | None, digits: int) -> str:
    """Formats a number; `-` if there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def interval(values: Sequence[float | None] | None, digits: int) -> str:
    """Returns `0.53 [0.41, 0.65]`: a value and its interval, of what there is of them."""
    if values is None or values[0] is None or values[1] is None:
        return number(values[0] if values else None, digits)
    return f"{number(values[0], digits)} [{number(values[1], digits)}, {number(values[2], digits)}]"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns rows of texts as lines whose columns stand under each other."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ("  ".join(f"{t:<{w}}" for t, w in zip(row, widths, strict=True)) for row in rows)
    return [line.rstrip() for line in lines]
