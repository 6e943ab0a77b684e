"""From what a user gives to what is trained: resolved, placed, and its environment looked at."""

from __future__ import annotations

import importlib.util
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sauna.config.checks import check_read, check_read_here, local_parts, own_parts
from sauna.config.choices import BOUNDED
from sauna.config.presets import Member, RunConfig, parse_all, resolve_run
from sauna.config.settings import Config
from sauna.envs.make import is_native
from sauna.envs.pictures import SMALLEST_IMAGE
from sauna.envs.probe import Probe, probe, probe_on_device
from sauna.envs.spaces import Spaces, board_of, seen_spaces
from sauna.envs.wrapping import wrapping_of
from sauna.system.errors import BadInput
from sauna.system.imports import uncollected
from sauna.system.jax_setup import configure_jax
from sauna.training.loop.multihost import check_split, read_host_rank

if TYPE_CHECKING:
    from sauna.training.loop.job import Job

MAX_STEPS = 2**31 - 1  # that the device's counters hold
MAX_PREDICTED = 4096  # numbers that an auxiliary head predicts


class Prepared(NamedTuple):
    """A run that can be trained.

    Attributes:
      run: its settings, with all that depends on the machine and the environment decided.
      found: what is known of its environment.
    """

    run: RunConfig
    found: Probe

    @property
    def spaces(self) -> Spaces:
        """Those of its environment."""
        return self.found.spaces

    @property
    def differs(self) -> str | None:
        """How two equal episodes of the environment differed; None if it repeats itself."""
        return self.found.differs

    @property
    def config(self) -> Config:
        """What all members share."""
        return self.run.config

    @property
    def members(self) -> list[Member]:
        """What is trained, arm by arm and seed by seed."""
        return self.run.members

    def job(self, chosen: Sequence[int] | None = None, **more: Any) -> Job:
        """Makes the `Job` of the `chosen` members (by index; None: all), from its start.

        Args:
          more: fields of `Job` that are not at their defaults.
        """
        from sauna.training.loop.job import Job

        members = self.members
        picked = members if chosen is None else [members[i] for i in chosen]
        kwargs = json.loads(self.config.env_kwargs)
        return Job(self.config, self.spaces, kwargs, picked, **{"replay": not self.differs, **more})


def prepare(overrides: Mapping[str, Any]) -> Prepared:
    """Prepares a run with the settings that a user gives.

    Raises:
      BadInput: the settings or the environment cannot be used.
    """
    return examine(place(resolve_run(overrides)), overrides)


def place(run: RunConfig) -> RunConfig:
    """Decides where the environments run, and on what.

    Raises:
      BadInput: a setting that is not read there.
    """
    config = run.config
    if ":" in config.env and has_gpu() and not local_parts(config):
        configure_jax()  # before the user's module makes its first array, on the GPU
    if config.backend == "auto" and is_native(config.env, json.loads(config.env_kwargs)):
        run = run.replace(backend="device")
        config = run.config
    if config.device == "gpu" and not has_gpu():
        raise BadInput(
            "device: no NVIDIA GPU here that JAX can use; "
            "`pip install 'sauna-rl[gpu]'` where there is one"
        )
    if config.backend != "device":
        return run
    if config.env_processes:
        raise BadInput("env_processes: not read with backend device")
    if read_host_rank(config.distributed).hosts > 1 and config.devices:
        raise BadInput("devices: not read with distributed, where every device takes part")
    most = config.steps * (config.max_env_steps_factor if config.budget == "kept" else 1)
    if most > MAX_STEPS:
        raise BadInput(f"steps: the device counts to {MAX_STEPS}, not to {most}")
    if config.device == "auto":
        return run.replace(device="gpu" if has_gpu() else "cpu")
    return run


def has_gpu() -> bool:
    """Finds, without importing JAX, whether there is an NVIDIA GPU that JAX may use."""
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


def examine(run: RunConfig, overrides: Mapping[str, Any], found: Probe | None = None) -> Prepared:
    """Looks at the environment of a placed run, and decides what depends on it.

    Args:
      run: see `place`.
      overrides: what the user gives, each of which something has to read.
      found: what is known of the environment already.

    Raises:
      BadInput: the environment cannot be used, or leaves something that is given unread.
    """
    found = found or look_at(run.config)
    run = _settle(run, found.spaces)
    _check_together(run, found)
    parsed = parse_all(overrides)
    check_read_here(run.config, found.spaces, parsed)
    reading = run
    if found.spaces.is_combined:  # an MLP stands behind the pictures' networks
        reading = run.replace(network="mlp")
    check_read(list(reading.arms.values()), parsed)
    asked = parsed.get("processes", 0)
    if _together(run.config) and asked > 1:
        raise BadInput(f"processes: {asked} asked for, but all members and devices are one program")
    return Prepared(run, found)


