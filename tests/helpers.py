"""Training in this process with the messages kept in memory."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from sauna.algorithm.rollout.program import Program, make_program
from sauna.config.presets import resolve
from sauna.config.settings import Config
from sauna.envs.host.contract import Step
from sauna.training.display import PlainDisplay
from sauna.training.loop.job import Job
from sauna.training.loop.member_state import flat_params
from sauna.training.prepare import prepare
from sauna.training.worker import train_members

SMALL = {
    "rollout_steps": 32,
    "minibatches": 4,
    "epochs": 2,
    "hidden": "8,8",
    "steps": 128,
    "seeds": 1,
}


TESTS = str(Path(__file__).parent)


def environment() -> dict[str, str]:
    """Of a process that finds the environments of `small_envs.py`."""
    path = [TESTS, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path)}


class Silent(PlainDisplay):
    """A display that prints nothing."""

    def say(self, text: str) -> None:
        pass


class Recorder:
    """A reporter that keeps everything and never refuses, or stops before iteration `stop`."""

    def __init__(self, stop: int | None = None) -> None:
        self.stop = stop
        self.rows: list[dict[str, Any]] = []
        self.states: dict[int, dict[str, np.ndarray]] = {}

    def phase(self, text: str) -> None:
        pass

    def allowance(self, iteration: int) -> int:
        return 1_000_000 if self.stop is None else max(self.stop - iteration, 0)

    def stopped(self) -> set[str]:
        return set()

    def iteration(self, iteration: int, rows: list[dict], timing: dict) -> None:
        self.rows += rows

    def state(self, iteration: int, arrays: dict[str, np.ndarray]) -> None:
        self.states[iteration] = arrays

    @property
    def final(self) -> dict[str, np.ndarray]:
        return self.states[max(self.states)]


def make_job(env: str, chosen: list[int] | None = None, **settings: Any) -> Job:
    overrides = {"env": env, "arm": "sauna", "processes": 1, **SMALL, **settings}
    if "network" in settings:
        del overrides["hidden"]  # which only the MLP reads
    if settings.get("algorithm") == "a2c":
        del overrides["minibatches"], overrides["epochs"]  # which only PPO reads
    return prepare(overrides).job(chosen)


def train_here(job: Job, stop: int | None = None) -> Recorder:
    recorder = Recorder(stop)
    train_members(job, recorder)
    return recorder


def resumed(job: Job, recorder: Recorder) -> Job:
    start = max(recorder.states)
    return job._replace(restored=recorder.states[start], start=start)


def policy_output(job: Job, arrays: dict[str, np.ndarray], member: str, observation: Any) -> Any:
    """The trained network at normalised observations `[n, obs]`."""
    import jax

    program: Program = make_program(job.config, job.spaces)
    example = program.policy.init(jax.random.key(0))
    prefix = f"{member}/params/"
    named = {k[len(prefix) :]: v for k, v in arrays.items() if k.startswith(prefix)}
    params = flat_params(program.policy, example, named)
    return program.policy.apply(params, np.asarray(observation, np.float32))


def configured(**settings: Any) -> Config:
    """A config without looking at an environment."""
    return dataclasses.replace(resolve({"env": "none", "arm": "sauna", **settings}), network="mlp")


def equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return one.keys() == other.keys() and all(
        one[k].dtype == other[k].dtype and one[k].tobytes() == other[k].tobytes() for k in one
    )


def own(arrays: dict[str, np.ndarray], member: str) -> dict[str, np.ndarray]:
    return {k[len(member) :]: v for k, v in arrays.items() if k.startswith(member + "/")}


def assert_same_step(one: Step, two: Step) -> None:
    ended = one.terminated | one.truncated
    for a, b in zip(one[:4], two[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.final_observation[ended], two.final_observation[ended])
    assert one.info == two.info
