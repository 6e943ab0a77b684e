"""Where a run's environments are stepped: on the host or on the device, and on which."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
from pathlib import Path

from sauna.config.settings import Config, local_parts
from sauna.envs.make import is_native
from sauna.envs.probe import Probe, probe, probe_on_device
from sauna.machines import read_place
from sauna.system.errors import BadInput
from sauna.system.jax_setup import configure_jax

MOST_STEPS = 2**31 - 1  # that the device's counters hold


def placed(config: Config) -> Config:
    """Resolves where the environments run, and on what.

    Raises:
      BadInput: a setting that is not read there.
    """
    if ":" in config.env and has_gpu() and not local_parts(config):
        configure_jax()  # before the user's module makes its first array, on the GPU
    if config.backend == "auto" and is_native(config.env, json.loads(config.env_kwargs)):
        config = dataclasses.replace(config, backend="device")
    if config.backend != "device":
        return config
    if config.env_processes:
        raise BadInput("env_processes: not read with backend device")
    if read_place(config.distributed).machines > 1 and config.devices:
        raise BadInput("devices: not read with distributed, where every device takes part")
    most = config.steps * (config.max_env_steps_factor if config.budget == "kept" else 1)
    if most > MOST_STEPS:
        raise BadInput(f"steps: the device counts to {MOST_STEPS}, not to {most}")
    device = config.device
    if device == "gpu" and not has_gpu():
        raise BadInput("device: no NVIDIA GPU here that JAX can use; "
                       "`pip install 'sauna-rl[gpu]'` where there is one")  # fmt: skip
    if device == "auto":
        device = "gpu" if has_gpu() else "cpu"
    return dataclasses.replace(config, device=device)


def has_gpu() -> bool:
    """Whether there is an NVIDIA GPU and a JAX that may use it; found without importing JAX."""
    drivers = ("/proc/driver/nvidia/version", "/usr/lib/wsl/lib/libcuda.so.1")
    plugins = ("jax_cuda12_plugin", "jax_cuda13_plugin")
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1")
    platforms = os.environ.get("JAX_PLATFORMS") or "cuda"
    return (
        not hidden
        and bool({"cuda", "gpu"} & set(platforms.split(",")))
        and any(Path(path).exists() for path in drivers)
        and any(importlib.util.find_spec(name) is not None for name in plugins)
    )


def look_at(config: Config) -> Probe:
    """What has to be known of the environment before a run starts."""
    kwargs = json.loads(config.env_kwargs)
    if config.backend != "device":
        return probe(config.env, kwargs)
    if local_parts(config):  # trained in this process
        configure_jax(config.devices if config.device == "cpu" else 0, config.device)
    else:
        configure_jax()
    return probe_on_device(config.env, kwargs)
