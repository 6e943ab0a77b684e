"""Training the members of one process on the device, several iterations per call.

The loop of `host.py` for environments that are pure functions. What it reports, and when it
may go on, is the same; a call runs as many iterations as are granted and ends where a checkpoint
is due.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.policy.normalize import LongMoments, Moments
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.collected import Collected, Episode
from sauna.algorithm.rollout.device import LARGEST
from sauna.algorithm.types import Hypers, member_keys
from sauna.config.presets import Member
from sauna.config.settings import Config, fields_with, to_json
from sauna.envs.device.contract import flat
from sauna.envs.device.make import make_jax_env
from sauna.envs.device.stacked import stacked
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.system.checkpoint import under
from sauna.system.errors import BadInput
from sauna.system.jax_setup import check_platform
from sauna.system.run_directory import versions
from sauna.training.loop.budget import budget_left
from sauna.training.loop.device_program import (
    MAX_PER_CALL,
    MemberState,
    Population,
    Report,
    is_finite,
    make_mesh,
)
from sauna.training.loop.evaluation import Evaluator, stop_named
from sauna.training.loop.fine_tuning import (
    as_long_moments,
    initial_moments,
    initial_params,
)
from sauna.training.loop.job import Job, Reporter, Setting, check_finite
from sauna.training.loop.member_state import (
    Counters,
    fitting,
    named_learner,
    unpack_learner,
)
from sauna.training.loop.metrics import metrics_row
from sauna.training.loop.multihost import (
    all_equal,
    broadcast,
    broadcast_arrays,
    check_split,
    join,
    leave,
    read_host_rank,
)
from sauna.training.loop.players import DevicePlayer, Frozen

Arrays = dict[str, np.ndarray]


def train_on_device(job: Job, reporter: Reporter) -> None:
    """Runs every iteration of the job's members, reporting each.

    Raises:
      NonFinite: an update gave a non-finite loss or parameter.
      EnvironmentFailure: an environment gave a number that is not finite.
    """
    reporter.phase("making environments")
    config = job.config
    host = read_host_rank(config.distributed)
    join(host)
    if not all_equal(host, _settings(job)):
        leave()
        raise BadInput(
            "distributed: the machines have different settings or versions; give each "
            "the same command but for its index"
        )
    population = make_population(job)
    if config.device == "gpu":
        reporter.phase(f"on {population.devices} of {len(jax.devices())} GPUs")
    counters = [Counters() for _ in job.members]
    restored = broadcast_arrays(host, dict(job.restored or {}))
    if restored:
        counters = _restore(job, population, restored)
    elif job.initial:
        _initialise(job, population, job.initial)
    evaluator = make_evaluator(job, population)
    reporter.phase("compiling")
    reporter.phase(f"compiled in {population.compile():.1f} s")
    iteration = broadcast(host, job.start)
    while any(budget_left(config, c) for c in counters):
        due = config.checkpoint_every - iteration % config.checkpoint_every
        due = min(due, evaluator.iterations_until_due(counters))
        number = broadcast(host, min(reporter.allowance(iteration), due, MAX_PER_CALL))
        stop_named(job.members, counters, reporter.stopped())
        if not number or not any(budget_left(config, c) for c in counters):
            break
        population.stop([p for p, own in enumerate(counters) if own.stopped])
        clock, cpu = time.perf_counter(), time.process_time()
        reports = population.run(iteration, number)
        seconds = time.perf_counter() - clock, time.process_time() - cpu
        watch = evaluator, population
        iteration = _report(job, reporter, iteration, reports, counters, seconds, watch)
        if iteration % config.checkpoint_every == 0:
            reporter.state(iteration, pack(job, population, counters) | evaluator.to_arrays())
    reporter.state(iteration, pack(job, population, counters) | evaluator.to_arrays())


def make_evaluator(job: Job, population: Population) -> Evaluator:
    """Makes what evaluates the members of a population."""
    player = DevicePlayer(job, population.parts.collecting.env, population.policy)
    return Evaluator(job, population.policy, player)


def _frozen(population: Population, p: int) -> Frozen:
    """What member `p` acts with now."""
    state = population.states()[p]
    return Frozen(np.asarray(state.learner.params), _moments(state))


def _settings(job: Job) -> str:
    """Writes what must be alike on machines that train together."""
    blank = dict.fromkeys(fields_with("machine_local"), "")
    members = [{**to_json(member.config), **blank} for member in job.members]
    return json.dumps([{**to_json(job.config), **blank}, members, versions()])


def make_population(job: Job) -> Population:
    """The job's members at the start of their training."""
    config = job.config
    env = stacked(make_jax_env(config.env, job.env_kwargs), config.stack)
    env = flat(env, config.rescale_actions, config.action_mask)
    settings = [_setting(member) for member in job.members]
    devices = _devices(config)
    mesh = make_mesh(len(settings), config.envs, devices)
    if config.distributed:
        check_split("distributed", len(settings), config.envs, len(devices))
    return Population(config, job.spaces, env, settings, mesh)


