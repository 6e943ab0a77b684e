"""Training the members of one process: collect -> advantages -> update -> log -> save.

This is the loop itself. Who starts it, what is shown of it and where its messages are written is
`run.py`'s business: the loop reads a clock for its timing rows, and otherwise only talks to a
`Reporter`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from sauna.collect.collected import Collected, capacity
from sauna.collect.host import HostCollector
from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.core.population import Keys, Program, make_program, member_keys, minibatch_order
from sauna.core.types import Hypers, TrainState
from sauna.core.update import UpdateMetrics
from sauna.envs.host.contract import HostEnvs
from sauna.envs.make import in_process_envs
from sauna.envs.spaces import Spaces
from sauna.envs.workers import ProcessEnvs
from sauna.member_state import Counters, pack_member, unpack_member
from sauna.metrics.rows import metrics_row
from sauna.selection.filters import scheduled
from sauna.system.errors import SaunaError

Arrays = dict[str, np.ndarray]


class NonFinite(SaunaError):
    """A loss or a parameter is not finite any more."""


class Reporter(Protocol):
    """Where the loop's messages go, and where its permissions come from."""

    def phase(self, text: str) -> None: ...

    def allowance(self, iteration: int) -> int:
        """Waits until iteration `iteration` may start; how many may from there on. 0: stop."""

    def iteration(
        self, iteration: int, rows: list[dict[str, Any]], timing: dict[str, float]
    ) -> None: ...

    def state(self, iteration: int, arrays: Arrays) -> None: ...


class Job(NamedTuple):
    """What one process trains."""

    config: Config
    spaces: Spaces
    env_kwargs: dict[str, Any]
    members: list[Member]
    drop_rates: list[list[float]]  # per member and iteration; empty: the config's constant rate
    restored: Mapping[str, np.ndarray] | None  # a checkpoint's arrays, or None to start afresh
    start: int  # the first iteration to run
    replay: bool  # whether environments can be brought back by replaying


def train_members(job: Job, reporter: Reporter) -> None:
    """Runs every iteration of the job's members, reporting each.

    Raises:
      NonFinite: an update gave a non-finite loss or parameter; nothing of it was reported.
      EnvironmentFailure: from the environments.
    """
    config, members = job.config, job.members
    if config.backend == "device":
        from sauna.device_training import train_on_device

        train_on_device(job, reporter)
        return
    reporter.phase("making environments")
    program = make_program(config, job.spaces)
    keys = [member_keys(member.seed) for member in members]
    envs = make_envs(job)
    try:
        collector = HostCollector(program, job.spaces, envs, keys)
        states, counters = _start(job, program, keys, collector, envs)
        reporter.phase("compiling")
        iteration = job.start
        while any(goes_on(config, c) for c in counters) and reporter.allowance(iteration):
            clock = time.perf_counter()
            hypers = [_hypers(job, p, counters[p], iteration) for p in range(len(members))]
            limit = np.array([_limit(config, c) for c in counters])
            params = np.stack([np.asarray(state.params) for state in states])
            collected = collector.collect(params, hypers, iteration, limit)
            collect_seconds = time.perf_counter() - clock
            rows = []
            for p in np.flatnonzero(limit):
                order = minibatch_order(config, members[p].seed, iteration)
                states[p], learned = _learn(program, states[p], collected[p], hypers[p], order)
                check_finite(members[p], iteration, learned)
                counters[p].add(collected[p])
                rows.append(
                    metrics_row(
                        members[p], config, iteration, collected[p], counters[p], learned,
                        hypers[p],
                    )
                )  # fmt: skip
            timing = {
                "env_steps": sum(collected[p].env_steps for p in np.flatnonzero(limit)),
                "seconds": time.perf_counter() - clock,
                "collect_seconds": collect_seconds,
            }
            reporter.iteration(iteration, rows, timing)
            iteration += 1
            if iteration % config.checkpoint_every == 0:
                reporter.state(
                    iteration, _pack(program, members, states, counters, collector, envs)
                )
        reporter.state(iteration, _pack(program, members, states, counters, collector, envs))
    finally:
        envs.close()


