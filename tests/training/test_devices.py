"""A population shared over several devices, and over several machines."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from helpers import SMALL, TESTS, train_here
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.training import prepare
from sauna.training.coordinator import _environment
from sauna.training.loop.device_program import make_mesh
from sauna.training.loop.multihost import HostRank, read_host_rank

HOST = "small_envs:Scripted"
SETTINGS = [
    "jax_envs:walk",
    "--arm",
    "sauna",
    "--threshold",
    "0.9",
    "--envs",
    "8",
    "--rollout-steps",
    "32",
    "--minibatches",
    "4",
    "--epochs",
    "2",
    "--hidden",
    "8,8",
    "--steps",
    "2000",
]


def start(out: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sauna", "train", *SETTINGS, "--out", str(out), *more]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=TESTS,
    )


def free_address() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def finished(process: subprocess.Popen[str]) -> str:
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 0, output
    return output


def assert_same_training(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> None:
    """The same to rounding: 1e-4 of each loss after a few iterations, and every count equal."""
    assert len(ours) == len(theirs) > 3
    for one, other in zip(ours, theirs, strict=True):
        for name in ("member", "env_steps", "kept_steps", "episodes"):
            assert one[name] == other[name]
        for name in ("policy_loss", "value_loss", "vex_loss", "entropy", "gradient_norm"):
            np.testing.assert_allclose(one[name], other[name], rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_eight_devices_give_what_one_gives(tmp_path: Path) -> None:
    finished(start(tmp_path / "one", "--seeds", "2", "--processes", "1"))
    finished(start(tmp_path / "eight", "--seeds", "2", "--devices", "8"))
    assert_same_training(
        run_directory.rows(tmp_path / "one"), run_directory.rows(tmp_path / "eight")
    )


@pytest.mark.slow
def test_two_machines_train_one_member_together(tmp_path: Path) -> None:
    address = free_address()
    other = start(tmp_path / "none", "--distributed", f"{address},2,1")
    output = finished(start(tmp_path / "both", "--distributed", f"{address},2,0"))
    finished(other)
    assert "compiled in" in output
    assert not (tmp_path / "none").exists(), "machine 0 alone writes"
    finished(start(tmp_path / "one"))
    assert_same_training(
        run_directory.rows(tmp_path / "one"), run_directory.rows(tmp_path / "both")
    )


@pytest.mark.slow
def test_machines_with_other_settings_do_not_train_together(tmp_path: Path) -> None:
    address = free_address()
    other = start(tmp_path / "none", "--distributed", f"{address},2,1", "--checkpoint-every", "3")
    first = start(tmp_path / "both", "--distributed", f"{address},2,0")
    for process in (first, other):
        output, _ = process.communicate(timeout=500)
        assert process.returncode in (1, 2) and "different settings" in output


def test_only_machine_0_writes_a_run(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="machine 0 writes the run"):
        sauna.train("jax_envs:walk", distributed="h:1,2,1", quiet=True, out=tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_devices_that_would_be_idle_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"3 members of 4 environments .* evenly over 5 devices"):
        sauna.train(
            "jax_envs:walk",
            seeds=3,
            envs=4,
            devices=5,
            device="cpu",
            quiet=True,
            out=tmp_path / "run",
        )
    assert list(tmp_path.iterdir()) == []


def test_one_program_is_not_shared_over_processes(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"processes: 3 asked for, but .* one program"):
        sauna.train(
            "jax_envs:walk",
            seeds=4,
            envs=4,
            devices=2,
            device="cpu",
            processes=3,
            quiet=True,
            out=tmp_path / "run",
        )
    assert list(tmp_path.iterdir()) == []


def test_a_run_on_the_device_is_never_resumed_inexactly(tmp_path: Path) -> None:
    run = tmp_path / "run"
    sauna.train("jax_envs:walk", quiet=True, out=run, **SMALL)
    (run / "summary.json").unlink()
    with pytest.raises(BadInput, match="inexact: a run on the device"):
        sauna.resume(run, inexact=True, quiet=True)
    assert (run / "metrics.jsonl").exists()


@pytest.mark.parametrize(
    "variables, usable",
    [
        ({}, True),
        ({"CUDA_VISIBLE_DEVICES": "1"}, True),
        ({"CUDA_VISIBLE_DEVICES": ""}, False),
        ({"CUDA_VISIBLE_DEVICES": "-1"}, False),
        ({"JAX_PLATFORMS": "cpu"}, False),
        ({"JAX_PLATFORMS": "cuda,cpu"}, True),
    ],
)
def test_a_gpu_that_is_hidden_is_not_used(
    variables: dict[str, str], usable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("CUDA_VISIBLE_DEVICES", "JAX_PLATFORMS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(prepare.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(prepare.Path, "exists", lambda path: "nvidia" in str(path))
    assert prepare.has_gpu() == usable


def test_without_a_gpu_none_is_taken_for_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environments on the host learn on the CPU, unless a GPU is asked for that is there."""
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert prepare.prepare({"env": HOST, "device": "cpu"}).config.device == "cpu"
    for env in (HOST, "jax_envs:walk"):
        with pytest.raises(BadInput, match="device: no NVIDIA GPU here"):
            prepare.prepare({"env": env, "device": "gpu"})


@pytest.mark.parametrize("device, platform", [("auto", "cpu"), ("cpu", "cpu"), ("gpu", "cuda")])
def test_environments_on_the_host_learn_on_the_gpu_that_is_asked_for(
    device: str, platform: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prepare, "has_gpu", lambda: True)
    prepared = prepare.prepare({"env": HOST, "device": device})
    assert _environment(prepared.config)["JAX_PLATFORMS"] == platform
    if device == "gpu":  # this process has set up JAX for the CPU
        with pytest.raises(BadInput, match="device: JAX uses the cpu here, not the gpu"):
            train_here(prepared.job())


@pytest.mark.parametrize(
    "members, envs, devices, shape",
    [
        (1, 8, 1, None),
        (4, 3, 2, (2, 1)),
        (1, 8, 4, (1, 4)),
        (2, 8, 8, (2, 4)),
        (3, 5, 2, None),
        (6, 4, 8, (2, 4)),
    ],
)
def test_a_mesh_takes_as_many_devices_as_divide_the_work(
    members: int, envs: int, devices: int, shape: tuple[int, int] | None
) -> None:
    mesh = make_mesh(members, envs, [f"device {i}" for i in range(devices)])
    assert (None if mesh is None else mesh.devices.shape) == shape


def test_places_are_read_or_refused() -> None:
    assert read_host_rank("") == HostRank("", 1, 0)
    assert read_host_rank("host:1234,4,3") == HostRank("host:1234", 4, 3)
    for text in ("host,2,0", "host:1,2", "host:1,2,2", "host:1,1,0", "host:1,a,0"):
        with pytest.raises(BadInput, match="distributed"):
            read_host_rank(text)
