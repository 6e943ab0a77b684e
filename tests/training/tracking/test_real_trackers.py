"""Weights & Biases, trackio and MLflow as they are installed, without a network.

    pip install 'sauna-rl[wandb,trackio,mlflow]'

wandb waits for a service process, and MLflow makes a database.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sauna.config.presets import resolve_run
from sauna.training.tracking.trackers import Trackers

pytestmark = pytest.mark.slow
CLOCK = {"steps_per_second": 100.0, "wall_seconds": 2.0}
BLOCK, HEADER = 32768, 7  # of LevelDB's log format, in which wandb writes


def rows(*steps: int) -> list[dict[str, Any]]:
    return [
        {"member": f"ppo/{seed}", "arm": "ppo", "seed": seed, "env_steps": s, "kl": s / 100 + seed}
        for s in steps
        for seed in (0, 1)
    ]


def track_twice(path: Path, name: str) -> list[str]:
    """Two members, three rows each, the last after a resume; a picture and a summary."""
    from PIL import Image

    figure = path / "curve.png"
    Image.new("RGB", (8, 8)).save(figure)
    run = resolve_run({"env": "x", "seeds": 2, "track": name, "track_project": "tests"})
    said: list[str] = []
    for number, steps in enumerate([(10, 20), (30,)]):
        trackers = Trackers(path, run.config, run.members, said.append, {})
        trackers.open()
        trackers.rows(rows(*steps), CLOCK)
        if number:
            trackers.summary({f"ppo/{seed}": {"return_mean": 1.5} for seed in (0, 1)}, True)
            trackers.picture("learning_curve", figure)
        trackers.close()
    return said


def check(points: list[tuple[float, float]], seed: int) -> None:
    np.testing.assert_allclose(points, [(10, 0.1 + seed), (20, 0.2 + seed), (30, 0.3 + seed)])


def wandb_records(file: Path) -> Iterator[Any]:
    from wandb.proto import wandb_internal_pb2

    blob, at, whole = file.read_bytes(), HEADER, b""
    while at + HEADER <= len(blob):
        if BLOCK - at % BLOCK < HEADER:
            at += BLOCK - at % BLOCK
            continue
        size, kind = int.from_bytes(blob[at + 4 : at + 6], "little"), blob[at + 6]
        whole += blob[at + HEADER : at + HEADER + size]
        at += HEADER + size
        if kind in (1, 4):  # whole, or the last part
            yield wandb_internal_pb2.Record.FromString(whole)
            whole = b""


def test_wandb_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb", reason="needs `pip install 'sauna-rl[wandb]'`")
    monkeypatch.setenv("WANDB_MODE", "offline")
    assert track_twice(tmp_path, "wandb") == []
    wandb.teardown()  # waits for its service, which still writes
    folders = sorted((tmp_path / "wandb").glob("offline-run-*"))
    assert len(folders) == 4 and len({folder.name.split("-")[-1] for folder in folders}) == 2
    seen: dict[str, list[tuple[float, float]]] = {}
    for folder in folders:
        name = ""
        for record in wandb_records(next(folder.glob("run-*.wandb"))):
            if record.HasField("run"):
                name = record.run.display_name
                assert record.run.notes == f"run directory: {tmp_path}"
                assert record.run.project == "tests" and record.run.run_group == tmp_path.name
            items = {(i.key or i.nested_key[0]): i.value_json for i in record.history.item}
            if "kl" in items:
                point = float(items["env_steps"]), float(items["kl"])
                seen.setdefault(name, []).append(point)
    for seed in (0, 1):
        check(seen[f"{tmp_path.name} ppo/{seed}"], seed)
    assert (
        len(list((tmp_path / "wandb").glob("offline-run-*/files/media/images/learning_curve*.png")))
        == 2
    )


def test_trackio_local(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    trackio = pytest.importorskip("trackio", reason="needs `pip install 'sauna-rl[trackio]'`")
    from trackio.sqlite_storage import SQLiteStorage

    assert track_twice(tmp_path, "trackio") == []
    found = {run.name: run.config for run in trackio.Api().runs("tests")}
    assert set(found) == {f"{tmp_path.name} ppo/{seed}" for seed in (0, 1)}
    for seed in (0, 1):
        name = f"{tmp_path.name} ppo/{seed}"
        assert found[name]["run_directory"] == str(tmp_path) and found[name]["seed"] == seed
        logs = SQLiteStorage.get_logs("tests", name)
        points = [(log["step"], log["kl"]) for log in logs if "kl" in log]
        check(points, seed)
        assert [log["final/return_mean"] for log in logs if "final/return_mean" in log] == [1.5]
        assert any("learning_curve" in log for log in logs)


def test_mlflow_in_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mlflow", reason="needs `pip install 'sauna-rl[mlflow]'`")
    from mlflow import MlflowClient

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    assert track_twice(tmp_path, "mlflow") == []
    client = MlflowClient()
    runs = client.search_runs([client.get_experiment_by_name("tests").experiment_id])
    assert {run.info.run_name for run in runs} == {f"{tmp_path.name} ppo/{s}" for s in (0, 1)}
    for run in runs:
        seed = int(run.data.params["seed"])
        assert run.info.status == "FINISHED" and run.data.params["member"] == f"ppo/{seed}"
        assert run.data.tags["mlflow.note.content"] == f"run directory: {tmp_path}"
        history = client.get_metric_history(run.info.run_id, "kl")
        points = [(metric.step, metric.value) for metric in history]
        check(points, seed)
        assert run.data.metrics["final/return_mean"] == 1.5
        assert [file.path for file in client.list_artifacts(run.info.run_id)] == ["curve.png"]


WITHOUT_A_KEY = """
from pathlib import Path
from sauna.config.presets import resolve_run
from sauna.training.tracking.trackers import Trackers
run = resolve_run({"env": "x", "track": "wandb"})
trackers = Trackers(Path.cwd(), run.config, run.members, print, {})
trackers.open()
trackers.rows([{"member": "ppo/0", "env_steps": 1, "kl": 0.1}], {})
trackers.close()
"""


def test_wandb_without_a_key_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("wandb", reason="needs `pip install 'sauna-rl[wandb]'`")
    hidden = {"HOME": str(tmp_path), "NETRC": str(tmp_path / "netrc"), "WANDB_MODE": "online"}
    environment = {k: v for k, v in os.environ.items() if k != "WANDB_API_KEY"} | hidden
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_A_KEY],
        cwd=tmp_path,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    (line,) = done.stdout.splitlines()
    assert done.returncode == 0
    assert line.startswith("warning: wandb ended, the training goes on: ")
