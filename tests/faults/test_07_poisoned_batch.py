"""Row 7: a loss or gradient that is not finite stops the run; it is never saved."""

from __future__ import annotations

import itertools
import random
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import sauna
from faults.result import Result, Tally, assert_held
from helpers import SMALL, Recorder, make_job
from sauna.algorithm.learner.program import make_learner
from sauna.algorithm.learner.update import minibatch_order
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.types import Batch, Hypers, Rollout, TrainState, member_keys
from sauna.system import checkpoint, run_directory
from sauna.system.checkpoint import NotFinite, save_checkpoint
from sauna.system.errors import SaunaError
from sauna.training.loop import host
from sauna.training.loop.job import NonFinite

FIELDS = ("observation", "action", "log_prob", "advantage", "return_", "value", "vex_target")
VALUES = (np.nan, np.inf, -np.inf)


class _Learner:
    """One compiled update of a small network, with a good batch to spoil."""

    def __init__(self, **settings: int) -> None:
        job = make_job("small_envs:Scripted", arm="sauna", **settings)
        self.config = job.config
        self.learner = make_learner(job.config, make_policy(job.config, job.spaces), job.spaces)
        rng, number = np.random.default_rng(0), job.config.rollout_steps
        draw = lambda *shape: rng.normal(size=(number, *shape)).astype(np.float32)  # noqa: E731
        ones = np.ones(number, np.float32)
        self.batch = Batch(draw(3), draw(2), draw() - 3, draw(), draw(), draw(), draw(), ones)
        no = np.zeros((number, 1), bool)
        self.rollout = Rollout(
            draw(1, 3), draw(1, 2), draw(1), draw(1), draw(1), draw(1), draw(1), no, no, ~no, ~no
        )
        self.hypers = Hypers(*(np.float32(0.1) for _ in Hypers._fields))

    def learn(self, batch: Batch, hypers: Hypers) -> tuple[TrainState, bool]:
        state = self.learner.init(member_keys(0).init)
        order = minibatch_order(self.config, 0, 0)
        state, metrics = self.learner.learn(
            state, self.rollout, batch, hypers, order, member_keys(0).order
        )
        return jax.device_get(state), bool(metrics.finite)


def experiment(least: int, seed: int, place: Path) -> Result:
    """Spoils one number of a batch, or one hyperparameter. `worst`: seconds of an update."""
    rng, tally, learner = random.Random(seed), Tally(), _Learner()
    state, finite = learner.learn(learner.batch, learner.hypers)
    assert finite and _is_finite(state), "the good batch has to be learned from"
    places = (0, learner.config.rollout_steps - 1)
    cases: list[tuple[Any, ...]] = list(itertools.product(FIELDS, VALUES, places))
    cases += [("hypers", value, name) for value in VALUES for name in _READ]
    for field, value, where in cases if least >= 40 else rng.sample(cases, least):
        batch, hypers = _spoiled(learner, field, value, where)
        clock = time.perf_counter()
        state, finite = learner.learn(batch, hypers)
        tally.took(time.perf_counter() - clock)
        tally.tried += 1
        if finite and not _is_finite(state):
            tally.miss(f"{field} {value} at {where}: a state that is not finite passed the check")
        tally.count("stopped" if not finite else "learned from without harm")
        _save(state, place, f"{field} {value} at {where}", tally)
    return tally.result()


_READ = ("learning_rate", "clip_range", "entropy_coef", "value_coef", "vex_coef")


def _spoiled(learner: _Learner, field: str, value: float, where: Any) -> tuple[Batch, Hypers]:
    if field == "hypers":
        return learner.batch, learner.hypers._replace(**{where: np.float32(value)})
    array = getattr(learner.batch, field).copy()
    array.reshape(len(array), -1)[where, 0] = value
    return learner.batch._replace(**{field: array}), learner.hypers


def _is_finite(state: Any) -> bool:
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))


def _save(state: TrainState, place: Path, what: str, tally: Tally) -> None:
    """The second guard: what is not finite cannot be saved even where the check is missing."""
    arrays = {"params": np.asarray(state.params), "adam": np.asarray(state.optimizer.nu)}
    finite = all(np.isfinite(array).all() for array in arrays.values())
    try:
        save_checkpoint(place, 1, arrays, {}, 1)
        if not finite:
            tally.miss(f"{what}: was saved")
    except NotFinite:
        if finite:
            tally.lose(f"{what}: a finite state was refused")


def test_a_spoiled_batch_never_passes_the_check(tmp_path: Path) -> None:
    assert_held(experiment(12, 0, tmp_path), 12)


def test_the_run_stops_and_the_last_finite_checkpoint_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third update gets a NaN; the environment is passed by value, so it trains in here."""
    plain, calls = host._learn, []

    def spoiled(learner: Any, state: Any, collected: Any, hypers: Any, order: Any, key: Any) -> Any:
        calls.append(0)
        if len(calls) == 3:
            hypers = hypers._replace(value_coef=np.float32(np.nan))
        return plain(learner, state, collected, hypers, order, key)

    monkeypatch.setattr(host, "_learn", spoiled)
    from small_envs import Scripted

    run = tmp_path / "run"
    with pytest.raises(SaunaError, match="ppo/0: the update of iteration 2 is not finite"):
        sauna.train(lambda: Scripted(), out=run, quiet=True, arm="ppo", checkpoint_every=1, **SMALL)
    found = checkpoint.load_newest(run / "checkpoints", print)
    assert found is not None and found.manifest["iteration"] == 2 == len(run_directory.rows(run))
    assert all(np.isfinite(a).all() for a in found.arrays.values())


def test_parameters_are_checked_where_the_loss_was_still_finite() -> None:
    """One minibatch: its loss is computed before the step that spoils the parameters."""
    learner = _Learner(minibatches=1, epochs=1)
    state, finite = learner.learn(
        learner.batch, learner.hypers._replace(learning_rate=np.float32(np.nan))
    )
    assert not finite and not _is_finite(state)


def test_a_rate_that_overflows_stops_before_anything_is_saved() -> None:
    recorder = Recorder()
    with pytest.raises(NonFinite, match="iteration 0"):
        host.train_on_host(make_job("small_envs:Scripted", learning_rate=1e38), recorder)
    assert not recorder.rows and not recorder.states