def _devices(config: Config) -> list[Any]:
    """Lists the devices that share the population, of all machines.

    Raises:
      BadInput: there are fewer than asked for, or of another kind.
    """
    check_platform(config.device)
    found, wanted = jax.devices(), config.devices
    if wanted > len(found):
        raise BadInput(f"devices: {wanted} asked for, this machine has {len(found)}")
    return found[:wanted] if wanted else found


def _setting(member: Member) -> Setting:
    values = {name: np.float32(getattr(member.config, name)) for name in Hypers._fields}
    hypers = Hypers(**values)  # type: ignore[arg-type]
    steps = np.int32(member.config.steps)
    return Setting(member_keys(member.seed), hypers, steps)  # type: ignore[arg-type]


def _report(
    job: Job,
    reporter: Reporter,
    first: int,
    reports: list[Report],
    counters: list[Counters],
    seconds: tuple[float, float],
    watch: tuple[Evaluator, Population],
) -> int:
    """Reports what one call ran; the iteration that comes next.

    Args:
      seconds: of the call, by the wall clock and of this process's CPU time.
      watch: what evaluates a member if that is due (then the iteration is the call's last), and
        who they are.
    """
    evaluator, population = watch
    ran = np.stack([report.ran for report in reports])  # [P, MAX_PER_CALL]
    number = int(ran.any(0).sum())
    for i in range(number):
        rows, steps, evaluated = [], 0, evaluator.seconds
        for p in np.flatnonzero(ran[:, i]).tolist():
            report = jax.tree.map(lambda x: x[i], reports[p])  # noqa: B023
            member = job.members[p]
            _check_finite(member, first + i, report)
            collected = _collected(report)
            before = counters[p].env_steps
            counters[p].add(collected)
            steps += collected.env_steps
            now = report.learned, report.hypers
            row = metrics_row(member, job.config, first + i, collected, counters[p], *now)
            frozen = partial(_frozen, population, p)
            rows.append(row | evaluator.after(p, counters[p], before, frozen))
        timing: dict[str, Any] = {"env_steps": steps, "seconds": seconds[0] / number}
        if job.config.device == "cpu" and not job.config.distributed:  # else it runs elsewhere, too
            each = seconds[1] / number / len(rows)
            timing["cpu_seconds"] = {row["member"]: each for row in rows}
        if evaluating := evaluator.seconds - evaluated:
            timing["evaluation_seconds"] = evaluating
        reporter.iteration(first + i, rows, timing)
    return first + number


def _check_finite(member: Member, iteration: int, report: Report) -> None:
    if is_finite(report):
        return
    if report.faults.found:
        what = "reward" if report.faults.in_reward else "observation"
        masked = member.config.action_mask and what == "observation"
        raise EnvironmentFailure(
            f"environment {report.faults.env} of {member.name}, iteration {iteration}, step "
            f"{report.faults.row} of the rollout: {what} is not finite or beyond {LARGEST:g}"
            + ", or its action mask leaves no valid action"
            * masked
        )
    check_finite(member, iteration, report.learned)


