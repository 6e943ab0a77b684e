"""What a training does per env step, as exact counts: a guard against slowing down unnoticed."""

from __future__ import annotations

import gc
import sys
import tracemalloc
from collections import Counter
from typing import Any

import jax
import numpy as np
import pytest

from arrays import no_key
from helpers import make_job
from sauna.algorithm.learner.program import Learner, make_learner
from sauna.algorithm.learner.update import minibatch_order
from sauna.algorithm.rollout import actor, moments
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import Program, make_program
from sauna.algorithm.types import member_keys
from sauna.envs.host import mujoco_envs, mujoco_tasks
from sauna.training.loop.budget import hypers_now, step_limit
from sauna.training.loop.host import _learn, make_envs
from sauna.training.loop.member_state import Counters

STEPS, MEMBERS = 32, 3
FUNCTIONS = ("draw", "act", "score", "value", "decide", "make_batch", "learn")


class Trainer:
    """The loop of `train_members`, counting the calls of compiled functions."""

    def __init__(self, env: str, **settings: Any) -> None:
        settings = {"rollout_steps": STEPS, **settings}
        self.job = make_job(env, seeds=MEMBERS, steps=10**6, **settings)
        self.calls: Counter[str] = Counter()
        self.program = make_program(self.job.config, self.job.spaces)
        self.learner = make_learner(self.job.config, self.program.policy, self.job.spaces)
        counted = {n: self._counted(self.program, n) for n in FUNCTIONS if n in Program._fields}
        learned = {n: self._counted(self.learner, n) for n in FUNCTIONS if n in Learner._fields}
        self.keys = [member_keys(member.seed) for member in self.job.members]
        self.envs = make_envs(self.job)
        self.collector = HostCollector(
            self.program._replace(**counted), self.job.spaces, self.envs, self.keys
        )
        self.collector.start()
        self.counted = self.learner._replace(**learned)
        self.states = [self.learner.init(k.init) for k in self.keys]
        self.done = [Counters() for _ in self.keys]
        self.changed: dict[str, Any] = {}  # hyperparameters, from now on

    def _counted(self, where: Any, name: str) -> Any:
        function = getattr(where, name)

        def call(*arguments: Any) -> Any:
            self.calls[name] += 1
            return function(*arguments)

        return call

    def collect(self, iteration: int) -> list:
        job = self.job
        hypers = [
            hypers_now(job.members[p].config, self.done[p])._replace(**self.changed)
            for p in range(MEMBERS)
        ]
        limit = np.array([step_limit(job.config, c) for c in self.done])
        params = np.stack([np.asarray(state.params) for state in self.states])
        return [self.collector.collect(params, hypers, iteration, limit), hypers]

    def iterate(self, iteration: int) -> int:
        collected, hypers = self.collect(iteration)
        for p, member in enumerate(self.job.members):
            order = minibatch_order(self.job.config, member.seed, iteration)
            self.states[p], _ = _learn(
                self.counted, self.states[p], collected[p], hypers[p], order, no_key()
            )
            self.done[p].add(collected[p])
        return max(c.rollout.valid.any(1).sum() for c in collected)


def test_compiled_calls_per_rollout() -> None:
    """None per env step: drawing, scoring, the last value, the batch and the update, once each."""
    trainer = Trainer("HalfCheetah-v5", arm="ppo")
    trainer.iterate(0)
    trainer.calls.clear()
    trainer.iterate(1)
    once = dict.fromkeys(("draw", "score", "value", "make_batch", "learn"), MEMBERS)
    assert trainer.calls == once
    trainer.envs.close()


def test_a_network_of_another_kind_acts_by_one_call_per_step_which_gives_the_scores() -> None:
    trainer = Trainer("small_envs:Scripted", arm="ppo", network="trunks:Sine")
    trainer.iterate(0)
    trainer.calls.clear()
    assert trainer.iterate(1) == STEPS
    assert trainer.calls["act"] == STEPS
    assert trainer.calls["score"] == 0
    trainer.envs.close()


ONCE, EACH_STEP = {"score": MEMBERS}, {"act": STEPS}
WAYS: dict[str, tuple[dict[str, Any], dict[str, int]]] = {
    "boards": ({"env": "small_envs:Board", "network": "small-cnn"}, EACH_STEP),
    "memory": (
        {"recurrent": "lstm", "recurrent_width": 4, "sequence_length": 8},
        {**EACH_STEP, **ONCE},
    ),
    "Dict": ({"env": "small_envs:Spaced", "env_kwargs": {"observation": "dict"}}, ONCE),
    "masks": (
        {"env": "small_envs:Choosy", "env_kwargs": '{"several": true}', "action_mask": True},
        ONCE,
    ),
    "rows": ({"env": "vector_envs:same"}, ONCE),
    "workers": ({"env_processes": 2}, ONCE),
    "a2c": ({"algorithm": "a2c"}, ONCE),
    "replay": ({"replay_rollouts": 2}, ONCE),
    "sampler": ({"arm": "top-advantage"}, ONCE),
    "filter": ({"arm": "sauna", "dropped": "mask"}, {**ONCE, "decide": MEMBERS}),
}


