"""The compiled functions of learning, for one member."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax

from sauna.algorithm.learner.learn import learn
from sauna.algorithm.learner.metrics import UpdateMetrics
from sauna.algorithm.learner.replay import empty_replay
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.update import Parts, init_state
from sauna.algorithm.learner.vex_targets import make_target
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.selection.registry import make_rules
from sauna.algorithm.types import Array, Batch, Hypers, Rollout, TrainState
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces


class Learner(NamedTuple):
    """The compiled functions that turn a rollout into new parameters.

    Members are learned one by one, never in one matrix product: see `rollout.program.Program`.

    Attributes:
      init: `key -> TrainState`.
      make_batch: `(rollout, hypers, key) -> Batch`.
      learn: `(state, rollout, batch, hypers, order, key) -> (TrainState, UpdateMetrics)`; it takes
        over the memory of `state`.
    """

    init: Callable[[Array], TrainState]
    make_batch: Callable[[Rollout, Hypers, Any], Batch]
    learn: Callable[
        [TrainState, Rollout, Batch, Hypers, Any, Any], tuple[TrainState, UpdateMetrics]
    ]


def make_parts(config: Config, policy: Policy, spaces: Spaces) -> Parts:
    """Gathers the static parts of learning.

    Raises:
      BadInput: a rule or a target cannot be made.
    """
    rules = make_rules(config, spaces.action_kind, spaces.action_sizes)
    replay = partial(empty_replay, config, spaces) if config.replay_rollouts else None
    return Parts(config, policy, make_target(config), rules, replay)


def make_learner(config: Config, policy: Policy, spaces: Spaces) -> Learner:
    """Builds (without compiling) what members with this static config learn by."""
    parts = make_parts(config, policy, spaces)
    return Learner(
        init=jax.jit(partial(init_state, parts)),
        make_batch=jax.jit(partial(make_batch, config=config, target=parts.target)),
        learn=jax.jit(partial(learn, parts=parts), donate_argnums=(0,)),
    )
