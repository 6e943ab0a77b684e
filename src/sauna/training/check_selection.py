"""A user's sampler, loss weight and stop rule, traced once before a run."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.replay import pool_rows
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.selection.registry import Rules, make_rules
from sauna.algorithm.types import Choice, LossTerms, LossWeight, Sampler, Samples, StopRule
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput

# Arguments that are read with continuous actions alone: by field, by rule.
CONTINUOUS_ALONE: dict[str, dict[str, tuple[str, ...]]] = {
    "loss_weight": {"delight": ("centred", "on")},
    "sampler": {"kondo": ("centred", "on")},
}


def check_selection(config: Config, spaces: Spaces) -> None:
    """Makes the rules of the learner, and traces those that are the user's own.

    Raises:
      BadInput: a rule cannot be made, or gives another shape or type than training needs.
    """
    rules = _rules(config, spaces)
    _check_arguments(config, spaces)
    size = config.rollout_steps * config.envs // config.minibatches
    if rules.sampler is not None and ":" in config.sampler:
        plain = _rules(dataclasses.replace(config, control="none"), spaces).sampler
        assert plain is not None
        _check_sampler(config, spaces, plain)
        _trace(config, spaces, rules.sampler)  # as its control asks it
    if rules.sampler is not None:
        _check_draws(config, spaces, rules.sampler)
    if rules.loss_weight is not None and ":" in config.loss_weight:
        continuous = spaces.action_kind == "continuous"
        _check_weight(config.loss_weight, rules.loss_weight, size, continuous)
    if rules.stop is not None and ":" in config.stop:
        _check_stop(config.stop, rules.stop, size)
    number, one = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((size,), ()))
    if rules.objective is not None and ":" in config.objective:
        terms = jax.eval_shape(rules.objective, number, number, one)
        _check_array(f"objective: {config.objective}", "terms", terms, (size,), False)
    if rules.critic is not None and ":" in config.critic:
        loss = jax.eval_shape(rules.critic, number, number)
        _check_array(f"critic: {config.critic}", "a loss", loss, (), False)


def _check_arguments(config: Config, spaces: Spaces) -> None:
    """Refuses arguments of a rule that it does not read with these actions."""
    if spaces.action_kind == "continuous":
        return
    for field, names in CONTINUOUS_ALONE.items():
        rule, given = getattr(config, field), json.loads(getattr(config, f"{field}_kwargs"))
        for name in names.get(rule, ()):
            if name in given:
                raise BadInput(f"{field}_kwargs: {rule} reads {name} for continuous actions alone")


def _check_draws(config: Config, spaces: Spaces, sampler: Sampler) -> None:
    """Refuses settings that a sampler which draws by probabilities does not read."""
    on_policy = config.selection_losses == "policy" and sampler.share < 1
    if not on_policy and config.normalize_over != "kept":
        return
    if _trace(config, spaces, sampler)[2].probability is None:
        return
    if on_policy:
        raise BadInput(
            f"selection_losses: with policy, {config.sampler} draws as many rows as the rollout "
            f"has, for the critic; leave out its share"
        )
    raise BadInput(f"normalize_over: {config.sampler} draws and keeps no set; use rollout")


def _rules(config: Config, spaces: Spaces) -> Rules:
    return make_rules(config, spaces.action_kind, spaces.action_sizes)


def _trace(config: Config, spaces: Spaces, sampler: Sampler) -> tuple[Any, Any, Any]:
    """The sampler's state before and after a choice, and the choice, as shapes."""
    rows = pool_rows(config)
    number: Any = jax.ShapeDtypeStruct((rows,), jnp.float32)
    seen: Any = jax.ShapeDtypeStruct((rows, *spaces.observation_shape), spaces.observation_dtype)
    width = jnp.float32 if spaces.action_kind == "continuous" else jnp.int32
    action: Any = jax.ShapeDtypeStruct((rows, spaces.action_width), width)
    present: Any = jax.ShapeDtypeStruct((rows,), bool)
    samples = Samples(present, seen, action, *[number] * 7)
    if sampler.reads_policy:
        policy = make_policy(config, spaces)
        params = jax.eval_shape(policy.init, jax.eval_shape(lambda: jax.random.key(0)))
        state = jax.eval_shape(lambda: policy.initial_state(rows))
        output = jax.eval_shape(policy.step, params, seen, state)[0]
        samples = samples._replace(
            log_ratio=number, policy=output.policy, hidden=output.hidden, entropy=number
        )
    before = jax.eval_shape(sampler.init)
    key = jax.eval_shape(lambda: jax.random.key(0))
    found = jax.eval_shape(sampler.choose, before, samples, key)
    if not isinstance(found, tuple) or len(found) != 2:
        raise BadInput(f"sampler: {config.sampler} gives no pair of a state and a choice")
    return before, found[0], found[1]


def _check_sampler(config: Config, spaces: Spaces, sampler: Sampler) -> None:
    name, rows = config.sampler, (pool_rows(config),)
    if not isinstance(sampler.share, int | float) or not 0 < sampler.share <= 1:
        raise BadInput(f"sampler: {name} has share {sampler.share!r}, which is not in (0, 1]")
    before, after, choice = _trace(config, spaces, sampler)
    if not isinstance(choice, Choice):
        raise BadInput(f"sampler: {name} gives a {type(choice).__name__} instead of a sauna.Choice")
    if (choice.keep is None) == (choice.probability is None):
        raise BadInput(f"sampler: {name} gives a choice of not exactly one: keep or probability")
    for field, array in choice._asdict().items():
        if array is not None:
            _check_array(f"sampler: {name}", field, array, rows, field == "keep")
    (old, structure), (new, other) = _flat(before), _flat(after)
    if structure != other or not all(map(may_become, old, new)):
        raise BadInput(f"sampler: {name} gives a state of other arrays than it began with")


def _check_weight(name: str, rule: LossWeight, size: int, continuous: bool) -> None:
    number = jax.ShapeDtypeStruct((size,), jnp.float32)

    def weigh(x: Any) -> Any:
        return rule.weight(LossTerms(x, x, x, x, x, continuous))

    found = jax.eval_shape(weigh, number)
    if not isinstance(found, tuple) or len(found) != 2:
        raise BadInput(f"loss_weight: {name} gives no pair of a mask and a scale")
    for field, array in zip(("mask", "scale"), found, strict=True):
        _check_array(f"loss_weight: {name}", field, array, (size,), False)


def _check_stop(name: str, rule: StopRule, size: int) -> None:
    number = jax.ShapeDtypeStruct((size,), jnp.float32)
    answer = jax.eval_shape(rule.exceeded, number, number)
    _check_array(f"stop: {name}", "an answer", answer, (), True)


def _check_array(name: str, field: str, array: Any, shape: tuple[int, ...], is_mask: bool) -> None:
    """Raises:
    BadInput: the array is of another shape, or of another type than bool or floating-point.
    """
    kind = getattr(array, "dtype", None)
    fits = kind is not None and jnp.issubdtype(kind, jnp.bool_ if is_mask else jnp.floating)
    if getattr(array, "shape", None) != shape or not fits:
        raise BadInput(
            f"{name} gives {field} of shape {getattr(array, 'shape', type(array).__name__)} and "
            f"type {kind} instead of {shape} and {'bool' if is_mask else 'floating-point'}"
        )


def _flat(tree: Any) -> tuple[list[Any], Any]:
    return jax.tree.flatten(tree)


def may_become(before: Any, after: Any) -> bool:
    """Returns whether a loop may carry both; a Python number takes the type of its use."""
    return before.shape == after.shape and (before.dtype == after.dtype or before.weak_type)
