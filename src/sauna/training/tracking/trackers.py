"""The trackers of one run: opened, fed and closed so that none of them can end the training."""

from __future__ import annotations

import importlib.util
import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sauna.config.plugins import import_name
from sauna.config.presets import Member
from sauna.config.settings import Config, to_json
from sauna.system import run_directory
from sauna.system.errors import BadInput, nearest, one_line
from sauna.system.safe_read import JSON_BYTES, Untrusted, parse_object, read_file
from sauna.training.tracking.tracker import TrackedRun, Tracker

# Name: the library that it needs, and its class.
KNOWN = {
    "tensorboard": ("tensorboardX", "tensorboard:TensorBoard"),
    "wandb": ("wandb", "wandb:WandB"),
    "trackio": ("trackio", "trackio:Trackio"),
    "mlflow": ("mlflow", "mlflow:MLflow"),
}
_FAILURES = (Exception, SystemExit)  # how a tracker may fail: some libraries call sys.exit
FILE = "tracking.json"  # of the run directory: what each tracker needs to find its run again
ENDED = "ended"  # its key for trackers that failed: the env steps of each member's last row there


def chosen(config: Config) -> list[str]:
    """Names the trackers of a run."""
    return [name for name in dict.fromkeys(config.track) if name not in ("", "none")]


def check_trackers(config: Config) -> None:
    """Refuses a tracker that does not exist, or whose library is missing.

    Raises:
      BadInput: with the known ones, or the extra to install.
    """
    if "none" in config.track and chosen(config):
        raise BadInput("track: none stands alone")
    for name in chosen(config):
        if ":" in name:
            _class_of(name)
        elif name not in KNOWN:
            known = ", ".join(KNOWN)
            hint = nearest(name, KNOWN)
            raise BadInput(f"track: unknown tracker {name!r} (known: {known}, module:Class){hint}")
        elif importlib.util.find_spec(KNOWN[name][0]) is None:
            raise BadInput(f"track: {name} needs `pip install 'sauna-rl[{name}]'`")


def _class_of(name: str) -> Any:
    """The class of a tracker, or a tracker.

    Raises:
      BadInput: it is something else, or cannot be imported.
    """
    own = name if ":" in name else f"{__package__}.{KNOWN[name][1]}"
    found = import_name("track", own)
    if not isinstance(found, Tracker) and not (
        isinstance(found, type) and issubclass(found, Tracker)
    ):
        raise BadInput(f"track: {name} is no subclass of sauna.Tracker")
    return found


def last_steps(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """For each member the env steps of its last row."""
    return {row["member"]: row["env_steps"] for row in rows}


class Trackers:
    """All trackers of a run. What one of them raises ends that one, with a line that says so.

    A tracker that is new to a run gets the rows of before first; one that failed, those since then.

    Args:
      path: the run directory.
      say: takes the warnings.
      done: for each member the env steps up to which an interrupted run has tracked its rows; those
        that come again, the same, are not tracked twice.
    """

    def __init__(
        self,
        path: Path,
        config: Config,
        members: Sequence[Member],
        say: Callable[[str], None],
        done: Mapping[str, int],
    ) -> None:
        self._path, self._config, self._say = path, config, say
        self._members = {
            one.name: {**to_json(one.config), "member": one.name, "arm": one.arm, "seed": one.seed}
            for one in members
        }
        self._before = done
        self._done: dict[str, dict[str, int]] = {}
        self._kept: dict[str, Any] = {}
        self._ended: dict[str, Any] = {}
        self._open: dict[str, Tracker] = {}
        self.urls: dict[str, dict[str, str]] = {}

    def open(self) -> None:
        """Opens all of them, which may take a while; before it, and without it, there are none."""
        names = chosen(self._config)
        if not names:
            return
        self._kept = self._read()
        self._ended = _dict(self._kept.pop(ENDED, None)) or {}
        for name in names:
            before, ended = _dict(self._kept.get(name)), _dict(self._ended.get(name))
            done = self._before if ended is None else ended
            self._done[name] = {} if before is None else dict(done)
            is_behind = before is None or ended is not None
            earlier = run_directory.rows(self._path) if is_behind else []
            run = TrackedRun(self._path, self._config.track_project, self._members, before or {})
            try:
                self._open[name] = tracker = _made(name)
                found = tracker.open(run)
                urls = _urls(found)
                self._kept[name] = found
                for row in earlier:
                    self._give(name, row, tracker)
                self._ended.pop(name, None)
            except _FAILURES as error:
                self._end(name, error)
                continue
            if urls:
                self.urls[name] = urls
                self._say(f"{name}: {', '.join(dict.fromkeys(urls.values()))}")
        self._keep()

    def _read(self) -> dict[str, Any]:
        """What the trackers of before have left, by which they find the run again."""
        file = self._path / FILE
        try:
            return parse_object(read_file(file, JSON_BYTES)) if os.path.lexists(file) else {}
        except Untrusted as error:
            self._say(f"warning: cannot read {file}: {error}; trackers begin anew")
            return {}

    def _keep(self) -> None:
        ended = {ENDED: self._ended} if self._ended else {}
        run_directory.write_json(self._path / FILE, self._kept | ended)

    def _give(self, name: str, row: Mapping[str, Any], tracker: Tracker) -> None:
        """Gives a tracker a row, unless it has it."""
        done, member, steps = self._done[name], row["member"], row["env_steps"]
        if steps > done.get(member, -1):
            tracker.row(row)
            done[member] = steps

    def rows(self, rows: Sequence[Mapping[str, Any]], timing: Mapping[str, float]) -> None:
        """Takes the rows of one iteration, and what a clock says of it."""
        for row in rows:
            whole = {**row, **timing}
            for name in list(self._open):
                self._call(name, partial(self._give, name, whole))

    def summary(self, members: Mapping[str, Mapping[str, Any]], complete: bool) -> None:
        """Takes the final numbers of each member."""
        for name in list(self._open):
            self._call(name, lambda tracker: tracker.summary(members, complete))

    def picture(self, title: str, path: Path) -> None:
        """Takes a figure of the run."""
        for name in list(self._open):
            self._call(name, lambda tracker: tracker.picture(title, path))

    def close(self) -> None:
        """Ends all of them."""
        for name in list(self._open):
            self._call(name, lambda tracker: tracker.close())
        self._open.clear()

    def _call(self, name: str, act: Callable[[Tracker], None]) -> None:
        try:
            act(self._open[name])
        except _FAILURES as error:
            self._end(name, error)

    def _end(self, name: str, error: BaseException) -> None:
        self._say(f"warning: {name} ended, the training goes on: {one_line(error)}")
        self._ended[name] = self._done[name]
        self._keep()
        tracker = self._open.pop(name, None)
        try:
            if tracker is not None:
                tracker.close()
        except _FAILURES:  # it has failed already
            pass


def _made(name: str) -> Tracker:
    found = _class_of(name)
    return found if isinstance(found, Tracker) else found()


def _dict(value: Any) -> dict[str, Any] | None:
    return value if isinstance(value, dict) else None


def _urls(kept: Any) -> dict[str, str]:
    """Reads the addresses among what a tracker's `open` returned.

    Raises:
      TypeError, ValueError: that is nothing that `tracking.json` could hold.
    """
    if not isinstance(kept, dict):
        raise TypeError(f"open returned {type(kept).__name__}, not a dict")
    json.dumps(kept, allow_nan=False)
    urls = kept.get("urls") or {}
    if not isinstance(urls, dict) or not all(isinstance(url, str) for url in urls.values()):
        raise TypeError("urls is no dict of a text for each member")
    return urls
