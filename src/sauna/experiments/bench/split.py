"""Where the time of one training process goes, by section.

The pieces of the trainer are wrapped in timers; what the timers themselves cost is measured and
taken off again.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import mujoco
import numpy as np

from sauna.algorithm.learner.program import Learner, make_learner
from sauna.algorithm.learner.update import minibatch_order
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import Program, make_program
from sauna.algorithm.types import TrainState, member_keys, selection_key
from sauna.envs.host import mujoco_tasks
from sauna.envs.host.atari_envs import AtariEnvs
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs
from sauna.envs.host.mujoco_tasks import BatchTask
from sauna.envs.make import steps_mujoco
from sauna.system.checkpoint import save_checkpoint
from sauna.training.loop import budget, host
from sauna.training.loop.member_state import Counters
from sauna.training.loop.metrics import metrics_row
from sauna.training.prepare import prepare

SECTIONS = (
    "physics",
    "environment",
    "normalisation",
    "inference",
    "filter",
    "bookkeeping",
    "update",
    "checks",
    "logging",
    "checkpoints",
)
ITERATIONS = 6
# The section that each compiled function counts for.
ACTING = {
    "draw": "inference",
    "act": "inference",
    "score": "inference",
    "value": "inference",
    "decide": "filter",
}
LEARNING = {"make_batch": "update", "learn": "update"}


class Timers:
    """Seconds spent in wrapped functions, by section; nested ones are taken off the outer."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(SECTIONS, 0.0)
        self.calls = 0
        self._inside: list[float] = []
        self._cost = 0.0

    def wrap(self, section: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **named: Any) -> Any:
            self._inside.append(0.0)
            clock = time.perf_counter()
            result = function(*arguments, **named)
            spent = time.perf_counter() - clock
            self.seconds[section] += spent - self._inside.pop()
            if self._inside:
                self._inside[-1] += spent + self._cost
            self.calls += 1
            return result

        return timed

    def calibrate(self) -> float:
        """Measures what one wrapped call costs beyond the function, in seconds."""
        timed, number = self.wrap("physics", lambda: None), 20_000
        clock = time.perf_counter()
        for _ in range(number):
            timed()
        self._cost = (time.perf_counter() - clock - self.seconds["physics"]) / number
        return self._cost


def split(settings: dict[str, Any], count: int) -> dict[str, float]:
    """Microseconds per env step in each section, for `count` members in this process."""
    job = prepare({**settings, "seeds": count, "processes": 1}).job()
    config = job.config
    timers = Timers()
    cost = timers.calibrate()
    program = make_program(config, job.spaces)
    learner = _timed(make_learner(config, program.policy, job.spaces), LEARNING, timers)
    acting = {k: v for k, v in ACTING.items() if k != "decide" or program.filter is not None}
    program = _timed(program, acting, timers)
    envs = host.make_envs(job)
    keys = [member_keys(member.seed) for member in job.members]
    collector = HostCollector(program, job.spaces, envs, keys)
    restore = _wrap_host(collector, envs, config.env, timers)
    try:
        steps, seconds, states, counters = _train(job, learner, collector, timers)
        saving = _checkpoint_seconds(job, program, collector, states, counters)
    finally:
        restore()
        envs.close()
    rest = seconds - sum(timers.seconds.values()) - timers.calls * cost
    timers.seconds["bookkeeping"] += max(rest, 0.0)
    timers.seconds["checkpoints"] = saving * ITERATIONS / config.checkpoint_every
    return {name: 1e6 * timers.seconds[name] / steps for name in SECTIONS}


Compiled = TypeVar("Compiled", Program, Learner)


def _timed(functions: Compiled, sections: Mapping[str, str], timers: Timers) -> Compiled:
    """The compiled functions with timers around those named in `sections`."""

    def waiting(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *arguments: jax.block_until_ready(function(*arguments))

    wrapped: dict[str, Any] = {
        name: timers.wrap(section, waiting(getattr(functions, name)))
        for name, section in sections.items()
    }
    return functions._replace(**wrapped)


def _wrap_host(collector: Any, envs: Any, env: str, timers: Timers) -> Callable[[], None]:
    """Puts timers around acting, normalising and stepping; returns what takes the physics' off."""
    actor, moments = collector._actor, collector.observation_moments
    actor.act = timers.wrap("inference", actor.act)
    if moments is not None:
        moments.see_and_normalize = timers.wrap("normalisation", moments.see_and_normalize)
    envs.step = timers.wrap("environment", envs.step)
    if hasattr(envs, "_is_finite"):
        envs._is_finite = timers.wrap("checks", envs._is_finite)
    where, name = _physics(envs, env)
    plain = getattr(where, name)
    setattr(where, name, timers.wrap("physics", plain))
    return lambda: setattr(where, name, plain)


def _physics(envs: Any, env: str) -> tuple[Any, str]:
    """Where the simulator is stepped here: a module or an object, and a function's name.

    Of an environment whose simulator is not known, that is its own `step`.
    """
    if isinstance(envs, AtariEnvs) or (type(envs) is GymnasiumEnvs and not steps_mujoco(env)):
        return envs, "_take"
    if isinstance(getattr(envs, "_task", None), BatchTask):
        return mujoco_tasks, "_advance"
    return mujoco, "mj_step"


def _train(
    job: host.Job, learner: Learner, collector: HostCollector, timers: Timers
) -> tuple[int, float, list[TrainState], list[Counters]]:
    """Env steps and seconds of some iterations after two that are not counted; how they ended."""
    keys = [member_keys(member.seed) for member in job.members]
    states = [learner.init(k.init) for k in keys]
    counters = [Counters() for _ in keys]
    collector.start()
    log = timers.wrap("logging", lambda *row: json.dumps(metrics_row(*row), allow_nan=False))
    steps, clock = 0, 0.0
    for iteration in range(2 + ITERATIONS):
        if iteration == 2:
            steps, clock, timers.calls = 0, time.perf_counter(), 0
            timers.seconds = dict.fromkeys(SECTIONS, 0.0)
        hypers = [
            budget.hypers_now(one.config, own)
            for one, own in zip(job.members, counters, strict=True)
        ]
        limit = np.array([budget.step_limit(job.config, c) for c in counters])
        params = np.stack([np.asarray(state.params) for state in states])
        collected = collector.collect(params, hypers, iteration, limit)
        for p, member in enumerate(job.members):
            order = minibatch_order(job.config, member.seed, iteration)
            states[p], learned = host._learn(
                learner,
                states[p],
                collected[p],
                hypers[p],
                order,
                selection_key(keys[p], iteration),
            )
            counters[p].add(collected[p])
            steps += collected[p].env_steps
            log(member, job.config, iteration, collected[p], counters[p], learned, hypers[p])
    return steps, time.perf_counter() - clock, states, counters


def _checkpoint_seconds(
    job: host.Job,
    program: Program,
    collector: HostCollector,
    states: list[TrainState],
    counters: list[Counters],
) -> float:
    """Seconds that one checkpoint takes: gathering, hashing, writing, flushing to disk."""
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(3):
            clock = time.perf_counter()
            arrays = host._pack(program, job.members, states, counters, collector, collector._envs)
            save_checkpoint(Path(folder), number, arrays, {}, keep=2)
            seconds.append(time.perf_counter() - clock)
    return sorted(seconds)[1]
