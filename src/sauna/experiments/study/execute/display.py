"""What a person sees while a study runs: arms x tasks with their seeds, or lines of text."""

from __future__ import annotations

import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

from sauna.config.settings import Config
from sauna.experiments.report.numbers import number
from sauna.experiments.study.spec import Spec, check
from sauna.experiments.study.units import Unit, parts
from sauna.system import run_directory
from sauna.training.display import duration

PLAIN_SECONDS = 30.0  # between two progress lines where there is no terminal
LIVE_SECONDS = 0.25
NAMED = 4  # arms that a progress line names
RATE_SECONDS = 60.0  # over which env steps per second are shown
BARS = "▁▂▃▄▅▆▇█"
WAITING, DONE, FAILED = "·", "✓", "✗"


class Cell:
    """One arm on one task: what is known of its seeds."""

    def __init__(self, config: Config) -> None:
        self.seeds = config.seeds
        self.has_sampler = config.sampler != "none"
        self.latest: dict[int, dict[str, Any]] = {}  # seed -> its last row
        self.complete: set[int] = set()
        self.failed: set[int] = set()
        self.running: set[str] = set()  # names of units
        self._budget = f"{config.budget}_steps"
        batch = config.rollout_steps * config.envs
        self._usable = config.steps // batch * batch
        self._recent: deque[tuple[float, int]] = deque()  # when rows came, env steps of all seeds

    def note(self, row: dict[str, Any], trained: bool) -> None:
        """Notes a seed's newest row; `trained` unless it is only repeated by a run that
        continues."""
        self.latest[row["seed"]] = row
        steps, now = sum(row["env_steps"] for row in self.latest.values()), time.monotonic()
        if not trained or (self._recent and steps < self._recent[-1][1]):
            self._recent.clear()
        if trained:
            self._recent.append((now, steps))
        while self._recent and now - self._recent[0][0] > RATE_SECONDS:
            self._recent.popleft()

    def share(self, seed: int) -> float:
        """Returns how much of what it can use of its budget a seed has used; 1 once it has
        ended."""
        if seed in self.complete | self.failed:
            return 1.0
        row = self.latest.get(seed)
        return min(row[self._budget] / max(self._usable, 1), 1.0) if row else 0.0

    def marks(self) -> str:
        """Returns a character for each seed: waiting, a bar as high as its progress, complete,
        failed."""
        return "".join(map(self._mark, self.seeds))

    def _mark(self, seed: int) -> str:
        if seed in self.failed:
            return FAILED
        if seed in self.complete:
            return DONE
        share = self.share(seed)
        return BARS[min(int(share * len(BARS)), len(BARS) - 1)] if seed in self.latest else WAITING

    def mean(self, name: str) -> float | None:
        """Returns the mean over the seeds that have the number, failed ones left out."""
        rows = [row for seed, row in self.latest.items() if seed not in self.failed]
        values = [row[name] for row in rows if name in row]
        return sum(values) / len(values) if values else None

    def shares(self) -> str:
        """Says what share of the env steps is kept, and of the samples used if a sampler
        chooses."""
        said = f"keep rate {number(self.mean('keep_rate'), 3)}"
        if self.has_sampler:
            said += f", samples used {number(self.mean('sample_rate'), 3)}"
        return said

    def rate(self) -> float | None:
        """Returns env steps per second of late."""
        if not self.running or len(self._recent) < 2:
            return None
        (first, before), (last, after) = self._recent[0], self._recent[-1]
        return (after - before) / (last - first) if last > first else None


