"""From a gradient to the direction of a step; the learning rate comes after it, as it is traced."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.types import Array, Hypers
from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.system.errors import BadInput

FACTOR = 1.5  # by which the KL rule moves a learning rate


def optimizer(config: Config, policy: Policy, hypers: Hypers) -> optax.GradientTransformation:
    """Global-norm clipping, then the optimizer's scaling."""
    return optax.chain(optax.clip_by_global_norm(hypers.max_grad_norm), scaling(config, policy))


def scaling(config: Config, policy: Policy) -> optax.GradientTransformation:
    """Makes the optimizer that `config` names, without its learning rate.

    It maps a gradient `[D]` to what is taken off the parameters `[D]`, times the learning rate.
    RMSProp is TensorFlow's, as in baselines: the mean square starts at 1, epsilon is under the
    root. Every other optimizer but Adam is optax's at learning rate 1, on the parameter tree.

    Raises:
      BadInput: there is no such optimizer, or it does not take its arguments.
    """
    kwargs = json.loads(config.optimizer_kwargs)
    decay = config.weight_decay
    if config.optimizer == "adam":
        kwargs = {"eps": config.adam_epsilon} | _new(kwargs, ("eps",), "adam_epsilon")
        made = _made(config, optax.scale_by_adam, kwargs)
    elif config.optimizer == "rmsprop":
        ours = {
            "decay": config.rmsprop_decay,
            "eps": config.rmsprop_epsilon,
            "initial_scale": 1.0,
            "eps_in_sqrt": True,
        }
        kwargs = ours | _new(kwargs, tuple(ours), "rmsprop_decay, rmsprop_epsilon")
        made = _made(config, optax.scale_by_rms, kwargs)
    else:
        maker = _maker(config.optimizer)
        if decay and _takes(maker, "weight_decay"):
            kwargs = {"weight_decay": decay} | _new(kwargs, ("weight_decay",), "weight_decay")
            decay = 0.0
        if not isinstance(maker, optax.GradientTransformation):
            kwargs = {"learning_rate": 1.0} | _new(kwargs, ("learning_rate",), "learning_rate")
        made = on_tree(_made(config, maker, kwargs), policy.unravel)
    return optax.chain(made, optax.add_decayed_weights(decay)) if decay else made


def on_tree(
    transform: optax.GradientTransformation, unravel: Callable[[Array], Any]
) -> optax.GradientTransformation:
    """Applies a transformation of parameter trees to vectors `[D]`, and turns its sign round."""

    def init(params: Array) -> Any:
        return transform.init(unravel(params))

    def update(gradient: Array, state: Any, params: Array) -> tuple[Array, Any]:
        step, state = transform.update(unravel(gradient), state, unravel(params))
        return -ravel_pytree(step)[0], state

    return optax.GradientTransformation(init, update)


def _maker(name: str) -> Any:
    return import_name("optimizer", name) if ":" in name else getattr(optax, name)


def _takes(maker: Any, argument: str) -> bool:
    return callable(maker) and argument in inspect.signature(maker).parameters


def _new(kwargs: dict[str, Any], taken: tuple[str, ...], field: str) -> dict[str, Any]:
    """The arguments, none of which a field has given already."""
    for name in taken:
        if name in kwargs:
            raise BadInput(f"optimizer_kwargs: {name} is a setting of its own: {field}")
    return kwargs


def _made(config: Config, maker: Any, kwargs: dict[str, Any]) -> optax.GradientTransformation:
    if isinstance(maker, optax.GradientTransformation):
        if kwargs:
            raise BadInput(f"optimizer_kwargs: {config.optimizer} is made already and takes none")
        return maker
    try:
        made = maker(**kwargs)
    except (TypeError, ValueError) as error:
        raise BadInput(f"optimizer_kwargs: {config.optimizer} cannot be made: {error}") from error
    if not isinstance(made, optax.GradientTransformation):
        raise BadInput(f"optimizer: {config.optimizer} is no optax optimizer")
    return made


def moves_rate(config: Config) -> bool:
    """Returns whether the learning rate follows the KL divergence."""
    return config.learning_rate_schedule == "kl"


def moved_rate(rate: Array, kl: Array, config: Config) -> Array:
    """The learning rate of a gradient step: `rate` was the last, and the KL divergence is `kl`.

    Above `2 desired_kl` it is divided by 1.5, below `desired_kl / 2` multiplied by 1.5, within its
    bounds. Source: rsl_rl's `schedule="adaptive"`, which asks at every minibatch, too. At the first
    of an iteration the KL is 0, and the rate rises. The KL is the estimate that is logged,
    `mean((r - 1) - log r)`, where rsl_rl takes that of two Gaussians.
    """
    lower = jnp.maximum(rate / FACTOR, config.learning_rate_min)
    higher = jnp.minimum(rate * FACTOR, config.learning_rate_max)
    raised = jnp.where(kl < 0.5 * config.desired_kl, higher, rate)
    return jnp.where(kl > 2.0 * config.desired_kl, lower, raised)
