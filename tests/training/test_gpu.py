"""What only an accelerator can show: a population there learns what the CPU learns.

Each run trains in processes of its own: JAX of this one is set up for the CPU.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import sauna
from sauna.system import checkpoint
from sauna.training.prepare import has_gpu

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.processes,
    pytest.mark.skipif(not has_gpu(), reason="needs an NVIDIA GPU and JAX with CUDA"),
]
SETTINGS: dict[str, Any] = {
    "envs": 8,
    "rollout_steps": 32,
    "minibatches": 4,
    "epochs": 2,
    "hidden": "16,16",
    "seeds": 2,
    "steps": 1024,
    "checkpoint_every": 1,
}
ENV = "gymnax/CartPole-v1"


HOST: dict[str, Any] = {"env": "CartPole-v1", "processes": 1}
PLACES: dict[str, dict[str, Any]] = {
    "the device": {},
    "the host": HOST,
    "the host, a memory": {
        **HOST,
        "recurrent": "lstm",
        "recurrent_width": 8,
        "sequence_length": 8,
    },
}


def trained(out: Path, device: str, **more: Any) -> Path:
    sauna.train(out=str(out), device=device, **{"env": ENV, **SETTINGS, **more})
    return out


def rows(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(
    "arm, place",
    [
        ("ppo", "the device"),
        ("sauna", "the device"),
        ("top-advantage", "the device"),
        ("sauna", "the host"),
        ("ppo", "the host, a memory"),
    ],
)
def test_the_first_update_is_that_of_the_cpu_up_to_rounding(
    arm: str, place: str, tmp_path: Path
) -> None:
    own = {**PLACES[place], "arm": arm}
    found = [rows(trained(tmp_path / device, device, **own)) for device in ("gpu", "cpu")]
    for one, other in zip(*found, strict=True):
        if one["iteration"] == 0:  # later, rounding decides which actions are drawn
            for name in ("policy_loss", "value_loss", "entropy", "kept_steps"):
                assert one[name] == pytest.approx(other[name], rel=1e-3, abs=1e-4), name


def test_a_run_on_the_gpu_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    run = trained(tmp_path / "run", "gpu", keep_checkpoints=9)
    whole = rows(run)
    (run / "summary.json").unlink()  # as if it had been killed after its first checkpoint
    for path in checkpoint.numbered(run / "checkpoints")[1:]:
        shutil.rmtree(path)
    sauna.resume(run)
    again = rows(run)
    assert [row["env_steps"] for row in again] == [row["env_steps"] for row in whole]
    second = [row for row in whole if row["iteration"] == 1]
    for one, other in zip(second, (r for r in again if r["iteration"] == 1), strict=True):
        assert one["value_loss"] == pytest.approx(other["value_loss"], rel=1e-3, abs=1e-4)