@pytest.mark.parametrize("way", WAYS)
def test_compiled_calls_per_rollout_of_each_way_to_train(way: str) -> None:
    """One call per member and rollout; per env step only where the policy is no MLP. A time limit
    costs one more, for the value of what the episode had reached."""
    settings, more = WAYS[way]
    trainer = Trainer(**{"env": "small_envs:Scripted", "arm": "ppo", **settings})
    trainer.iterate(0)
    trainer.calls.clear()
    trainer.iterate(1)
    limits = int(trainer.collector._buffers.truncated.sum())
    once = dict.fromkeys(("draw", "make_batch", "learn"), MEMBERS)
    assert trainer.calls == {**once, "value": MEMBERS + limits, **more}
    trainer.envs.close()


@pytest.mark.parametrize("arm", ["ppo", "sauna"])
def test_nothing_is_compiled_after_the_first_iteration(arm: str) -> None:
    """A filtered arm drops nothing at first, and then so much that its segments are short."""
    settings = {"threshold": 0.0} if arm == "sauna" else {}
    trainer = Trainer("InvertedPendulum-v5", arm=arm, rollout_steps=256, **settings)
    trainer.iterate(0)
    trainer.changed = {"threshold": np.float32(1.0)}
    loops = [actor._act, moments._see_and_normalize, mujoco_envs._record, mujoco_tasks._advance]
    variants = [len(loop.signatures) for loop in loops]
    compiled: list[str] = []
    listen = jax.monitoring.register_event_duration_secs_listener
    listen(lambda event, seconds, **more: compiled.append(event) if "compil" in event else None)
    for iteration in range(1, 6):
        trainer.iterate(iteration)
    assert compiled == []
    assert [len(loop.signatures) for loop in loops] == variants  # Numba's
    jax.jit(lambda x: x + 1.25)(1.0)
    assert compiled != []  # the listener does hear compilations
    trainer.envs.close()


def test_python_calls_per_vector_step() -> None:
    """Python functions and methods of C called for one vector step of three members."""
    trainer = Trainer("HalfCheetah-v5", arm="ppo")
    trainer.iterate(0)
    seen: Counter[str] = Counter()

    def count(frame: Any, event: str, argument: Any) -> None:
        if event == "call":
            seen[frame.f_code.co_name] += 1
        elif event == "c_call":
            seen[argument.__name__] += 1

    params = np.stack([np.asarray(state.params) for state in trainer.states])
    trainer.collector._actor.load(params)
    noise = np.zeros((STEPS, MEMBERS, 1, 6), np.float32)
    acting = np.ones((MEMBERS, 1), bool)
    sys.setprofile(count)
    try:
        trainer.collector._act(params, noise, 0, STEPS, acting, {})
    finally:
        sys.setprofile(None)
    per_step = {name: n // STEPS for name, n in seen.items() if n >= STEPS}
    assert per_step == PER_STEP
    trainer.envs.close()


# Seven of them are compiled loops, each for all members: none of the calls is made once per member.
# The `lambda` samples continuous actions; `reshape` gives views.
PER_STEP = {
    "_act": 1,
    "_clip": 1,
    "_advance": 1,
    "_run": 1,
    "_record": 1,
    "_all_finite": 1,
    "_see_and_normalize": 1,
    "act": 1,
    "empty": 1,
    "<lambda>": 1,
    "step": 2,
    "evaluate": 1,
    "_is_finite": 1,
    "_make_room": 1,
    "tolist": 1,
    "_told": 1,
    "see_and_normalize": 1,
    "reshape": 3,
}


def test_memory_does_not_grow() -> None:
    """The room for an episode's actions is there from the start, and nothing else is kept."""
    trainer = Trainer("HalfCheetah-v5", arm="ppo")
    for iteration in range(3):
        trainer.iterate(iteration)
    tracemalloc.start()
    for iteration in range(3, 40):  # until JAX's own caches have filled
        trainer.iterate(iteration)
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    for iteration in range(40, 72):
        trainer.iterate(iteration)
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown / (32 * STEPS * MEMBERS) < 24  # bytes per env step: a float would be as much
    trainer.envs.close()
