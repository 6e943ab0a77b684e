"""Weights & Biases: one run per member, grouped by the run directory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.system.safe_write import own_folder
from sauna.training.tracking.tracker import TrackedRun, Tracker, scalars


class WandB(Tracker):
    """Offline with `WANDB_MODE=offline`; its files are under `RUN/wandb`."""

    def __init__(self) -> None:
        self._runs: dict[str, Any] = {}

    def open(self, run: TrackedRun) -> dict[str, Any]:
        import wandb

        ids = run.before.get("ids", {})
        own_folder(run.path / "wandb")
        for name, settings in run.members.items():
            self._runs[name] = opened = wandb.init(
                project=run.project,
                id=ids.get(name),
                resume="allow",
                name=f"{run.path.name} {name}",
                group=run.path.name,
                job_type=settings["arm"],
                notes=run.note,
                config={**settings, "run_directory": str(run.path)},
                allow_val_change=True,
                dir=str(run.path),
                reinit="create_new",
                settings=wandb.Settings(silent=True, console="off"),
            )
            opened.define_metric("env_steps")
            opened.define_metric("*", step_metric="env_steps")
        urls = {name: opened.url for name, opened in self._runs.items() if _is_online(opened)}
        return {"ids": {name: one.id for name, one in self._runs.items()}, "urls": urls}

    def row(self, row: Mapping[str, Any]) -> None:
        self._runs[row["member"]].log({"env_steps": row["env_steps"], **scalars(row)})

    def picture(self, name: str, path: Path) -> None:
        import wandb

        for opened in self._runs.values():
            opened.log({name: wandb.Image(str(path))})

    def summary(self, members: Mapping[str, Mapping[str, Any]], complete: bool) -> None:
        for name, numbers in members.items():
            self._runs[name].summary.update({f"final/{key}": x for key, x in numbers.items()})

    def close(self) -> None:
        for opened in self._runs.values():
            opened.finish()


def _is_online(opened: Any) -> bool:
    return str(opened.settings.mode) in ("online", "shared")
