"""The policy of one member: network and action distribution, as functions of flat parameters."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from sauna.algorithm.policy.bounded import beta, squashed
from sauna.algorithm.policy.distributions import (
    Distribution,
    bernoulli,
    gaussian,
    multi_categorical,
)
from sauna.algorithm.policy.gsde import deviation, explore, gsde
from sauna.algorithm.policy.networks import MLP, ActorCritic, NatureCNN, StateNoise
from sauna.algorithm.policy.pictures import PICTURE_NETWORKS
from sauna.algorithm.types import Array, Params, PolicyOutput
from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces, board_of
from sauna.system.errors import BadInput, one_line


class Policy(NamedTuple):
    """Pure functions of one member's flat parameters `[D]`.

    Attributes:
      init: `key -> params [D]`.
      apply: `(params, observation [..., *obs]) -> PolicyOutput`.
      unravel: `params [D] -> the flax parameter pytree`.
      distribution: of the actions.
      sample: `(params, output, noise [..., M]) -> action [..., A]`.
      hold: env steps for which one draw of noise is kept.
    """

    init: Callable[[Array], Array]
    apply: Callable[[Array, Array], PolicyOutput]
    unravel: Callable[[Array], Params]
    distribution: Distribution
    sample: Callable[[Array, PolicyOutput, Array], Array]
    hold: int = 1


def make_distribution(config: Config, spaces: Spaces) -> Distribution:
    if spaces.action_kind == "continuous":
        size = spaces.action_sizes[0]
        made = {"squashed": squashed, "beta": beta}.get(config.distribution, gaussian)
        return made(size)
    if spaces.action_kind == "multi_binary":
        return bernoulli(spaces.action_sizes[0])
    return multi_categorical(spaces.action_sizes)


def make_trunk(config: Config, spaces: Spaces) -> Callable[[str, nn.Module | None], nn.Module]:
    """A function `(name, parent) -> trunk` that builds what `config.network` names.

    Raises:
      BadInput: a user's `module:name` is not a flax module, nor a function that gives one.
    """
    high = spaces.observation_high
    if config.network == "mlp":
        settings = (config.activation, config.layer_norm, high, len(spaces.observation_shape))
        widths = {"value_trunk": config.value_hidden or config.hidden}
        return lambda name, parent: MLP(
            widths.get(name, config.hidden), *settings, name=name, parent=parent
        )
    if config.network == "nature-cnn":
        return partial(_named, partial(NatureCNN, high=high))
    if config.network in PICTURE_NETWORKS:
        make = PICTURE_NETWORKS[config.network]
        return partial(_named, partial(make, high=high, board=board_of(spaces)))
    make = import_name("network", config.network)
    if isinstance(make, type) and issubclass(make, nn.Module):
        return partial(_named, make)
    module, why = make, ""
    if callable(make) and not isinstance(make, type | nn.Module):
        try:
            module = make()  # a partial, or a function of the user's
        except Exception as error:
            why = f": calling it raises {one_line(error)}"
    if not isinstance(module, nn.Module):
        raise BadInput(f"network: {config.network} is not a flax.linen module{why}")
    # Copied with its parts: flax lets modules that hold the same instance share its parameters.
    return lambda name, parent: copy.deepcopy(module).clone(name=name, parent=parent)


def _named(make: Callable[..., nn.Module], name: str, parent: nn.Module | None) -> nn.Module:
    return make(name=name, parent=parent)


def _unraveler(example: Params) -> Callable[[Array], Params]:
    """The inverse of `ravel_pytree` for trees like `example`, of numpy or JAX vectors.

    It keeps the vector's precision.
    """
    leaves, structure = jax.tree_util.tree_flatten(example)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]

    def unravel(vector: Array) -> Params:
        parts = (np if isinstance(vector, np.ndarray) else jnp).split(vector, ends)
        shaped = [part.reshape(leaf.shape) for part, leaf in zip(parts, leaves, strict=True)]
        return jax.tree_util.tree_unflatten(structure, shaped)

    return unravel


def make_policy(config: Config, spaces: Spaces) -> Policy:
    """The policy that `config` describes for environments with these `spaces`.

    Raises:
      BadInput: the network is none, or keeps more than parameters.
    """
    distribution = make_distribution(config, spaces)
    noise = state_noise(config, spaces)
    network = ActorCritic(
        make_trunk(config, spaces),
        distribution.num_outputs,
        config.log_std_init if distribution.has_log_std else None,
        config.trunk == "shared",
        0 if config.auxiliary == "none" else math.prod(spaces.observation_shape),
        noise,
    )
    example = jnp.zeros((1, *spaces.observation_shape), spaces.observation_dtype)
    variables = jax.eval_shape(network.init, jax.random.key(0), example)
    check_collections(config, variables)
    unravel = _unraveler(variables)

    def init(key: Array) -> Array:
        return ravel_pytree(network.init(key, example))[0]

    def apply(params: Array, observation: Array) -> PolicyOutput:
        return network.apply(unravel(params), observation)

    if noise is None:

        def sample(params: Array, output: PolicyOutput, noise: Array) -> Array:
            return distribution.sample(output.policy, noise)

        return Policy(init, apply, unravel, distribution, sample)
    features, size = variables["params"]["log_std"].shape

    def explored(params: Array, output: PolicyOutput, matrix: Array) -> Array:
        std = deviation(unravel(params)["params"]["log_std"], noise.expln)
        return explore(output.policy[..., :size], output.hidden, std, matrix)

    hold = config.sde_sample_freq or config.rollout_steps
    return Policy(init, apply, unravel, gsde(size, features), explored, hold)


def state_noise(config: Config, spaces: Spaces) -> StateNoise | None:
    """Returns how the exploration depends on the state; None if it does not."""
    if spaces.action_kind != "continuous" or config.distribution != "gsde":
        return None
    return StateNoise(config.sde_expln, config.sde_learn_features)


def check_collections(config: Config, variables: Params) -> None:
    """Refuses a network with a state beside its parameters, which Adam must not train."""
    others = sorted(set(variables) - {"params"})
    if others:
        raise BadInput(
            f"network: {config.network} keeps {', '.join(others)} beside its parameters, which "
            "training does not carry; instead of BatchNorm use LayerNorm or GroupNorm"
        )


def act(policy: Policy, params: Array, observation: Array, noise: Array) -> Array:
    """Actions `[N, A]` in the N envs of a member.

    Args:
      observation: `[N, *obs]` normalised; noise: `[N, M]` from `distribution.draw`.
    """
    return policy.sample(params, policy.apply(params, observation), noise)


def score(policy: Policy, params: Array, observation: Array, action: Array) -> Array:
    """`[L, N, 3]`: log-probability of the action taken, value and Vex, side by side.

    Args:
      observation: `[L, N, *obs]` normalised; action: `[L, N, A]`.
    """
    output = policy.apply(params, observation)
    log_prob = policy.distribution.log_prob(output.policy, action)
    return jnp.stack([log_prob, output.value, output.vex], -1)
