"""The Python face: `sauna.train`, `sauna.resume`, `sauna.load`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sauna import run as runs
from sauna import rundir
from sauna.config import name_of
from sauna.metrics.display import Display, PlainDisplay, make_display


class Result:
    """A finished run: its directory, its numbers, its policies."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """The rows of `metrics.jsonl`, one per iteration and member."""
        return rundir.rows(self.path)

    @property
    def summary(self) -> dict[str, Any]:
        """`member name -> final numbers`, as in `summary.json`."""
        return rundir.read_config_file(self.path / "summary.json")["members"]

    def policy(self, member: int | str = 0) -> Any:
        """The trained policy of a member, as `policy(observation) -> action`."""
        return load(self.path, member)

    def __repr__(self) -> str:
        return f"Result({str(self.path)!r})"


class _Silent(PlainDisplay):
    def say(self, text: str) -> None:
        pass


def train(env: Any, *, quiet: bool = False, **settings: Any) -> Result:
    """Trains PPO or SAUNA on `env` and returns the finished run.

    Args:
      env: a Gymnasium id, `module:function`, or a function that makes an environment.
      quiet: show nothing.
      **settings: any field of `sauna.config.Config` (`arm="sauna"`, `seeds=6`, `steps=1_000_000`);
        functions, flax modules, filters and targets may be passed by value.

    Raises:
      BadInput: a setting is not usable; nothing was created.
      SaunaError: training failed; the last good checkpoint is on disk.
    """
    given = {"env": name_of(env)}
    for name, value in settings.items():
        plugin = name in ("network", "filter", "vex_target")
        given[name] = name_of(value) if plugin else value
    if isinstance(given.get("arm"), list | tuple):
        given["arm"] = ",".join(given["arm"])
    if "out" in given:
        given["out"] = str(given["out"])
    display: Display = _Silent() if quiet else make_display()
    run = runs.start(given, display)
    runs.train(run, display, resume=False)
    return Result(run.path)


def resume(
    path: str | Path, *, quiet: bool = False, inexact: bool = False, **changes: Any
) -> Result:
    """Continues an interrupted run to its end; the result is that of a run left alone."""
    display: Display = _Silent() if quiet else make_display()
    run = runs.reopen(Path(path), changes, display)
    runs.train(run, display, resume=True, inexact=inexact)
    return Result(run.path)


def load(path: str | Path, member: int | str = 0) -> Any:
    """The policy of a run's newest good checkpoint."""
    from sauna.trained import TrainedPolicy, load_artifact

    return TrainedPolicy(load_artifact(Path(path)), member)
