"""Where a run's environments are stepped: on the host or on the device, and on which."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.config.presets import Member, arm_settings, parse_all, resolve
from sauna.config.settings import ON_DEVICE, Config, check_read, local_parts
from sauna.envs.make import is_native
from sauna.envs.probe import Probe, probe, probe_on_device
from sauna.envs.spaces import SMALLEST_IMAGE, Spaces
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.system.jax_setup import configure_jax
from sauna.system.safe_read import JSON_BYTES
from sauna.training.loop.multihost import check_shared, read_place

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
        raise BadInput(
            "device: no NVIDIA GPU here that JAX can use; "
            "`pip install 'sauna-rl[gpu]'` where there is one"
        )
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


def looked_at(config: Config, given: Mapping[str, Any]) -> tuple[Config, Probe]:
    """The config with what depends on the environment; and what was found there.

    Raises:
      BadInput: the environment cannot be used, or leaves a given field unread.
    """
    found = look_at(config)
    config = settle(config, found.spaces)
    check_read_after_settling(found.spaces, config, given)
    return config, found


def check_writes(config: Config) -> None:
    """Refuses to write the run of another machine.

    Raises:
      BadInput: this is not machine 0.
    """
    if read_place(config.distributed).number:
        raise BadInput(
            "distributed: machine 0 writes the run; the others follow it with "
            "`sauna train`, on the command line"
        )


def check_read_after_settling(spaces: Spaces, config: Config, given: Mapping[str, Any]) -> None:
    """Refuses what the environment's spaces leave unread.

    Raises:
      BadInput: naming the field.
    """
    _check_placement(config, given)
    names = ("hidden", "activation", "clip_observations")
    check_read([config], {name: given[name] for name in names if name in given})
    if "log_std_init" in given and spaces.action_kind != "continuous":
        raise BadInput(f"log_std_init: not read with {spaces.action_kind} actions")
    if parse_all(given).get("rescale_actions") and spaces.action_kind != "continuous":
        raise BadInput(f"rescale_actions: not read with {spaces.action_kind} actions")
    wanted = "normalize_observations" in given and resolve(given).normalize_observations
    if wanted and not config.normalize_observations:
        raise BadInput(
            f"normalize_observations: {spaces.observation_kind} observations have "
            f"no running moments"
        )


def _check_placement(config: Config, given: Mapping[str, Any]) -> None:
    """Refuses what the place of the environments leaves unread.

    Raises:
      BadInput: naming the field.
    """
    for name in given:
        if name in ON_DEVICE and config.backend != "device":
            raise BadInput(f"{name}: only read with backend device")
    asked = parse_all(given).get("processes", 0)
    if _together(config) and asked > 1:
        raise BadInput(f"processes: {asked} asked for, but all members and devices are one program")


def _together(config: Config) -> bool:
    """Whether one program trains all members, on a GPU or on several devices."""
    several = config.device == "gpu" or config.devices > 1 or bool(config.distributed)
    return config.backend == "device" and several


def check_own_parts(config: Config, spaces: Spaces) -> None:
    """Looks at what of a run is the user's own: a mistake there is bad input.

    Raises:
      BadInput: a part cannot be used.
    """
    if any(":" in name for name in (config.network, config.filter, config.vex_target)):
        configure_jax()
        from sauna.training.check_plugins import check_plugins

        check_plugins(config, spaces)


def settle(config: Config, spaces: Spaces) -> Config:
    """Replaces what depends on the environment or the machine by what it comes to.

    Raises:
      BadInput: the network does not fit the observations.
    """
    image = spaces.observation_kind == "image"
    large = image and min(spaces.observation_shape[:2]) >= SMALLEST_IMAGE
    network = config.network
    if network == "auto":
        network = "nature-cnn" if large else "mlp"
    if network == "nature-cnn" and not large:
        least = f" (it needs {SMALLEST_IMAGE} x {SMALLEST_IMAGE} pixels)" * image
        raise BadInput(
            f"network: {network} does not fit {spaces.observation_kind} observations of shape "
            f"{spaces.observation_shape}{least}"
        )
    number = len(config.arm) * len(config.seeds)
    processes = config.processes or os.cpu_count() or 1
    if config.backend == "device" and config.devices > 1:
        check_shared("devices", number, config.envs, config.devices)
    if _together(config):
        processes = 1
    return dataclasses.replace(
        config,
        network=network,
        normalize_observations=config.normalize_observations
        and spaces.observation_kind == "vector",
        processes=min(processes, number),
    )


def drop_rates_of(everyone: list[Member]) -> list[list[float]]:
    """Per member, the drop rate that the run it repeats had in every iteration.

    Raises:
      BadInput: that run is not complete, lacks a seed, is not of exactly one filtered arm, or has
        more rates than `config.json` can hold.
    """
    source = everyone[0].config.drop_rate_from
    if not source:
        return []
    arms = run_directory.read_config(Path(source))["config"]["arm"]
    filtered = [arm for arm in arms if arm_settings(arm)["filter"] != "none"]
    if len(filtered) != 1:
        raise BadInput(f"drop_rate_from: {source} has {len(filtered)} filtered arms; it needs one")
    if not run_directory.is_complete(Path(source)):
        raise BadInput(f"drop_rate_from: {source} is not complete")
    rates: dict[int, list[float]] = {}
    for row in run_directory.rows(Path(source)):
        if row["arm"] == filtered[0]:
            rates.setdefault(row["seed"], []).append(1.0 - row["keep_rate"])
    for member in everyone:
        if member.seed not in rates:
            raise BadInput(f"drop_rate_from: {source} has no rows of seed {member.seed}")
    found = [rates[member.seed] for member in everyone]
    if len(json.dumps(found)) > JSON_BYTES // 2:  # what cannot be read again is not begun
        raise BadInput(
            f"drop_rate_from: {source} has {max(map(len, found))} iterations, too many "
            f"to repeat for {len(found)} seeds in one run"
        )
    return found
