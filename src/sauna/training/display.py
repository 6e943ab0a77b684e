"""What a person sees while a run trains: a live table, on a terminal or in a notebook, or lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any, Protocol

from sauna.config.checks import local_parts
from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.training.summary import WINDOW, with_evaluation

PLAIN_SECONDS = 10.0  # between two progress lines where there is no terminal
NOTEBOOK_SECONDS = 0.5  # between two drawings of the table in a notebook
NAMED = 6  # members that a progress line names; of more it gives the mean of each arm


class Display(Protocol):
    """Where a run shows itself. `say` works before `open` and after `close`."""

    def say(self, text: str) -> None:
        """Shows one line of text."""

    def open(
        self, config: Config, members: list[Member], path: Path, rows: list[dict[str, Any]]
    ) -> None:
        """Begins to show a run; `rows` are those of before, of a run that is resumed."""

    def phase(self, process: int, text: str) -> None:
        """Notes what a process does now."""

    def rows(self, rows: list[dict[str, Any]]) -> None:
        """Takes the rows of one iteration."""

    def refresh(self) -> None:
        """Shows what is new; called often."""

    def summary(self, members: dict[str, dict[str, Any]]) -> None:
        """Shows how each member ended."""

    def close(self) -> None:
        """Ends the showing."""


def make_display() -> Display:
    """Makes a live table on a terminal and in a notebook, and plain lines elsewhere."""
    if in_notebook():
        return NotebookDisplay()
    return LiveDisplay() if sys.stdout.isatty() else PlainDisplay()


def in_notebook() -> bool:
    """Returns whether this process is the kernel of a notebook."""
    module: Any = sys.modules.get("IPython")
    shell = module.get_ipython() if module is not None else None
    return getattr(shell, "kernel", None) is not None


class _Progress:
    """Latest row of each member, and the rate since training began."""

    def __init__(self, config: Config, members: list[Member], rows: list[dict[str, Any]]) -> None:
        self.config, self.members = config, members
        self.latest: dict[str, dict[str, Any] | None] = {m.name: None for m in members}
        self.phases: dict[int, str] = {}
        self.seconds_left: float | None = None
        self.rate: float | None = None
        self.succeeds = False  # whether environments say if an episode was a success
        self._first: tuple[float, int] | None = None
        self._take(rows)

    def _take(self, rows: list[dict[str, Any]]) -> None:
        for row in rows:
            self.latest[row["member"]] = with_evaluation(row, self.latest[row["member"]])
            self.succeeds |= "success_rate" in row

    def rows(self, rows: list[dict[str, Any]]) -> None:
        self._take(rows)
        done, now = sum(map(self.budget_used, self.latest)), time.monotonic()
        if self._first is None:
            if all(self.latest.values()):
                self._first = (now, done)  # compiling is not counted into the rate
        elif now > self._first[0]:
            self.rate = (done - self._first[1]) / (now - self._first[0])
            left = self.config.steps * len(self.latest) - done
            self.seconds_left = left / self.rate if self.rate else None

    def budget_used(self, name: str) -> int:
        """Counts the steps of a member's budget that are used."""
        row = self.latest[name]
        return row[f"{self.config.budget}_steps"] if row else 0

    def cells(self) -> list[list[str]]:
        """Writes the titles of the table, and a line for each member."""
        columns = columns_of(self.members, self.succeeds)
        lines = [
            [name, *(number(row, key, form) for _, key, form in columns)]
            for name, row in self.latest.items()
        ]
        return [["member", *(title for title, _, _ in columns)], *lines]

    def status(self) -> str:
        """Writes one line: phase or rate, time left."""
        share = sum(self.budget_used(n) for n in self.latest) / (
            self.config.steps * len(self.latest)
        )
        if self.rate is None:
            waiting = sorted(set(self.phases.values()))
            if share > 0:
                waiting.append(f"{share:.0%}")
            return ", ".join(waiting) or "starting"
        left = "" if self.seconds_left is None else f", {duration(self.seconds_left)} left"
        return f"{share:.0%}, {self.rate:,.0f} {self.config.budget} steps/s{left}"


