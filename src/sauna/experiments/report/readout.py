"""The numbers under a figure: every line at one env step, and where each line ends."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sauna.experiments.report.figures import Line, Panel, Plot
from sauna.experiments.report.numbers import digits_of
from sauna.experiments.report.style import short


class Row(NamedTuple):
    """A line's value and interval at the read-out's env step, and its last env step."""

    label: str
    values: list[float | None]
    end: float


class ReadOut(NamedTuple):
    caption: str
    digits: int
    rows: list[Row]

    @property
    def ends_differ(self) -> bool:
        return len({row.end for row in self.rows}) > 1


def read_out(plot: Plot, panel: Panel) -> ReadOut | None:
    """Compares the lines of a panel at the last env step that all of them reach.

    A line is linear between its points and has no value beyond its ends: lines that never overlap
    are not compared, and the caption says so.

    Returns:
      None where the x axis is not env steps, or nothing is drawn.
    """
    known = {line.label: _known(line) for line in panel.lines}
    known = {label: points for label, points in known.items() if points.shape[1]}
    if plot.x_label != "env steps" or not known:
        return None
    start = max(float(points[0, 0]) for points in known.values())
    end = min(float(points[0, -1]) for points in known.values())
    ends = {label: float(points[0, -1]) for label, points in known.items()}
    if start > end:
        rows = [Row(label, [None, None, None], ends[label]) for label in known]
        return ReadOut("There is no env step at which every line has a value.", 0, rows)
    rows = [Row(label, _at(points, end), ends[label]) for label, points in known.items()]
    differ = len(set(ends.values())) > 1
    where = "the last that every line reaches" if differ else "where every line ends"
    digits = digits_of(row.values[0] for row in rows)
    return ReadOut(f"At {short(end)} env steps, {where}", digits, rows)


def _known(line: Line) -> np.ndarray:
    """The points that have a value: `[4, n]` x, y, low, high."""
    points = np.array([line.x, line.y, line.low, line.high], float)
    return points[:, np.isfinite(points[0]) & np.isfinite(points[1])]


def _at(points: np.ndarray, x: float) -> list[float | None]:
    values: list[Any] = [float(np.interp(x, points[0], column)) for column in points[1:]]
    return [value if np.isfinite(value) else None for value in values]
