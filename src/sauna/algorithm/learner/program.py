"""The compiled functions of learning, for one member."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax

from sauna.algorithm.learner.metrics import UpdateMetrics
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.update import init_state, learn
from sauna.algorithm.learner.vex_targets import make_target
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.types import Array, Batch, Hypers, Rollout, TrainState
from sauna.config.settings import Config


class Learner(NamedTuple):
    """The compiled functions that turn a rollout into new parameters.

    Members are learned one by one, never in one matrix product: see `rollout.program.Program`.

    Attributes:
      init: `key -> TrainState`.
      make_batch: `(rollout, hypers) -> Batch`.
      learn: `(state, rollout, batch, hypers, order) -> (TrainState, UpdateMetrics)`; it takes over
        the memory of `state`.
    """

    init: Callable[[Array], TrainState]
    make_batch: Callable[[Rollout, Hypers], Batch]
    learn: Callable[[TrainState, Rollout, Batch, Hypers, Any], tuple[TrainState, UpdateMetrics]]


def make_learner(config: Config, policy: Policy) -> Learner:
    """Builds (without compiling) what members with this static config learn by."""
    target = make_target(config)
    return Learner(
        init=jax.jit(partial(init_state, config, policy)),
        make_batch=jax.jit(partial(make_batch, config=config, target=target)),
        learn=jax.jit(
            partial(learn, config=config, policy=policy, target=target), donate_argnums=(0,)
        ),
    )