def duration(seconds: float) -> str:
    """Writes seconds as `h:mm:ss` or `m:ss`."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def counted(count: int, noun: str) -> str:
    """Writes `1 task` or `2 tasks`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def number(row: dict[str, Any] | None, key: str, form: str) -> str:
    """Formats a number of a row; `-` if it is not there."""
    return format(row[key], form) if row and key in row else "-"


class PlainDisplay:
    """Lines of text: one for each phase, then one every few seconds.

    The gap between two lines doubles until there are new rows.
    """

    def __init__(self) -> None:
        self._progress: _Progress | None = None
        self._start = self._shown = time.monotonic()
        self._gap = PLAIN_SECONDS
        self._phases: set[str] = set()

    def say(self, text: str) -> None:
        print(text, flush=True)

    def open(
        self, config: Config, members: list[Member], path: Path, rows: list[dict[str, Any]]
    ) -> None:
        self._progress = _Progress(config, members, rows)
        self.say(headline(config, members, path))

    def phase(self, process: int, text: str) -> None:
        if text not in self._phases:
            self._phases.add(text)
            self.say(f"{self._elapsed()} {text}")

    def _elapsed(self) -> str:
        return duration(time.monotonic() - self._start)

    def rows(self, rows: list[dict[str, Any]]) -> None:
        assert self._progress is not None
        self._progress.rows(rows)
        self._gap = PLAIN_SECONDS

    def refresh(self) -> None:
        progress = self._progress
        if progress is None or time.monotonic() - self._shown < self._gap:
            return
        self._shown = time.monotonic()
        self._gap *= 2
        if any(progress.latest.values()):
            self.say(f"{self._elapsed()} {progress.status()}; {returns(progress.latest)}")
        else:
            self.say(f"{self._elapsed()} the first iteration is not done yet")

    def summary(self, members: dict[str, dict[str, Any]]) -> None:
        for name, row in members.items():
            episodes = row["episodes"]
            which = f"last {WINDOW}" if episodes >= WINDOW else f"all {episodes}"
            self.say(
                f"{name}: return {number(row, 'return_mean', '.2f')} "
                f"(training, {which} episodes), {row['env_steps']:,} env steps, "
                f"{row['kept_steps']:,} kept{evaluated(row)}"
            )

    def close(self) -> None:
        pass


def returns(latest: Mapping[str, dict[str, Any] | None]) -> str:
    """Writes the returns of the members, or of more than `NAMED` the mean of each arm.

    Args:
      latest: the newest row of each member, `arm/seed`; None before the first.
    """
    if len(latest) <= NAMED:
        shown = (f"{name} {number(row, 'return_mean', '.1f')}" for name, row in latest.items())
        return f"return: {', '.join(shown)}"
    of_arm: dict[str, list[float]] = {}
    for name, row in latest.items():
        own = of_arm.setdefault(name.rpartition("/")[0], [])
        own += [row["return_mean"]] if row and "return_mean" in row else []
    means = (f"{arm} {sum(v) / len(v):.1f}" if v else f"{arm} -" for arm, v in of_arm.items())
    return f"mean return: {', '.join(means)}"


