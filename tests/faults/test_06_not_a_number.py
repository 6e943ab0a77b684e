"""Row 6: NaN or infinity from an environment is refused by name, before anything learns from it."""

from __future__ import annotations

import itertools
import json
import random
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sauna
from faults.result import Result, Tally, assert_held
from helpers import SMALL, make_job, train_here
from jax_envs import FIELDS, Poison, poisoned
from sauna.algorithm.rollout.device import Faults, collect
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import make_program
from sauna.algorithm.types import Hypers, member_keys
from sauna.envs.device.contract import flat
from sauna.envs.host.contract import HostEnvs
from sauna.envs.host.gymnasium_envs import EnvironmentFailure, GymnasiumEnvs
from sauna.envs.make import env_maker
from sauna.envs.workers import ProcessEnvs
from sauna.system import checkpoint, run_directory
from sauna.system.errors import SaunaError
from sauna.training.loop.device import _check_finite, _setting
from sauna.training.loop.device_program import (
    MemberState,
    Parts,
    Report,
    init_member,
    iterate,
    make_iteration,
    several,
)
from sauna.training.loop.evaluation import Evaluator
from sauna.training.loop.member_state import Counters
from sauna.training.loop.players import Frozen, HostPlayer, WorkerPlayer
from small_envs import Poisoned
from threads import trained_here

SEEDS = [(3, 0), (3, 1), (5, 0)]
VALUES = ("nan", "inf", "-inf")
BACKENDS = {
    "in-process": lambda kwargs: GymnasiumEnvs(env_maker("small_envs:Poisoned", kwargs), SEEDS),
    "workers": lambda kwargs: ProcessEnvs("small_envs:Poisoned", kwargs, SEEDS, 2, timeout=60.0),
}


def cases() -> list[dict[str, Any]]:
    """Every field x value x component (of observations) x place in the run."""
    found = []
    for field, value, episode in itertools.product(FIELDS, VALUES, (1, 3)):
        for component in (0, 2) if field != "reward" else (0,):
            for step in (1, 2) if field in ("observation", "reward") else (1,):
                found.append(
                    {
                        "field": field,
                        "value": value,
                        "component": component,
                        "episode": episode,
                        "step": step,
                    }
                )
    return found


def experiment(least: int, seed: int, place: Path) -> Result:
    """The matrix in one process, and a part of it in workers; inside of a rollout; on the device;
    inside of an evaluation.

    `worst`: seconds from the step that gave the number to the error.
    """
    rng, tally, everything = random.Random(seed), Tally(), cases()
    chosen = everything if least >= 50 else rng.sample(everything, least)
    _on_the_host(chosen, rng, tally)
    device = OnDevice()
    for number, kwargs in enumerate(chosen):
        device.play(number % ENVS, kwargs, tally)
    return tally.result()