def make_envs(job: Job) -> HostEnvs:
    """The `P * N` environments of the job, in this process or in workers."""
    config = job.config
    seeds = [(member.seed, n) for member in job.members for n in range(config.envs)]
    if config.env_processes:
        processes = min(config.env_processes, len(seeds))
        return ProcessEnvs(
            config.env, job.env_kwargs, seeds, processes, config.env_timeout, config.backend
        )
    return in_process_envs(config.env, job.env_kwargs, seeds, config.backend)


def _start(
    job: Job, program: Program, keys: list[Keys], collector: HostCollector, envs: HostEnvs
) -> tuple[list[TrainState], list[Counters]]:
    states = [program.init(k.init) for k in keys]
    counters = [Counters() for _ in keys]
    collector.start()
    if job.restored is not None:
        for p, member in enumerate(job.members):
            states[p], counters[p] = unpack_member(
                member.name, p, job.restored, states[p], program.policy, collector, envs, job.replay
            )
    return states, counters


def goes_on(config: Config, counters: Counters) -> bool:
    """Whether a whole rollout still fits in the budget: a run never oversteps it."""
    used = counters.kept_steps if config.budget == "kept" else counters.env_steps
    return config.steps - used >= config.rollout_steps * config.envs


def _limit(config: Config, counters: Counters) -> int:
    """Env steps that each env of a member may try in the coming rollout; 0: it has finished."""
    if not goes_on(config, counters):
        return 0
    if config.budget == "kept":
        return capacity(config)
    return min(capacity(config), (config.steps - counters.env_steps) // config.envs)


def _hypers(job: Job, p: int, counters: Counters, iteration: int) -> Hypers:
    rates = job.drop_rates[p] if job.drop_rates else []
    return hypers_now(job.members[p].config, rates, counters, iteration)


def hypers_now(own: Config, drop_rates: list[float], counters: Counters, iteration: int) -> Hypers:
    """A member's traced hyperparameters in this iteration.

    Args:
      own: its config.
      drop_rates: of each iteration; empty: the config's constant one.
    """
    used = counters.kept_steps if own.budget == "kept" else counters.env_steps
    left = 1.0 - used / own.steps
    rate = drop_rates[min(iteration, len(drop_rates) - 1)] if drop_rates else own.drop_rate
    values = {name: getattr(own, name) for name in Hypers._fields}
    values["drop_rate"] = rate
    values["threshold"] = scheduled(own.threshold, own.threshold_schedule, left)
    if own.learning_rate_schedule == "linear":
        values["learning_rate"] = own.learning_rate * left
    return Hypers(**{name: np.float32(value) for name, value in values.items()})  # type: ignore[arg-type]


def _learn(
    program: Program,
    state: TrainState,
    collected: Collected,
    hypers: Hypers,
    order: np.ndarray,
) -> tuple[TrainState, UpdateMetrics]:
    assert collected.rollout is not None
    batch = program.make_batch(collected.rollout, hypers)
    state, metrics = program.learn(state, collected.rollout, batch, hypers, order)
    return state, jax.device_get(metrics)


def check_finite(member: Member, iteration: int, metrics: UpdateMetrics) -> None:
    """Raises:
    NonFinite: naming the member and the iteration.
    """
    if not metrics.finite:
        raise NonFinite(f"{member.name}: the update of iteration {iteration} is not finite")


def _pack(
    program: Program,
    members: list[Member],
    states: list[TrainState],
    counters: list[Counters],
    collector: HostCollector,
    envs: HostEnvs,
) -> Arrays:
    """The whole state of all members, as named arrays."""
    arrays: Arrays = {}
    for p, member in enumerate(members):
        arrays |= pack_member(
            member.name, p, states[p], counters[p], program.policy, collector, envs
        )
    return arrays
