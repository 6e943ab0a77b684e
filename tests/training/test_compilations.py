"""Nothing is compiled after the first iteration, however a run trains."""

from __future__ import annotations

import sys
from typing import Any

import jax
import pytest
from numba.core.dispatcher import Dispatcher

from helpers import Recorder, make_job, train_here
from joined_rules import JOINED, joined
from sauna.training.loop import device
from sauna.training.loop.evaluation import Evaluator
from sauna.training.worker import train_members

# Widths and steps that no other test has: what it compiled would hide what is compiled here.
OWN: dict[str, Any] = {
    "arm": "ppo",
    "hidden": "7,6",
    "rollout_steps": 24,
    "minibatches": 4,
    "envs": 2,
    "seeds": 2,
    "steps": 48 * 6,
    "checkpoint_every": 1,
}
DEVICE = {"env": "jax_envs:walk", "backend": "device"}
LSTM = {"recurrent": "lstm", "recurrent_width": 5, "sequence_length": 8, "minibatches": 2}
SCHEDULES = {
    "learning_rate_schedule": "linear",
    "clip_range_schedule": "cosine",
    "entropy_coef": 0.01,
    "entropy_coef_schedule": "linear",
}
EVALUATED = {"eval_every": 48, "eval_episodes": 2}
MASKS = {"env": "small_envs:Choosy", "env_kwargs": '{"several": true}', "action_mask": True}
PICTURES = {"env": "small_envs:Picture", "network": "nature-cnn"}
BOARDS = {"env": "small_envs:Board", "network": "small-cnn"}
A2C = {"algorithm": "a2c", "rollout_steps": 9}
PATHS: dict[str, dict[str, Any]] = {
    "an MLP": {},
    "pictures": PICTURES,
    "boards": BOARDS,
    "a memory": LSTM,
    "Dict observations": {"env": "small_envs:Spaced", "env_kwargs": {"observation": "dict"}},
    "masks": MASKS,
    "rows together": {"env": "vector_envs:same"},
    "workers": {"env_processes": 2},
    "schedules": SCHEDULES,
    "a rate by the KL divergence": {"learning_rate_schedule": "kl"},
    "a2c": A2C,
    "replay": {"replay_rollouts": 2},
    "evaluations": EVALUATED,
    "evaluations in a worker": {**EVALUATED, "env_processes": 1},
    "evaluations with a memory": {**EVALUATED, **LSTM},
    "evaluations with draws": {**EVALUATED, "eval_deterministic": False},
    **{arm: joined(arm) for arm in JOINED},
    "the device": DEVICE,
    "the device, a memory": {**DEVICE, **LSTM},
    "the device, masks": {**DEVICE, "env": "jax_envs:choosy", "action_mask": True},
    "the device, schedules": {**DEVICE, **SCHEDULES},
    "the device, replay": {**DEVICE, "replay_rollouts": 2},
    "the device, a2c": {**DEVICE, **A2C},
    "the device, evaluations": {**DEVICE, **EVALUATED},
    **{f"the device, {arm}": {**DEVICE, **joined(arm)} for arm in JOINED},
}
FAST = ("boards", "a memory", "Dict observations", "evaluations", "the device, evaluations")
BY_JAX = ("boards", "pictures")  # no loop of Numba's

heard: list[str] = []


def _hear(event: str, seconds: float, **more: Any) -> None:
    if "compil" in event:
        heard.append(event)


jax.monitoring.register_event_duration_secs_listener(_hear)


def loops() -> int:
    """How many variants of its loops Numba has compiled."""
    ours = [vars(module) for name, module in [*sys.modules.items()] if name.startswith("sauna.")]
    found = {id(x): x for names in ours for x in names.values() if isinstance(x, Dispatcher)}
    return sum(len(loop.signatures) for loop in found.values())


class Listener(Recorder):
    """Grants one iteration at a time, and notes what was compiled when the second began."""

    def allowance(self, iteration: int) -> int:
        if iteration == 1:
            self.before, self.loops = len(heard), loops()
        return 1


def job_of(settings: dict[str, Any]) -> Any:
    settings = {**OWN, **settings}
    return make_job(settings.pop("env", "small_envs:Scripted"), **settings)


@pytest.mark.parametrize(
    "path", [p if p in FAST else pytest.param(p, marks=pytest.mark.slow) for p in PATHS]
)
def test_nothing_is_compiled_after_the_first_iteration(path: str) -> None:
    listener = Listener()
    train_members(job_of(PATHS[path]), listener)
    assert heard[listener.before :] == [] and loops() == listener.loops
    assert loops() > 0 or path in BY_JAX or path.startswith("the device")
    assert max(row["iteration"] for row in listener.rows) >= 3
    jax.jit(lambda x: x + 1.5)(1.0)
    assert heard[listener.before :] != []  # the listener does hear compilations


@pytest.mark.parametrize("path", ["evaluations", "the device, evaluations"])
def test_evaluations_share_one_program(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of both members, after every iteration."""
    kept: list[Any] = []

    def episodes(self: Evaluator, member: Any, frozen: Any, numbers: Any) -> Any:
        kept.append(self._play)
        return self._play(frozen, member, numbers)

    monkeypatch.setattr(Evaluator, "_episodes", episodes)
    train_here(job_of(PATHS[path]))
    player = kept[0]
    program = player._policy._act if path == "evaluations" else player._episodes
    assert kept == [player] * 12 and program._cache_size() == 1


@pytest.mark.parametrize("every, calls", [(100, 2), (2, 6)])
def test_one_call_on_the_device_runs_all_iterations_up_to_a_checkpoint(
    every: int, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, called = device.make_population, []

    def counting(job: Any) -> Any:
        population = made(job)
        population.compile()
        run = population._run
        population._run = lambda *arguments: called.append(1) or run(*arguments)
        population.compile = lambda: 0.0
        return population

    monkeypatch.setattr(device, "make_population", counting)
    found = train_here(job_of({**DEVICE, "checkpoint_every": every}))
    assert len(found.rows) == 2 * 6 and len(called) == calls