def _collected(report: Report) -> Collected:
    ends = report.ends
    episodes = [
        Episode(
            int(ends.env[i]),
            float(ends.return_[i]),
            int(ends.length[i]),
            bool(ends.truncated[i]),
            bool(ends.kept[i]),
        )
        for i in np.flatnonzero(ends.there)
    ]
    return Collected(
        None,
        int(report.env_steps),
        int(report.kept_steps),
        int(ends.number),
        float(ends.return_mean),
        float(ends.length_mean),
        episodes,
        {name: float(x) for name, x in sorted(ends.info.items()) if np.isfinite(x)},
    )


def pack(job: Job, population: Population, counters: list[Counters]) -> Arrays:
    """The whole state of all members, as named arrays."""
    arrays: Arrays = {}
    for member, state, own in zip(job.members, population.states(), counters, strict=True):
        packed = _pack_member(population.policy, state, own)
        arrays |= {f"{member.name}/{name}": array for name, array in packed.items()}
    return arrays


def _pack_member(policy: Policy, state: MemberState, counters: Counters) -> Arrays:
    learner = state.learner
    arrays = named_learner(policy, learner) | counters.to_arrays()
    moments = _moments(state)
    if moments is not None:  # where a trained policy looks for them, as the host's
        arrays |= {f"observation_moments/{name}": a for name, a in moments._asdict().items()}
    arrays |= {f"collect/{name}": a for name, a in named_leaves(state.collect).items()}
    return {name: np.array(array) for name, array in arrays.items()}


def _moments(state: MemberState) -> Moments | None:
    """The moments of the observations in float64, as the host has them."""
    moments = state.collect.observation_moments
    if not isinstance(moments, LongMoments):
        return None
    lost = (np.asarray(part, np.float64) for part in moments[3:])
    return Moments(*(np.asarray(a) + b for a, b in zip(moments[:3], lost, strict=True)))


def named_leaves(tree: Any) -> dict[str, Any]:
    """The arrays of a pytree by their place in it; keys as the integers they are made of."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): (
            jax.random.key_data(leaf) if _is_key(leaf) else leaf
        )
        for path, leaf in leaves
    }


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def filled(example: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """A tree like `example` with the arrays of `named_leaves`.

    Raises:
      BadCheckpoint: an array is missing, or of another shape or type.
    """
    leaves, structure = jax.tree_util.tree_flatten(example)
    found = []
    for leaf, (name, place) in zip(leaves, named_leaves(example).items(), strict=True):
        if name not in arrays and name.endswith("_lost"):  # of 0.1.0, which did not keep it
            found.append(jnp.zeros(place.shape, place.dtype))
            continue
        array = jnp.asarray(fitting(arrays, name, place))
        if _is_key(leaf):
            array = jax.random.wrap_key_data(array, impl=jax.random.key_impl(leaf))
        found.append(array)
    return jax.tree_util.tree_unflatten(structure, found)


def _initialise(job: Job, population: Population, arrays: Mapping[str, np.ndarray]) -> None:
    """Starts all members from trained ones."""
    states = []
    for member, fresh in zip(job.members, population.states(), strict=True):
        own = under(member.name + "/", arrays)
        params = initial_params(population.policy, fresh.learner.params, own)
        kept: dict[str, Any] = {}
        for kind in ("observation_moments", "reward_moments"):
            example = getattr(fresh.collect, kind)
            if not isinstance(example, LongMoments):
                continue
            if (found := initial_moments(kind, own, example.mean.shape)) is not None:
                kept[kind] = as_long_moments(found, example)
        collect = fresh.collect._replace(**kept)
        states.append(
            fresh._replace(learner=fresh.learner._replace(params=params), collect=collect)
        )
    population.restore(states)


def _restore(job: Job, population: Population, arrays: Mapping[str, np.ndarray]) -> list[Counters]:
    """Puts all members back; what they had counted."""
    states, counters = [], []
    for member, example in zip(job.members, population.states(), strict=True):
        own = under(member.name + "/", arrays)
        counted = Counters.from_arrays(own)
        states.append(
            MemberState(
                unpack_learner(population.policy, own, example.learner),
                filled(example.collect, under("collect/", own)),
                jnp.int32(counted.env_steps),
                jnp.int32(counted.kept_steps),
            )
        )
        counters.append(counted)
    population.restore(states)
    return counters
