"""MLflow: one run per member in the experiment of `--track-project`."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.training.tracking.tracker import TrackedRun, Tracker, scalars

# A server that does not answer is given up after this, and not after some minutes.
PATIENCE = {"MLFLOW_HTTP_REQUEST_TIMEOUT": "10", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1"}
MAX_TEXT = 500  # characters of a parameter


class MLflow(Tracker):
    """Where `MLFLOW_TRACKING_URI` says, by default `mlflow.db` of the working folder."""

    def __init__(self) -> None:
        self._runs: dict[str, str] = {}
        self._complete = False

    def open(self, run: TrackedRun) -> dict[str, Any]:
        for name, value in PATIENCE.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient

        logging.getLogger("mlflow").setLevel(logging.WARNING)
        self._client = MlflowClient()
        self._runs = dict(run.before.get("ids", {}))
        for member, settings in run.members.items():
            if member in self._runs:
                self._client.update_run(self._runs[member], status="RUNNING")
            else:
                self._runs[member] = self._created(run, member, settings)
        uri = str(self._client.tracking_uri)
        urls = {}
        if uri.startswith("http"):
            place = f"{uri.rstrip('/')}/#/experiments/{self._experiment(run.project)}/runs"
            urls = {member: f"{place}/{number}" for member, number in self._runs.items()}
        return {"ids": self._runs, "urls": urls}

    def _experiment(self, name: str) -> str:
        found = self._client.get_experiment_by_name(name)
        return str(found.experiment_id if found else self._client.create_experiment(name))

    def _created(self, run: TrackedRun, member: str, settings: Mapping[str, Any]) -> str:
        from mlflow.entities import Param

        tags = {"mlflow.note.content": run.note, "sauna.run_directory": str(run.path)}
        made = self._client.create_run(
            self._experiment(run.project), run_name=f"{run.path.name} {member}", tags=tags
        )
        params = [Param(name, str(value)[:MAX_TEXT]) for name, value in settings.items()]
        self._client.log_batch(made.info.run_id, params=params[:100])
        self._client.log_batch(made.info.run_id, params=params[100:])
        return str(made.info.run_id)

    def row(self, row: Mapping[str, Any]) -> None:
        from mlflow.entities import Metric

        now, step = int(1000 * time.time()), row["env_steps"]
        metrics = [Metric(name, float(x), now, step) for name, x in scalars(row).items()]
        self._client.log_batch(self._runs[row["member"]], metrics=metrics)

    def picture(self, name: str, path: Path) -> None:
        for number in self._runs.values():
            self._client.log_artifact(number, str(path))

    def summary(self, members: Mapping[str, Mapping[str, Any]], complete: bool) -> None:
        from mlflow.entities import Metric

        self._complete, now = complete, int(1000 * time.time())
        for member, numbers in members.items():
            metrics = [
                Metric(f"final/{name}", float(x), now, 0)
                for name, x in numbers.items()
                if isinstance(x, int | float)
            ]
            self._client.log_batch(self._runs[member], metrics=metrics)

    def close(self) -> None:
        for number in self._runs.values():
            self._client.set_terminated(number, "FINISHED" if self._complete else "KILLED")
