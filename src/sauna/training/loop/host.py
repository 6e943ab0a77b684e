"""Training the members of one process: collect -> advantages -> update -> log -> save.

This is the loop itself. Who starts it, what is shown of it and where its messages are written is
`run.py`'s business: the loop reads a clock for its timing rows, and otherwise only talks to a
`Reporter`.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import numpy as np

from sauna.algorithm.learner.metrics import UpdateMetrics
from sauna.algorithm.learner.program import Learner, make_learner
from sauna.algorithm.learner.update import minibatch_order
from sauna.algorithm.rollout.collected import Collected
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import Program, make_program
from sauna.algorithm.types import Hypers, Keys, TrainState, member_keys, selection_key
from sauna.config.presets import Member
from sauna.envs.host.contract import HostEnvs
from sauna.envs.make import in_process_envs
from sauna.envs.workers import ProcessEnvs
from sauna.envs.wrapping import wrapping_of
from sauna.system.checkpoint import under
from sauna.system.jax_setup import check_platform
from sauna.training.loop.budget import budget_left, hypers_now, step_limit
from sauna.training.loop.evaluation import Evaluator, stop_named
from sauna.training.loop.fine_tuning import initial_moments, initial_params
from sauna.training.loop.job import Arrays, Job, Reporter, check_finite
from sauna.training.loop.member_state import (
    Counters,
    moments_of,
    pack_member,
    unpack_member,
)
from sauna.training.loop.metrics import metrics_row
from sauna.training.loop.players import Frozen, host_player


def train_on_host(job: Job, reporter: Reporter) -> None:
    """Runs every iteration of the job's members, reporting each.

    Raises:
      NonFinite: an update gave a non-finite loss or parameter; nothing of it was reported.
      EnvironmentFailure: from the environments.
      BadInput: JAX does not use the GPU that is asked for.
    """
    config, members = job.config, job.members
    reporter.phase("making environments")
    if config.device == "gpu":
        check_platform("gpu")
    program = make_program(config, job.spaces)
    learner = make_learner(config, program.policy, job.spaces)
    keys = [member_keys(member.seed) for member in members]
    draw_key = jax.jit(selection_key)
    envs, player = make_envs(job), host_player(job)
    evaluator = Evaluator(job, program.policy, player)
    try:
        collector = HostCollector(program, job.spaces, envs, keys)
        states, counters = _start(job, program, learner, keys, collector, envs)
        reporter.phase("compiling")
        iteration = job.start
        while any(budget_left(config, c) for c in counters) and reporter.allowance(iteration):
            stop_named(members, counters, reporter.stopped())
            clock, cpu = time.perf_counter(), time.process_time()
            evaluating = evaluator.seconds
            hypers = [
                hypers_now(one.config, own) for one, own in zip(members, counters, strict=True)
            ]
            limit = np.array([step_limit(config, c) for c in counters])
            if not limit.any():
                break
            params = np.stack([np.asarray(state.params) for state in states])
            collected = collector.collect(params, hypers, iteration, limit)
            collect_seconds = time.perf_counter() - clock
            collect_cpu = time.process_time() - cpu
            rows, update_cpu = [], {}
            for p in np.flatnonzero(limit).tolist():
                cpu = time.process_time()
                order = minibatch_order(config, members[p].seed, iteration)
                states[p], learned = _learn(
                    learner, states[p], collected[p], hypers[p], order, draw_key(keys[p], iteration)
                )
                update_cpu[members[p].name] = time.process_time() - cpu
                check_finite(members[p], iteration, learned)
                steps = counters[p].env_steps
                counters[p].add(collected[p])
                row = metrics_row(
                    members[p], config, iteration, collected[p], counters[p], learned, hypers[p]
                )
                frozen = partial(_frozen, states[p], collector, p)
                rows.append(row | evaluator.after(p, counters[p], steps, frozen))
            evaluating = evaluator.seconds - evaluating
            timing: dict[str, Any] = {
                "env_steps": sum(collected[p].env_steps for p in np.flatnonzero(limit)),
                "seconds": time.perf_counter() - clock - evaluating,
                "collect_seconds": collect_seconds,
                "collect_cpu_seconds": collect_cpu,
                "update_cpu_seconds": update_cpu,
                **({"evaluation_seconds": evaluating} if evaluating else {}),
            }
            reporter.iteration(iteration, rows, timing)
            iteration += 1
            if iteration % config.checkpoint_every == 0:
                packed = _pack(program, members, states, counters, collector, envs)
                reporter.state(iteration, packed | evaluator.to_arrays())
        packed = _pack(program, members, states, counters, collector, envs)
        reporter.state(iteration, packed | evaluator.to_arrays())
    finally:
        player.close()
        envs.close()


def _frozen(state: TrainState, collector: HostCollector, p: int) -> Frozen:
    """What member `p` acts with now."""
    moments = collector.observation_moments
    return Frozen(state.params, None if moments is None else moments.of(p))


def make_envs(job: Job) -> HostEnvs:
    """The `P * N` environments of the job, in this process or in workers."""
    config = job.config
    seeds = [(member.seed, n) for member in job.members for n in range(config.envs)]
    how = config.backend, config.rescale_actions, wrapping_of(config)
    if config.env_processes:
        processes = min(config.env_processes, len(seeds))
        timeout = config.env_timeout
        return ProcessEnvs(config.env, job.env_kwargs, seeds, processes, timeout, *how)
    return in_process_envs(config.env, job.env_kwargs, seeds, *how)


def _start(
    job: Job,
    program: Program,
    learner: Learner,
    keys: list[Keys],
    collector: HostCollector,
    envs: HostEnvs,
) -> tuple[list[TrainState], list[Counters]]:
    states = [learner.init(k.init) for k in keys]
    counters = [Counters() for _ in keys]
    collector.start()
    if job.restored is not None:
        for p, member in enumerate(job.members):
            states[p], counters[p] = unpack_member(
                member.name, p, job.restored, states[p], program.policy, collector, envs, job.replay
            )
    elif job.initial:
        for p, member in enumerate(job.members):
            own = under(f"{member.name}/", job.initial)
            params = initial_params(program.policy, states[p].params, own)
            states[p] = states[p]._replace(params=params)
            _keep_moments(collector, p, own)
    return states, counters


def _keep_moments(collector: HostCollector, p: int, own: Arrays) -> None:
    """Lets member `p` go on with the running moments that it starts from."""
    views = moments_of(collector, p)
    for kind in ("observation_moments", "reward_moments"):
        if f"{kind}/mean" not in views:
            continue
        found = initial_moments(kind, own, views[f"{kind}/mean"].shape)
        for name, value in (found._asdict() if found else {}).items():
            views[f"{kind}/{name}"][...] = value


def _learn(
    learner: Learner,
    state: TrainState,
    collected: Collected,
    hypers: Hypers,
    order: np.ndarray,
    key: Any,
) -> tuple[TrainState, UpdateMetrics]:
    assert collected.rollout is not None
    batch = learner.make_batch(collected.rollout, hypers, key)
    state, metrics = learner.learn(state, collected.rollout, batch, hypers, order, key)
    return state, jax.device_get(metrics)


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
