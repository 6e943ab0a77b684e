"""A user's parts, traced once: they give what training expects of them."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.optimizers import scaling
from sauna.algorithm.learner.vex_targets import make_target
from sauna.algorithm.policy.observation import seen_of
from sauna.algorithm.policy.policy import Policy, check_collections, make_trunk
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.program import make_program
from sauna.algorithm.types import Hypers, ScoredStep, StepFilter
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput, one_line
from sauna.training.check_selection import check_selection, may_become
from sauna.training.loop.schedules import check_schedules


def check_plugins(config: Config, spaces: Spaces) -> None:
    """Builds the program and traces its parts; a network is also tried on random observations.

    Raises:
      BadInput: a part cannot be used, or gives another shape or type than training needs.
    """
    if ":" in config.network:
        _check_network(config, spaces)
    try:
        program = make_program(config, spaces)
        if program.filter is not None:
            _check_filter(config, spaces, program.filter)
        _check_target(config)
        check_optimizer(config, program.policy)
        check_schedules(config)
        check_selection(config, spaces)
    except BadInput:
        raise
    except Exception as error:  # a user's part fails in its own way
        raise BadInput(f"a part of your own cannot be used: {one_line(error)}") from error


def _check_network(config: Config, spaces: Spaces) -> None:
    """Traces a user's trunk, alone, and tries it and its gradient on random observations.

    Training calls it with one axis in front of an observation, and with two.
    """
    field = f"network: {config.network}"
    module, key = make_trunk(config, spaces)("trunk", None), jax.random.key(0)
    try:
        for lead in ((2,), (3, 2)):
            shape = (*lead, *spaces.observation_shape)
            whole = jax.ShapeDtypeStruct(shape, spaces.observation_dtype)
            seen = jax.eval_shape(partial(seen_of, spaces), whole)
            variables = jax.eval_shape(module.init, key, seen)
            check_collections(config, variables)
            given = jax.eval_shape(module.apply, variables, seen)
            if len(getattr(given, "shape", ())) != len(lead) + 1 or given.shape[:-1] != lead:
                wanted = (*lead, "features")
                raise BadInput(
                    f"{field} gives {_shape(given)} for observations of shape {shape}, instead of "
                    f"({', '.join(map(str, wanted))})"
                )
            if not jnp.issubdtype(given.dtype, jnp.floating):
                raise BadInput(f"{field} gives {given.dtype}, instead of floating-point features")
        _check_finite(field, module, key, spaces)
    except BadInput:
        raise
    except Exception as error:  # a user's module fails in its own way
        observations = f"on observations of shape {(2, *spaces.observation_shape)}"
        hint = "; Dropout needs deterministic=True" * ("PRNG" in str(error) or _is_dropout(error))
        raise BadInput(
            f"{field} cannot be used {observations}: {one_line(error)[:160]}{hint}"
        ) from error


def _is_dropout(error: Exception) -> bool:
    return "deterministic" in str(error)


def _check_finite(field: str, module: Any, key: Any, spaces: Spaces) -> None:
    """Refuses a network that gives NaN or infinity, or whose gradient does."""
    shape = (8, *spaces.observation_shape)
    if spaces.observation_kind == "image":
        most = int(spaces.observation_high) + 1
        seen = jax.random.randint(key, shape, 0, most).astype(jnp.uint8)
    elif spaces.observation_kind == "one_hot":
        seen = jax.random.bernoulli(key, 0.5, shape).astype(jnp.float32)
    else:
        seen = jax.random.normal(key, shape)
    seen = seen_of(spaces, seen)
    variables = module.init(key, seen)

    def total(variables: Any) -> Any:
        features = module.apply(variables, seen)
        return features.sum(), features

    gradient, features = jax.grad(total, has_aux=True)(variables)
    for what, arrays in (("features", features), ("a gradient", gradient)):
        for array in jax.tree.leaves(arrays):
            if not bool(jnp.isfinite(array).all()):
                raise BadInput(
                    f"{field} gives {what} of shape {array.shape} with NaN or infinity, for "
                    f"observations of shape {shape}"
                )


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


def check_optimizer(config: Config, policy: Policy) -> None:
    """Makes the optimizer and traces one step.

    Raises:
      BadInput: it cannot be made, or its step or state are of another shape or type than before.
    """
    transform = scaling(config, policy)
    params = jax.eval_shape(policy.init, jax.eval_shape(lambda: jax.random.key(0)))
    try:
        state = jax.eval_shape(transform.init, params)
        step, after = jax.eval_shape(transform.update, params, state, params)
    except Exception as error:  # an optimizer fails in its own way
        text = one_line(error)[:160]
        raise BadInput(f"optimizer: {config.optimizer} cannot make a step: {text}") from error
    (old, structure), (new, other) = _flat(state), _flat(after)
    same = structure == other and all(map(may_become, old, new))
    if not same or (step.shape, step.dtype) != (params.shape, params.dtype):
        raise BadInput(f"optimizer: {config.optimizer} gives other arrays than it began with")


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
    if structure != other or not all(map(may_become, old, new)):
        raise BadInput(f"filter: {config.filter} gives a state of other arrays than it began with")


def _flat(tree: Any) -> tuple[list[Any], Any]:
    return jax.tree.flatten(tree)


def _shape(x: Any) -> Any:
    return getattr(x, "shape", type(x).__name__)
