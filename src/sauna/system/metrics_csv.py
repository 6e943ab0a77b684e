"""`metrics.csv`: a run's rows as a table, for pandas and spreadsheets, also while it trains.

It follows from the two logs alone: the keys of `metrics.jsonl` that hold no list, in the order in
which they first appear, and `wall_seconds` of `timing.jsonl`. So it is written anew where a key
appears for the first time and where a run is resumed; in between, rows are added to its end.

A disk that does not take it ends no training: one line says so, and it is made anew at the end.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from sauna.system.errors import one_line
from sauna.system.logs import lines, read_row
from sauna.system.safe_read import Untrusted
from sauna.system.safe_write import open_grown, replacing, sync_folder

NAME = "metrics.csv"
WALL = "wall_seconds"
LATER = "the training goes on, and the table is made anew at its end"
_FIRST = ("member", "arm", "seed", "iteration", WALL)


class MetricsCsv:
    """The table of one run, by the only process that writes it.

    Args:
      run: its logs are what a checkpoint counts on, and no more.
      say: takes a line for each time that the table cannot be written.
    """

    def __init__(self, run: Path, say: Callable[[str], None]) -> None:
        self._run, self._say, self._columns = run, say, dict.fromkeys(_FIRST)
        self._is_whole = True  # False: a row is missing, or half of one is there
        for row in _rows(run):
            self._columns |= dict.fromkeys(_cells(row))
        self._try(self._write_anew, LATER)

    def append(self, rows: list[dict[str, Any]], wall_seconds: float | None) -> None:
        """Adds the rows of one iteration, which the logs have already."""
        cells = [_cells({**row, WALL: wall_seconds}) for row in rows]
        new = dict.fromkeys(itertools.chain(*cells)).keys() - self._columns.keys()
        for row in cells:
            self._columns |= dict.fromkeys(row)
        if not self._is_whole:
            return
        is_new = bool(new) or not (self._run / NAME).exists()
        self._try(
            self._write_anew if is_new else partial(self._add, cells),
            LATER,
        )

    def finish(self) -> None:
        """Flushes it to the disk, or makes it anew if a row could not be written before."""
        if self._is_whole:
            self._try(self._flush, "the table is made anew")
        if not self._is_whole:
            self._try(self._write_anew, "the run is whole: metrics.jsonl has every row")

    def _try(self, act: Callable[[], None], then: str) -> None:
        """Writes; what the disk, or a file in the table's place, says to that costs the table."""
        try:
            act()
            self._is_whole = True
        except (OSError, Untrusted) as error:
            self._is_whole = False
            self._say(f"warning: {NAME} cannot be written, {then}: {one_line(error)}")

    def _add(self, cells: list[dict[str, Any]]) -> None:
        with open_grown(self._run / NAME) as file:
            file.write(self._text(cells))

    def _flush(self) -> None:
        if (self._run / NAME).exists():  # a run without a row has none
            sync_folder(self._run / NAME)

    def _write_anew(self) -> None:
        path = self._run / NAME
        if len(self._columns) == len(_FIRST):  # there is no row
            path.unlink(missing_ok=True)
            return
        with replacing(path) as temporary, open_grown(temporary) as file:
            file.write(self._text([{name: name for name in self._columns}]))
            for row in _rows(self._run):
                file.write(self._text([_cells(row)]))

    def _text(self, rows: Iterable[Mapping[str, Any]]) -> bytes:
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self._columns), lineterminator="\n")
        writer.writerows(rows)
        return text.getvalue().encode()


def _cells(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if not isinstance(value, list)}


def _rows(run: Path) -> Iterator[dict[str, Any]]:
    """The rows of a run, each with its iteration's `wall_seconds`; both logs rise by iteration."""
    times = {str(row.get("iteration")): row.get(WALL) for row in _read(run, "timing.jsonl")}
    for row in _read(run, "metrics.jsonl"):
        yield {**row, WALL: times.get(str(row["iteration"]))}


def _read(run: Path, name: str) -> Iterator[dict[str, Any]]:
    """The rows of a log, up to the first that is none."""
    for line in lines(run / name):
        try:
            row = read_row(line, name)
        except (ValueError, RecursionError):
            return
        yield row


def trained_seconds(run: Path) -> float:
    """Counts the seconds that a run has been trained for; of 0.1.0 those of its iterations."""
    total = 0.0
    for row in _read(run, "timing.jsonl"):
        seconds, wall = row.get("seconds", 0.0), row.get(WALL)
        total += seconds if isinstance(seconds, int | float) else 0.0
        total = float(wall) if isinstance(wall, int | float) else total
    return total if math.isfinite(total) else 0.0