def look_at(config: Config) -> Probe:
    """Learns what has to be known of the environment before a run starts."""
    kwargs = json.loads(config.env_kwargs)
    if config.backend != "device":
        return probe(config.env, kwargs, wrapping_of(config))
    with uncollected():
        if local_parts(config):  # trained in this process
            configure_jax(config.devices if config.device == "cpu" else 0, config.device)
        else:
            configure_jax()
        return probe_on_device(config.env, kwargs, wrapping_of(config))


def check_writes(config: Config) -> None:
    """Refuses to write the run of another machine.

    Raises:
      BadInput: this is not machine 0.
    """
    if read_host_rank(config.distributed).rank:
        raise BadInput(
            "distributed: machine 0 writes the run; the others follow it with "
            "`sauna train`, on the command line"
        )


def _together(config: Config) -> bool:
    """Returns whether one program trains all members, on a GPU or on several devices."""
    several = config.device == "gpu" or config.devices > 1 or bool(config.distributed)
    return config.backend == "device" and several


def check_own_parts(prepared: Prepared) -> None:
    """Looks at what of a run is the user's own, and at rules' arguments: a mistake is bad input.

    Raises:
      BadInput: a part cannot be used.
    """
    config = prepared.config
    numbers = (
        config.sampler_kwargs,
        config.loss_weight_kwargs,
        config.stop_kwargs,
        config.optimizer_kwargs,
    )
    rules = any(text != "{}" for text in numbers) or config.control == "stride"
    rules |= config.normalize_over == "kept" or config.selection_losses == "policy"
    if own_parts(config) or rules:
        configure_jax()
        from sauna.training.check_plugins import check_plugins

        check_plugins(prepared.config, prepared.spaces)


def _check_together(run: RunConfig, found: Probe) -> None:
    """Refuses what rows that act together cannot do.

    Raises:
      BadInput: with the one line that says which.
    """
    config, group = run.config, found.group
    if group is None:
        return
    if config.env_processes:
        raise BadInput(f"env_processes: not read by {config.env}, which steps its rows by itself")
    if group and config.recurrent != "none":
        raise BadInput("recurrent: a policy of several agents cannot be recurrent; give none")
    _check_filter(config, found)
    if group and config.envs % group:
        raise BadInput(f"envs: {config.envs} is no multiple of the {group} agents of {config.env}")


def _check_filter(config: Config, found: Probe) -> None:
    """Refuses a step filter that rows which act together cannot have.

    Raises:
      BadInput: rows may wait, or would have to replace a step.
    """
    if config.filter == "none" and config.gae_over != "kept":
        return
    without = "an arm without a filter (ppo, or a sampler)"
    if found.may_wait and found.group:
        raise BadInput(f"arm: a step filter cannot pass over agents that wait; give {without}")
    if found.may_wait:
        raise BadInput(
            f"arm: {config.env} begins episodes in autoreset mode NEXT_STEP, and a step filter "
            f"cannot pass over its void steps; use mode SAME_STEP, or {without}"
        )
    if config.dropped == "replace":
        raise BadInput(
            "dropped: --dropped replace needs environments that step independently, unlike "
            f"{config.env}; give mask (--dropped mask)"
        )


def _network(config: Config, spaces: Spaces) -> str:
    """Picks the network that `auto` stands for.

    Args:
      spaces: as the network sees them.

    Raises:
      BadInput: the one that is named does not fit the observations.
    """
    shapes = spaces.picture_shapes
    picture = bool(shapes)
    large = picture and min(min(shape[:2]) for shape in shapes) >= SMALLEST_IMAGE
    if config.network == "auto":
        return "nature-cnn" if large else "small-cnn" if picture else "mlp"
    fits = large if config.network == "nature-cnn" else picture or bool(board_of(spaces))
    if config.network.endswith("-cnn") and not fits:
        least = f" (it needs {SMALLEST_IMAGE} x {SMALLEST_IMAGE} pixels)" * picture
        raise BadInput(
            f"network: {config.network} does not fit {spaces.observation_kind} observations of "
            f"shape {spaces.observation_shape}{least}"
        )
    return config.network


def _settle(run: RunConfig, spaces: Spaces) -> RunConfig:
    """Replaces what depends on the environment or the machine by what it comes to.

    Raises:
      BadInput: the network does not fit the observations, or the distribution the actions.
    """
    config = run.config
    network = _network(config, seen_spaces(spaces))
    predicted = math.prod(spaces.observation_shape)
    if config.auxiliary != "none" and predicted > MAX_PREDICTED:
        raise BadInput(
            f"auxiliary: an observation has {predicted:,} numbers; a head predicts at most "
            f"{MAX_PREDICTED:,}"
        )
    if config.distribution in BOUNDED and not spaces.action_bounded:
        raise BadInput(
            f"distribution: {config.distribution} needs bounds of every action; {config.env} has "
            "components without (gaussian and gsde do not need them)"
        )
    number = len(run.members)
    processes = config.processes or os.cpu_count() or 1
    if config.backend == "device" and config.devices > 1:
        check_split("devices", number, config.envs, config.devices)
    if _together(config):
        processes = 1
    return run.replace(
        network=network,
        normalize_observations=config.normalize_observations and spaces.normalized > 0,
        processes=min(processes, number),
    )