class LiveDisplay:
    """A table that is redrawn in place."""

    def __init__(self) -> None:
        from rich.console import Console

        self._console = Console()
        self._live: Any = None
        self._progress: _Progress | None = None

    def say(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False)

    def open(
        self, config: Config, members: list[Member], path: Path, rows: list[dict[str, Any]]
    ) -> None:
        from rich.live import Live

        self._progress = _Progress(config, members, rows)
        self.say(headline(config, members, path))
        self._live = Live(console=self._console, auto_refresh=False, transient=False)
        self._live.start()
        self.refresh()

    def phase(self, process: int, text: str) -> None:
        assert self._progress is not None
        self._progress.phases[process] = text

    def rows(self, rows: list[dict[str, Any]]) -> None:
        assert self._progress is not None
        self._progress.rows(rows)

    def refresh(self) -> None:
        if self._live is not None:
            self._live.update(self._table(), refresh=True)

    def _table(self) -> Any:
        from rich.table import Table

        assert self._progress is not None
        table = Table(title=self._progress.status(), title_justify="left", box=None)
        head, *lines = self._progress.cells()
        for title in head:
            table.add_column(title, justify="left" if title == "member" else "right")
        for line in lines:
            table.add_row(*line)
        return table

    def summary(self, members: dict[str, dict[str, Any]]) -> None:
        self.refresh()
        self.close()
        self.say("return: mean training return of the last 100 episodes")
        say_evaluations(self, members)

    def close(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None


class NotebookDisplay(PlainDisplay):
    """A table in a cell's output that is redrawn in place."""

    def __init__(self) -> None:
        super().__init__()
        self._handle: Any = None

    def open(
        self, config: Config, members: list[Member], path: Path, rows: list[dict[str, Any]]
    ) -> None:
        from IPython.display import display

        super().open(config, members, path, rows)
        self._handle = display(self._html(), display_id=True)

    def phase(self, process: int, text: str) -> None:
        if self._progress is None:
            super().phase(process, text)
        else:
            self._progress.phases[process] = text

    def refresh(self) -> None:
        if self._handle is not None and time.monotonic() - self._shown > NOTEBOOK_SECONDS:
            self._shown = time.monotonic()
            self._handle.update(self._html())

    def summary(self, members: dict[str, dict[str, Any]]) -> None:
        if self._handle is not None:
            self._handle.update(self._html())
        say_evaluations(self, members)

    def _html(self) -> Any:
        from IPython.display import HTML

        assert self._progress is not None
        head, *lines = (
            "".join(f"<td>{escape(cell)}</td>" for cell in line) for line in self._progress.cells()
        )
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        title = escape(self._progress.status())
        return HTML(
            f"<table><caption>{title}</caption><thead><tr>{head}</tr></thead>"
            f"<tbody>{body}</tbody></table>"
        )


def evaluated(row: Mapping[str, Any]) -> str:
    """Says what a member's evaluations came to, and whether it was stopped early."""
    text = ""
    if "eval_return_mean" in row:
        text = (
            f"; evaluation: return {row['eval_return_mean']:.2f}, best "
            f"{row['eval_return_best']:.2f}, {row['eval_env_steps']:,} env steps of its own"
        )
    if "stopped_early" in row:
        text += f"; stopped early ({row['stopped_early']})"
    return text


def say_evaluations(display: Display, members: Mapping[str, Mapping[str, Any]]) -> None:
    """Says a line for each member that was evaluated or stopped early."""
    for name, row in members.items():
        if text := evaluated(row):
            display.say(f"{name}{text}")


def columns_of(members: list[Member], succeeds: bool = False) -> list[tuple[str, str, str]]:
    """The live table's columns: title, key in a row, format.

    What only a rule or a Vex head has is shown if a member has one; the rate of successes where
    environments say so (`succeeds`).
    """
    columns = [
        ("env steps", "env_steps", ",d"),
        ("episodes", "episodes", ",d"),
        ("return", "return_mean", ".1f"),
        ("length", "episode_length_mean", ".0f"),
        ("entropy", "entropy", ".2f"),
        ("KL", "kl", ".4f"),
        ("expl. var.", "explained_variance", ".2f"),
    ]
    if succeeds:
        columns.insert(3, ("success", "success_rate", ".0%"))
    configs = [member.config for member in members]
    if any(config.eval_every for config in configs):
        columns.insert(3, ("evaluation", "eval_return_mean", ".1f"))
    if any(config.filter != "none" for config in configs):
        columns.append(("keep rate", "keep_rate", ".3f"))
    if any(config.sampler != "none" for config in configs):
        columns.append(("samples used", "sample_rate", ".3f"))
    if any(config.vex_coef > 0 for config in configs):
        columns += [("Vex mean", "vex_mean", ".3f"), ("Vex spread", "vex_spread", ".3f")]
    return columns


def headline(config: Config, members: list[Member], path: Path) -> str:
    """Says in one line what is trained, and where it is written."""
    place = f"{config.processes} process{'es' if config.processes > 1 else ''}"
    arms = ", ".join(dict.fromkeys(member.arm for member in members))
    return (
        f"{config.env}: {counted(len(members), 'member')} "
        f"({arms} x {counted(len(config.seeds), 'seed')}), {config.steps:,} "
        f"{'env' if config.budget == 'env' else 'kept'} steps each, preset {config.preset}, "
        f"{'this process' if local_parts(config) else place}; writing to {path}"
    )