def _on_the_host(chosen: list[dict[str, Any]], rng: random.Random, tally: Tally) -> None:
    for kwargs in chosen:
        _play("in-process", kwargs, tally)
    for kwargs in rng.sample(chosen, max(1, len(chosen) // 10)):
        _play("workers", kwargs, tally)
    for kwargs in rng.sample(cases(), 4 if len(chosen) >= 50 else 1):
        _collect(kwargs, tally)
    _in_evaluations(chosen, rng.sample(chosen, max(1, len(chosen) // 20)), tally)


def _play(backend: str, kwargs: dict[str, Any], tally: Tally) -> None:
    tally.tried += 1
    tally.count(backend)
    envs: HostEnvs = BACKENDS[backend](kwargs)
    try:
        message = _until_refused(envs, tally)
    finally:
        envs.close()
    _check_message(message, kwargs, f"{backend}: {kwargs}", tally)


def _until_refused(envs: HostEnvs, tally: Tally) -> str:
    everyone = np.ones(len(SEEDS), bool)
    clock = time.perf_counter()
    try:
        envs.reset()
        for _ in range(200):
            clock = time.perf_counter()
            step = envs.step(np.zeros((len(SEEDS), 2), np.float32), everyone)
            ended = step.terminated | step.truncated
            numbers = [step.observation, step.reward, step.final_observation[ended]]
            if not all(np.isfinite(part).all() for part in numbers):
                return "it got through"
    except EnvironmentFailure as error:
        tally.took(time.perf_counter() - clock)
        return str(error)
    return "nothing was refused"


def _check_message(message: str, kwargs: dict[str, Any], what: str, tally: Tally) -> None:
    """It names the environment, the episode, the step and the field with its value."""
    name = "reward" if kwargs["field"] == "reward" else f"observation[{kwargs['component']}]"
    wanted = [
        " of seed ",
        f"episode {kwargs['episode'] - 1}, step ",
        f"{name} is {kwargs['value']}",
    ]
    if "got through" in message or "nothing" in message:
        tally.miss(f"{what}: {message}")
    elif not all(part in message for part in wanted):
        tally.lose(f"{what}: says {message!r}, without {wanted}")


def _collect(kwargs: dict[str, Any], tally: Tally) -> None:
    """Inside of a rollout: the moments that normalise must not have seen it."""
    job = make_job("small_envs:Scripted", arm="ppo", envs=3, rollout_steps=64, steps=192)
    envs = BACKENDS["in-process"](kwargs)
    program, key = make_program(job.config, job.spaces), member_keys(0)
    collector = HostCollector(program, job.spaces, envs, [key])
    hypers = Hypers(*(np.float32(0.5) for _ in Hypers._fields))
    tally.tried += 1
    tally.count("inside of a rollout")
    try:
        collector.start()
        params = np.stack([np.asarray(program.policy.init(key.init))])
        collector.collect(params, [hypers], 0, np.array([64]))
        tally.miss(f"{kwargs}: a rollout was filled with it")
    except EnvironmentFailure:
        pass
    moments = collector.observation_moments
    assert moments is not None
    parts = [moments.mean, moments.variance, collector._observed, *collector.reward_moments]
    if not all(np.isfinite(part).all() for part in parts):
        tally.miss(f"{kwargs}: it reached the moments or the buffer")


def _in_evaluations(here: list[dict[str, Any]], there: list[dict[str, Any]], tally: Tally) -> None:
    """In this process, and in a worker. Nothing of the evaluation may be kept.

    In this process nobody reads the observation after an episode's last step, a number or not.
    """
    good = json.dumps({"field": "reward", "value": "nan", "episode": 10**9})
    settings = {"arm": "ppo", "eval_every": 32, "eval_episodes": 4}
    job = make_job("small_envs:Poisoned", env_kwargs=good, **settings)
    policy = make_program(job.config, job.spaces).policy
    frozen = Frozen(np.asarray(policy.init(member_keys(0).init)), None)
    here = [one for one in here if one["field"] != "final" and one["step"] == 1]
    player = HostPlayer(job)
    player(frozen, job.members[0], [0])  # makes its policy, which is compiled once
    for kwargs in here:
        player._env = Poisoned(**kwargs)
        _evaluate(Evaluator(job, policy, player), frozen, kwargs, tally)
    for kwargs in there:
        worker = WorkerPlayer(job._replace(env_kwargs=kwargs))
        _evaluate(Evaluator(job, policy, worker), frozen, kwargs, tally)
        worker.close()


def _evaluate(evaluator: Evaluator, frozen: Frozen, kwargs: dict[str, Any], tally: Tally) -> None:
    tally.tried += 1
    tally.count("inside of an evaluation")
    try:
        evaluator.after(0, Counters(env_steps=32), 0, lambda: frozen)
        tally.miss(f"evaluation: {kwargs}: it got through")
    except EnvironmentFailure as error:
        wanted = ["evaluation of ppo/0: ", f" is {kwargs['value']}"]
        if not all(part in str(error) for part in wanted):
            tally.lose(f"evaluation: {kwargs}: says {str(error)!r}, without {wanted}")
    if evaluator.to_arrays():
        tally.miss(f"evaluation: {kwargs}: it was kept as the best")


ENVS = 3  # on the device
ROLLOUT = 32
LENGTH = 4  # of an episode of `jax_envs.poisoned`


class OnDevice:
    """The device's own iterations, compiled once: where the bad number is, is traced."""

    def __init__(self) -> None:
        steps = 3 * ROLLOUT * ENVS
        plain = make_job("small_envs:Scripted", arm="ppo", envs=ENVS, steps=steps)
        spaces = plain.spaces._replace(action_sizes=(1,))
        config, self._member = plain.config, plain.members[0]
        self._setting = _setting(self._member)

        def begin(poison: Poison) -> tuple[Parts, MemberState]:
            parts = make_iteration(config, spaces, flat(poisoned(poison)), lambda here: here)
            return parts, init_member(parts, self._setting)

        def run(poison: Poison) -> Report:
            parts, state = begin(poison)
            return several(partial(iterate, parts), state, self._setting, 0, 3)[1]

        def first_rollout(poison: Poison) -> Faults:
            parts, state = begin(poison)
            keys, hypers = self._setting.keys, self._setting.hypers
            zero, limit = jnp.int32(0), jnp.int32(ROLLOUT)
            given = (state.learner.params, state.collect, keys, hypers, zero, limit)
            return collect(parts.collecting, *given)[-1]

        self._run, self.first_rollout = jax.jit(run), jax.jit(first_rollout)

    def poison(self, env: int, episode: int, kwargs: dict[str, Any]) -> Poison:
        own = jax.random.fold_in(self._setting.keys.env, env)
        key, field = jax.random.fold_in(own, episode), FIELDS.index(kwargs["field"])
        return Poison(key, field, float(kwargs["value"]), kwargs["component"], kwargs["step"])

    def play(self, env: int, kwargs: dict[str, Any], tally: Tally) -> None:
        """The first episodes, or later ones: those are in the second rollout."""
        episode = kwargs["episode"] - 1 if kwargs["episode"] == 1 else kwargs["episode"] + 5
        reports = jax.device_get(self._run(self.poison(env, episode, kwargs)))
        tally.tried += 1
        tally.count("device")
        iteration, row = divmod(_row(episode, kwargs), ROLLOUT)
        what = "reward" if kwargs["field"] == "reward" else "observation"
        wanted = (
            f"environment {env} of ppo/0, iteration {iteration}, step {row} of the rollout: "
            f"{what} is not finite or beyond 1e+18"
        )
        message = "it got through"
        for i in np.flatnonzero(reports.ran):
            try:
                _check_finite(self._member, i, jax.tree.map(lambda x: x[i], reports))  # noqa: B023
            except SaunaError as error:
                message = str(error)
        if message != wanted:
            tally.miss(f"device: {kwargs}: says {message!r} instead of {wanted!r}")


def _row(episode: int, kwargs: dict[str, Any]) -> int:
    """Of the env steps: the one that reached the number, or after which it was begun with."""
    step = {"first": 0, "final": LENGTH}.get(kwargs["field"], kwargs["step"])
    return max(LENGTH * episode + step - 1, 0)


def test_no_number_that_is_none_is_learned_from() -> None:
    tally, rng = Tally(), random.Random(0)
    _on_the_host(rng.sample(cases(), 20), rng, tally)
    assert_held(tally.result(), 20)


@pytest.mark.parametrize("value", VALUES)
def test_the_first_observation_of_an_evaluation_in_a_worker_is_a_number(value: str) -> None:
    """A worker's first episode of an evaluation begins by `start_after`, and not by `reset`."""
    kwargs = {"field": "first", "value": value, "episode": 1}
    envs = BACKENDS["in-process"](kwargs)
    with pytest.raises(EnvironmentFailure, match=rf"step 0: observation\[1\] is {value}"):
        envs.start_after(0, {"episode": np.asarray(-1)})


def test_the_device_says_where_a_number_is_none() -> None:
    device = OnDevice()
    for env, episode, kwargs in zip(itertools.cycle([1, 2, 0]), [0, 3] * 60, cases(), strict=False):
        found = device.first_rollout(device.poison(env, episode, kwargs))
        wanted = (True, _row(episode, kwargs), env, kwargs["field"] == "reward")
        assert tuple(part.item() for part in found) == wanted, kwargs


@pytest.mark.slow
def test_the_device_learns_from_none_of_them(tmp_path: Path) -> None:
    assert_held(experiment(20, 0, tmp_path), 40)


def test_the_run_stops_and_what_was_saved_stays(tmp_path: Path) -> None:
    """A run of several iterations: the last checkpoint is good, and it stops there again."""
    run = tmp_path / "run"
    kwargs = '{"field": "reward", "value": "nan", "episode": 25}'
    wanted = r"environment 0 of seed 0, episode \d+.*reward is nan"
    with trained_here(), pytest.raises(SaunaError, match=wanted):
        sauna.train(
            "small_envs:Poisoned",
            env_kwargs=kwargs,
            out=run,
            quiet=True,
            arm="ppo",
            checkpoint_every=1,
            **{**SMALL, "steps": 3200},
        )
    found = checkpoint.load_newest(run / "checkpoints", print)
    assert found is not None and found.manifest["iteration"] == len(run_directory.rows(run)) > 1
    assert not run_directory.is_complete(run)


def test_a_recorded_training_that_fails_has_reported_nothing_of_the_iteration() -> None:
    job = make_job(
        "small_envs:Poisoned",
        arm="ppo",
        steps=3200,
        checkpoint_every=1,
        env_kwargs='{"field": "final", "value": "inf", "episode": 25}',
    )
    with pytest.raises(EnvironmentFailure, match="is inf"):
        train_here(job)
