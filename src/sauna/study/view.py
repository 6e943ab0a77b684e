"""What a person sees while a study runs: arms x tasks with their progress, or lines of text."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from sauna import rundir
from sauna.metrics.display import duration, number
from sauna.study.spec import Spec, check
from sauna.study.units import Unit, parts

PLAIN_SECONDS = 30.0  # between two progress lines where there is no terminal


class StudyView:
    """Latest row of every member; a live table on a terminal."""

    def __init__(self, spec: Spec, units: list[Unit], folder: Path) -> None:
        self._units = units
        self._configs = {
            (arm.label, task): check(arm, task) for arm in spec.arms for task in arm.tasks
        }
        self._same: dict[str, list[tuple[str, str]]] = {}  # a unit may serve several labels
        self._latest: dict[tuple[str, str], dict[int, dict[str, Any]]] = {
            key: {} for key in self._configs
        }
        self._failed: dict[tuple[str, str], set[int]] = {key: set() for key in self._configs}
        for unit in units:
            self._same.setdefault(unit.name, []).append((unit.label, unit.task))
            for part in parts(unit, folder):
                if part.error(folder) is not None:
                    self._failed[unit.label, unit.task] |= set(part.seeds)
                for row in rundir.rows(part.run(folder)):
                    self._latest[unit.label, unit.task][row["seed"]] = row
        self._first = (time.monotonic(), self._done())
        self._shown = 0.0
        self._live: Any = None

    def _done(self) -> float:
        """Members' worth of work that is done."""
        return sum(
            len(self._failed[key])
            + sum(
                self._share(key, row)
                for seed, row in members.items()
                if seed not in self._failed[key]
            )
            for key, members in self._latest.items()
        )

    def _share(self, key: tuple[str, str], row: dict[str, Any]) -> float:
        """How much of its budget a member has used, of what it can use."""
        config = self._configs[key]
        batch = config.rollout_steps * config.envs
        return float(min(row[f"{config.budget}_steps"] / (config.steps // batch * batch), 1.0))

    def open(self) -> None:
        if sys.stdout.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(), auto_refresh=False, vertical_overflow="visible")
            self._live.start()

    def close(self) -> None:
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
            self._live.stop()
            self._live = None

    def progress(self, unit: Unit, message: dict[str, Any]) -> None:
        for row in message.get("rows", []) + message.get("resumed", []):
            for key in self._keys(unit):
                self._latest[key][row["seed"]] = row
        if "said" in message and not message["said"].startswith("warning: MuJoCo"):
            self.say(f"{unit.task}, {unit.label}: {message['said']}")

    def ended(self, unit: Unit, error: str | None) -> None:
        if error is not None:
            for key in self._keys(unit):
                self._failed[key] |= set(unit.seeds)
            seeds = ", ".join(map(str, unit.seeds))
            self.say(f"FAILED: {unit.task}, {unit.label}, seed {seeds}: {error}")

    def _keys(self, unit: Unit) -> list[tuple[str, str]]:
        return self._same.get(unit.name.split("/")[0], [(unit.label, unit.task)])

    def say(self, text: str) -> None:
        if self._live is not None:
            self._live.console.print(text, highlight=False, markup=False)
        else:
            print(text, flush=True)

    def refresh(self) -> None:
        now = time.monotonic()
        if self._live is not None:
            if now - self._shown > 0.25:
                self._shown = now
                self._live.update(self._table(), refresh=True)
        elif now - self._shown > PLAIN_SECONDS:
            self._shown = now
            self.say(self._status())

    def _status(self) -> str:
        started, before = self._first
        members = sum(len(unit.seeds) for unit in self._units)
        done, spent = self._done(), time.monotonic() - started
        text = f"{done / members:.1%} of {members} members"
        if done > before and spent > 5:
            per_second = (done - before) / spent
            steps = sum(c.steps for c in self._configs.values()) / len(self._configs)
            left = duration((members - done) / per_second)
            text += f", {per_second * steps:,.0f} env steps/s, {left} left"
        failed = sum(map(len, self._failed.values()))
        return text + (f", {failed} failed" if failed else "")

    def _table(self) -> Any:
        from rich.table import Table

        table = Table(title=self._status(), title_justify="left", box=None)
        for column in ("task", "arm"):
            table.add_column(column)
        for column in ("seeds done", "progress", "return", "keep rate"):
            table.add_column(column, justify="right")
        for (label, task), members in self._latest.items():
            seeds = sum(len(u.seeds) for u in self._units if (u.label, u.task) == (label, task))
            rows = list(members.values())
            shares = [self._share((label, task), row) for row in rows]
            share, ended = sum(shares) / seeds, sum(share > 0.99 for share in shares)
            means = {
                name: sum(row[name] for row in rows) / len(rows)
                for name in ("return_mean", "keep_rate")
                if rows and all(name in row for row in rows)
            }
            table.add_row(
                task, label, f"{ended} of {seeds}", f"{share:.0%}",
                number(means, "return_mean", ".1f"), number(means, "keep_rate", ".3f"),
            )  # fmt: skip
        return table
