"""Whole iterations of a population inside one compiled program: collect, advantages, update.

One member's iteration is a pure function. What differs between machines is only how it is mapped
over members: on a CPU one member after the other, so that its bits do not depend on its
neighbours; on accelerators all at once, and over as many devices as there are.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from sauna.algorithm.learner.learn import learn
from sauna.algorithm.learner.metrics import UpdateMetrics
from sauna.algorithm.learner.program import make_parts
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.selected import drawn_length
from sauna.algorithm.learner.update import Parts, device_minibatch_order, init_state
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.device import Collecting, CollectState, Ends, Faults, collect, start
from sauna.algorithm.selection.registry import make_filter
from sauna.algorithm.types import Array, Hypers, Rollout, TrainState, selection_key
from sauna.config.settings import Config
from sauna.envs.device.contract import JaxEnv
from sauna.envs.spaces import Spaces
from sauna.training.loop.budget import device_hypers
from sauna.training.loop.job import Setting
from sauna.training.loop.multihost import split_over_devices

MAX_PER_CALL = 32  # iterations; their reports wait in the device's memory for the call's end
MEMBERS, ENVS = "members", "envs"  # axes of the mesh


class MemberState(NamedTuple):
    """All that one member carries from one iteration to the next."""

    learner: TrainState
    collect: CollectState
    env_steps: Array  # [] int32 since the start of training
    kept_steps: Array  # [] int32


class Report(NamedTuple):
    """What is reported of one iteration of one member."""

    ran: Array  # [] bool; False: its budget was used up
    env_steps: Array  # [] int32 of this iteration
    kept_steps: Array
    ends: Ends
    faults: Faults
    learned: UpdateMetrics
    hypers: Hypers  # after their schedules


class IterationParts(NamedTuple):
    """The static parts of an iteration."""

    config: Config
    collecting: Collecting
    policy: Policy
    learning: Parts


def make_iteration(config: Config, spaces: Spaces, env: JaxEnv, any_member: Any) -> IterationParts:
    """Builds the static parts of an iteration.

    Args:
      env: flat, of `spaces`.
      any_member: see `envs.device.contract.advance`.
    """
    policy = make_policy(config, spaces)
    rule = make_filter(config)
    collecting = Collecting(config, env, policy, rule, any_member, spaces.normalized)
    return IterationParts(config, collecting, policy, make_parts(config, policy, spaces))


def init_member(parts: IterationParts, setting: Setting) -> MemberState:
    zero = jnp.int32(0)
    learner = init_state(parts.learning, setting.keys.init)
    return MemberState(learner, start(parts.collecting, setting.keys.env), zero, zero)


def iterate(
    parts: IterationParts, state: MemberState, setting: Setting, iteration: Array
) -> tuple[MemberState, Report]:
    """One iteration of one member: collect -> advantages -> update.

    A member whose budget holds no further rollout stays as it is.
    """
    config = parts.config
    used = state.kept_steps if config.budget == "kept" else state.env_steps
    has_budget = setting.steps - used >= config.rollout_steps * config.envs
    limit = jnp.int32(capacity(config))
    if config.budget == "env":
        limit = jnp.minimum(limit, (setting.steps - used) // config.envs)
    limit = jnp.where(has_budget, limit, 0)
    hypers = device_hypers(config, setting, used)
    collected, rollout, ends, faults = collect(
        parts.collecting,
        state.learner.params,
        state.collect,
        setting.keys,
        hypers,
        iteration,
        limit,
    )
    learner, learned = learn_from(parts, state.learner, rollout, setting, hypers, iteration)
    env_steps = jnp.sum(rollout.valid, dtype=jnp.int32)
    kept_steps = jnp.sum(rollout.keep, dtype=jnp.int32)
    after = MemberState(
        learner, collected, state.env_steps + env_steps, state.kept_steps + kept_steps
    )
    after = jax.tree.map(lambda new, old: jnp.where(has_budget, new, old), after, state)
    report = Report(has_budget, env_steps, kept_steps, ends, faults, learned, hypers)
    return after, report


def learn_from(
    parts: IterationParts,
    learner: TrainState,
    rollout: Rollout,
    setting: Setting,
    hypers: Hypers,
    iteration: Array,
) -> tuple[TrainState, UpdateMetrics]:
    """Advantages and the update."""
    config = parts.config
    key = selection_key(setting.keys, iteration)
    batch = make_batch(rollout, hypers, key, config=config, target=parts.learning.target)
    own = jax.random.fold_in(setting.keys.order, iteration)
    order = device_minibatch_order(config, own, drawn_length(parts.learning))
    return learn(learner, rollout, batch, hypers, order, key, parts=parts.learning)


def several(
    iterate: Callable[[Any, Any, Array], tuple[Any, Report]],
    state: Any,
    setting: Any,
    first: Array,
    number: Array,
) -> tuple[Any, Report]:
    """Iterations `first` to `first + number`, at most `MAX_PER_CALL`.

    How many is traced: one program serves every number, so results do not depend on it. It ends
    early once some number is not finite, with that iteration's report as the last that ran, or
    when no member's budget holds a further rollout.

    Returns:
      the state, and reports with a leading axis `[MAX_PER_CALL]`, `ran` False where none is.
    """
    iterate = jax.jit(iterate, inline=True)  # traced once, for the shapes and for the loop
    shapes = jax.eval_shape(iterate, state, setting, first)[1]
    empty = jax.tree.map(lambda x: jnp.zeros((MAX_PER_CALL, *x.shape), x.dtype), shapes)

    number = jnp.minimum(number, MAX_PER_CALL)

    def not_last(now: tuple[Array, Any, Report, Array]) -> Array:
        return (now[0] < number) & now[3]

    def step(now: tuple[Array, Any, Report, Array]) -> tuple[Array, Any, Report, Array]:
        i, state, reports, _ = now
        state, report = iterate(state, setting, first + i)
        reports = jax.tree.map(lambda all, x: all.at[i].set(x), reports, report)
        return i + 1, state, reports, jnp.all(is_finite(report)) & jnp.any(report.ran)

    _, state, reports, _ = jax.lax.while_loop(
        not_last, step, (jnp.int32(0), state, empty, jnp.bool_(True))
    )
    return state, reports


def is_finite(report: Report) -> Any:
    """Whether every number of an iteration (or of many) is finite."""
    return ~report.ran | (report.learned.finite & ~report.faults.found)


class Population:
    """P members on the device.

    Args:
      config, spaces: of all members.
      env: not flat yet.
      settings: of each member.
      mesh: devices to share members and environments over; None: one device.
    """

    def __init__(
        self,
        config: Config,
        spaces: Spaces,
        env: JaxEnv,
        settings: list[Setting],
        mesh: Mesh | None = None,
    ) -> None:
        self.number, self._mesh = len(settings), mesh
        self.devices = 1 if mesh is None else mesh.size  # that share the members
        self._one_by_one = mesh is None and jax.default_backend() == "cpu"
        together = not self._one_by_one

        def any_member(here: Array) -> Array:
            """Over the members of one program: stays a scalar, so that a branch stays a branch."""
            return jax.lax.pmax(here.astype(jnp.int32), MEMBERS) > 0 if together else here

        self.parts = parts = make_iteration(config, spaces, env, any_member)
        self.policy = parts.policy
        init = self.over_members(partial(init_member, parts))
        self._settings: Any = stack(settings) if together else settings
        step = partial(iterate, parts)
        if together:
            step = jax.vmap(step, (0, 0, None), axis_name=MEMBERS)
        run = partial(several, step)
        if mesh is None:
            self._init = jax.jit(init)
            self._run: Any = jax.jit(run, donate_argnums=0)
        else:
            shapes = jax.eval_shape(init, self._settings)
            places = shardings(mesh, shapes)
            everywhere = NamedSharding(mesh, PartitionSpec())
            self._init = jax.jit(init, out_shardings=places)
            self._run = jax.jit(run, donate_argnums=0, out_shardings=(places, everywhere))
            self._spread = jax.jit(lambda x: x, out_shardings=places)
            self._gather = jax.jit(lambda x: x, out_shardings=everywhere)
        if together:
            self._state = self._init(self._settings)
        else:
            self._compiling = self._compile_aside(settings[0])
            self._state = [self._init(setting) for setting in settings]

    def _compile_aside(self, setting: Setting) -> Future[tuple[Any, float]]:
        """Compiles the iteration of one member, while others may make and compile the members.

        Returns:
          the compiled function, and how many seconds that took.
        """
        clock = time.perf_counter()
        state = jax.eval_shape(self._init, setting)
        lowered = self._run.lower(state, setting, np.int32(0), np.int32(0))
        aside = ThreadPoolExecutor(1)
        compiling = aside.submit(lambda: (lowered.compile(), time.perf_counter() - clock))
        aside.shutdown(wait=False)
        return compiling

    def over_members(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function of one member as one of what a call takes: all members, or one."""
        return function if self._one_by_one else jax.vmap(function, axis_name=MEMBERS)

    def example(self) -> tuple[Any, Any]:
        """State and setting as one call takes them; the state is the next call's to use up."""
        if self._one_by_one:
            return self._state[0], self._settings[0]
        return self._state, self._settings

    @property
    def in_one_call(self) -> int:
        """Members that one call runs."""
        return 1 if self._one_by_one else self.number

    def compile(self) -> float:
        """Compiles the iteration; how many seconds that took (little where it was cached)."""
        if self._one_by_one:
            self._run, seconds = self._compiling.result()
            return seconds
        clock = time.perf_counter()
        span = np.int32(0), np.int32(0)
        self._run = self._run.lower(self._state, self._settings, *span).compile()
        return time.perf_counter() - clock

    def run(self, first: int, number: int) -> list[Report]:
        """Runs up to `number` iterations; the reports (numpy) of each member `[MAX_PER_CALL]`."""
        span = np.int32(first), np.int32(number)
        if not self._one_by_one:
            self._state, reports = self._run(self._state, self._settings, *span)
            reports = jax.device_get(reports)
            return [jax.tree.map(lambda x: x[:, p], reports) for p in range(self.number)]  # noqa: B023
        reports = []
        for p in range(self.number):
            self._state[p], report = self._run(self._state[p], self._settings[p], *span)
            reports.append(jax.device_get(report))
        return reports

    def stop(self, members: list[int]) -> None:
        """Leaves these members as they are from now on: their budget holds no further rollout."""
        for p in members:
            if self._one_by_one:
                self._settings[p] = self._settings[p]._replace(steps=jnp.int32(1))
            else:
                steps = self._settings.steps.at[p].set(1)
                self._settings = self._settings._replace(steps=steps)

    def states(self) -> list[MemberState]:
        """Every member's state, as numpy arrays (and JAX keys)."""
        if self._one_by_one:
            return list(self._state)
        state = self._state if self._mesh is None else self._gather(self._state)
        return [jax.tree.map(lambda x: x[p], state) for p in range(self.number)]  # noqa: B023

    def restore(self, states: list[MemberState]) -> None:
        """The inverse of `states`."""
        if self._one_by_one:
            self._state = states
            return
        stacked = stack(states)
        self._state = stacked if self._mesh is None else self._spread(stacked)


def stack(trees: list[Any]) -> Any:
    """One tree with a leading axis from several of the same structure."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def make_mesh(members: int, envs: int, devices: list[Any]) -> Mesh | None:
    """A mesh of all devices: members are shared over as many as divide them, then environments.

    None with one device. Devices that neither members nor environments can be shared over evenly
    are left out.
    """
    over_members, over_envs = split_over_devices(members, envs, len(devices))
    used = over_members * over_envs
    if used == 1:
        return None
    return Mesh(np.array(devices[:used]).reshape(over_members, over_envs), (MEMBERS, ENVS))


def shardings(mesh: Mesh, states: MemberState) -> Any:
    """Where each array of stacked states lives: `[P, ...]`, those of environments `[P, N, ...]`."""
    members = NamedSharding(mesh, PartitionSpec(MEMBERS))
    envs = NamedSharding(mesh, PartitionSpec(MEMBERS, ENVS))
    places = jax.tree.map(lambda _: members, states)
    per_env = ("envs", "discounted_return", "episode_return", "episode_length", "memory")
    collect = places.collect._replace(
        **{name: jax.tree.map(lambda _: envs, getattr(states.collect, name)) for name in per_env}
    )
    return places._replace(collect=collect)
