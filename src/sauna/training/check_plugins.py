"""A user's filter and Vex target, traced once: what they give is what training will scan over."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.vex_targets import make_target
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.program import make_program
from sauna.algorithm.types import Hypers, ScoredStep, StepFilter
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput, one_line


def check_plugins(config: Config, spaces: Spaces) -> None:
    """Builds the program and traces filter and target, which compiles and computes nothing.

    Raises:
      BadInput: a part cannot be used, or gives another shape or type than training needs.
    """
    try:
        program = make_program(config, spaces)
        if program.filter is not None:
            _check_filter(config, spaces, program.filter)
        _check_target(config)
    except BadInput:
        raise
    except Exception as error:  # a user's part fails in its own way
        raise BadInput(f"a part of your own cannot be used: {one_line(error)}") from error


def _check_target(config: Config) -> None:
    target = make_target(config)
    shape = (
        (config.rollout_steps * config.envs // config.minibatches,)
        if target.per_minibatch
        else (config.rollout_steps, config.envs)
    )
    x, episode = jax.ShapeDtypeStruct(shape, jnp.float32), jax.ShapeDtypeStruct(shape, jnp.int32)
    found = jax.eval_shape(target.target, x, x, x, episode)
    if getattr(found, "shape", None) != shape:
        raise BadInput(
            f"vex_target: {config.vex_target} gives shape {_shape(found)} instead of {shape}"
        )


def _check_filter(config: Config, spaces: Spaces, filter: StepFilter) -> None:
    number: Any = jax.ShapeDtypeStruct((), jnp.float32)
    kind = jnp.uint8 if spaces.observation_kind == "image" else jnp.float32
    seen = jax.ShapeDtypeStruct((config.envs, *spaces.observation_shape), kind)
    vex = jax.ShapeDtypeStruct((config.envs,), jnp.float32)
    init = partial(filter.init, config.envs, capacity(config))  # traced on the device alone
    state = jax.eval_shape(init) if config.backend == "device" else init()
    key = jax.eval_shape(lambda: jax.random.key(0))
    hypers = Hypers(*[number] * len(Hypers._fields))
    before = jax.eval_shape(lambda x: x, state)
    width = jnp.float32 if spaces.action_kind == "continuous" else jnp.int32
    action = jax.ShapeDtypeStruct((config.envs, spaces.action_width), width)
    scored = ScoredStep(seen, action, vex, vex, vex)
    after, mask = jax.eval_shape(filter.keep, before, scored, key, hypers)
    if getattr(mask, "shape", None) != (config.envs,) or mask.dtype != bool:
        raise BadInput(
            f"filter: {config.filter} gives a mask of shape {_shape(mask)} and type "
            f"{getattr(mask, 'dtype', type(mask).__name__)} instead of {(config.envs,)} "
            f"and bool"
        )
    (old, structure), (new, other) = _flat(before), _flat(after)
    if structure != other or not all(map(_may_become, old, new)):
        raise BadInput(f"filter: {config.filter} gives a state of other arrays than it began with")


def _flat(tree: Any) -> tuple[list[Any], Any]:
    return jax.tree.flatten(tree)


def _shape(x: Any) -> Any:
    return getattr(x, "shape", type(x).__name__)


def _may_become(before: Any, after: Any) -> bool:
    """Returns whether a loop may carry both; a Python number takes the type of its use."""
    return before.shape == after.shape and (before.dtype == after.dtype or before.weak_type)
