"""trackio (Hugging Face): one run per member, grouped by the run directory."""

from __future__ import annotations

import contextlib
import contextvars
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.training.tracking.tracker import TrackedRun, Tracker, scalars


class Trackio(Tracker):
    """Local, or to a Space with `TRACKIO_SPACE_ID`; `trackio show` shows it."""

    def __init__(self) -> None:
        self._runs: dict[str, Any] = {}
        self._last: dict[str, int] = {}

    def open(self, run: TrackedRun) -> dict[str, Any]:
        import trackio

        names = run.before.get("names", {})
        for member, settings in run.members.items():
            init = contextvars.Context().run  # else it ends the run of the member before
            with contextlib.redirect_stdout(io.StringIO()):
                self._runs[member] = init(
                    trackio.init,
                    project=run.project,
                    name=names.get(member, f"{run.path.name} {member}"),
                    group=run.path.name,
                    config={**settings, "run_directory": str(run.path)},
                    resume="allow" if names else "never",
                    embed=False,
                    auto_log_gpu=False,
                    auto_log_cpu=False,
                )
        urls = {member: str(one.url) for member, one in self._runs.items() if one.url}
        return {"names": {member: one.name for member, one in self._runs.items()}, "urls": urls}

    def row(self, row: Mapping[str, Any]) -> None:
        member, step = row["member"], row["env_steps"]
        self._last[member] = step
        self._runs[member].log({"env_steps": step, **scalars(row)}, step=step)

    def picture(self, name: str, path: Path) -> None:
        import trackio

        for member, opened in self._runs.items():
            opened.log({name: trackio.Image(str(path))}, step=self._last.get(member))

    def summary(self, members: Mapping[str, Mapping[str, Any]], complete: bool) -> None:
        for member, numbers in members.items():
            final = {f"final/{key}": x for key, x in numbers.items() if key not in ("arm", "seed")}
            self._runs[member].log(final, step=self._last.get(member))

    def close(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            for opened in self._runs.values():
                opened.finish()