class StudyView:
    """A live table on a terminal, a line of text now and then elsewhere; nothing where quiet."""

    def __init__(self, spec: Spec, units: list[Unit], folder: Path, quiet: bool = False) -> None:
        self._quiet = quiet
        self._configs = {
            (arm.label, task): check(arm, task) for arm in spec.arms for task in arm.tasks
        }
        self._cells = {key: Cell(config) for key, config in self._configs.items()}
        self._same: dict[str, list[Cell]] = {}  # a unit may serve several labels
        for unit in units:
            cell = self._cells[unit.label, unit.task]
            self._same.setdefault(unit.name, []).append(cell)
            for part in parts(unit, folder):
                if part.error(folder) is not None:
                    cell.failed |= set(part.seeds)
                if part.is_complete(folder):
                    cell.complete |= set(part.seeds)
                for row in run_directory.rows(part.run(folder)):
                    cell.note(row, trained=False)
        self._first = (time.monotonic(), self._done())
        self._shown = 0.0
        self._live: Any = None

    def _members(self) -> int:
        return sum(len(cell.seeds) for cell in self._cells.values())

    def _done(self) -> float:
        """Members' worth of work that is done."""
        return sum(cell.share(seed) for cell in self._cells.values() for seed in cell.seeds)

    def open(self) -> None:
        if sys.stdout.isatty() and not self._quiet:
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(), auto_refresh=False, vertical_overflow="crop")
            self._live.start()

    def close(self) -> None:
        if self._live is not None:
            self._live.update(self._table(whole=True), refresh=True)
            self._live.stop()
            self._live = None

    def started(self, unit: Unit) -> None:
        for cell in self._served(unit):
            cell.running.add(unit.name)

    def stopped(self, unit: Unit) -> None:
        for cell in self._served(unit):
            cell.running.discard(unit.name)

    def progress(self, unit: Unit, message: dict[str, Any]) -> None:
        for cell in self._served(unit):
            for row in message.get("resumed", []):
                cell.note(row, trained=False)
            for row in message.get("rows", []):
                cell.note(row, trained=True)
        if "said" in message:
            self.say(f"{unit.task}, {unit.label}: {message['said']}")

    def ended(self, unit: Unit, error: str | None) -> None:
        for cell in self._served(unit):
            (cell.complete if error is None else cell.failed).update(unit.seeds)
        if error is not None:
            seeds = ", ".join(map(str, unit.seeds))
            self.say(f"FAILED: {unit.task}, {unit.label}, seed {seeds}: {error}")

    def _served(self, unit: Unit) -> list[Cell]:
        return self._same.get(unit.name.split("/")[0], [self._cells[unit.label, unit.task]])

    def say(self, text: str) -> None:
        if self._quiet:
            return
        if self._live is not None:
            self._live.console.print(text, highlight=False, markup=False)
        else:
            print(text, flush=True)

    def refresh(self) -> None:
        now = time.monotonic()
        if now - self._shown < (PLAIN_SECONDS if self._live is None else LIVE_SECONDS):
            return
        self._shown = now
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
        else:
            self.say(self._status() + self._named())

    def _status(self) -> str:
        started, before = self._first
        members, done, spent = self._members(), self._done(), time.monotonic() - started
        text = f"{done / members:.1%} of {members} members"
        if done > before and spent > 5:
            per_second = (done - before) / spent
            steps = sum(c.steps for c in self._configs.values()) / len(self._configs)
            left = duration((members - done) / per_second)
            text += f", {per_second * steps:,.0f} env steps/s, {left} left"
        failed = sum(len(cell.failed) for cell in self._cells.values())
        return text + (f", {failed} failed" if failed else "")

    def _named(self) -> str:
        """The arms in training, as text."""
        running = [(key, cell) for key, cell in self._cells.items() if cell.running]
        shown = "".join(
            f"; {label} on {task} {cell.marks()} return {number(cell.mean('return_mean'), 1)}, "
            f"{cell.shares()}"
            for (label, task), cell in running[:NAMED]
        )
        return shown + (f"; {len(running) - NAMED} more" if len(running) > NAMED else "")

    def _table(self, whole: bool = False) -> Any:
        """Every arm on every task, or, where they are too many for the terminal, those in training
        (all the same if `whole`)."""
        from rich.table import Table

        shown = self._cells
        if not whole and len(shown) > self._live.console.height - 4:
            shown = {key: cell for key, cell in shown.items() if cell.running}
        table = Table(title=self._status(), title_justify="left", box=None)
        for column in ("task", "arm", "seeds"):
            table.add_column(column)
        sampled = any(cell.has_sampler for cell in self._cells.values())
        used = ["samples used"] if sampled else []
        for column in ("progress", "return", "keep rate", *used, "env steps/s"):
            table.add_column(column, justify="right")
        for (label, task), cell in shown.items():
            share = sum(map(cell.share, cell.seeds)) / len(cell.seeds)
            table.add_row(
                task,
                label,
                cell.marks(),
                f"{share:.0%}",
                number(cell.mean("return_mean"), 1),
                number(cell.mean("keep_rate"), 3),
                *([number(cell.mean("sample_rate"), 3)] if sampled else []),
                number(cell.rate(), 0),
            )
        if len(shown) < len(self._cells):
            table.caption = f"{len(self._cells) - len(shown)} more lines are complete or waiting"
        return table
