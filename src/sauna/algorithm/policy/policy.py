"""The policy of one member: network and action distribution, as functions of flat parameters."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from sauna.algorithm.policy.bounded import beta, squashed
from sauna.algorithm.policy.combined import Combined, MakeTrunk
from sauna.algorithm.policy.distributions import (
    Distribution,
    bernoulli,
    gaussian,
    multi_categorical,
)
from sauna.algorithm.policy.gsde import deviation, explore, gsde
from sauna.algorithm.policy.networks import MLP, ActorCritic, NatureCNN, StateNoise
from sauna.algorithm.policy.observation import seen_of, valid_logits
from sauna.algorithm.policy.pictures import PICTURE_NETWORKS
from sauna.algorithm.policy.recurrent import CELLS, STATES
from sauna.algorithm.types import Array, Params, PolicyOutput
from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces, board_of, picture_alone, seen_spaces
from sauna.system.errors import BadInput, one_line


class Policy(NamedTuple):
    """Pure functions of one member's flat parameters `[D]`.

    Attributes:
      init: `key -> params [D]`.
      apply: `(params, observation [..., *obs]) -> PolicyOutput`; a recurrent policy refuses it.
      unravel: `params [D] -> the flax parameter pytree`.
      distribution: of the actions.
      sample: `(params, output, noise [..., M]) -> action [..., A]`.
      hold: env steps for which one draw of noise is kept.
      state_size: H, numbers of the state of a recurrent policy in one environment; else 0.
      unroll: of a recurrent policy, `(params, observation [L, B, *obs], start [L, B], state [B, H])
        -> PolicyOutput [L, B, ...]` over L env steps; `start` says with which an episode starts.
    """

    init: Callable[[Array], Array]
    apply: Callable[[Array, Array], PolicyOutput]
    unravel: Callable[[Array], Params]
    distribution: Distribution
    sample: Callable[[Array, PolicyOutput, Array], Array]
    hold: int = 1
    state_size: int = 0
    unroll: Callable[[Array, Array, Array, Array], PolicyOutput] | None = None

    def initial_state(self, *shape: int) -> Any:
        """The state at the start of an episode, zeros `[*shape, H]`; () if nothing is remembered.

        A policy that is not recurrent has the state () everywhere.
        """
        return jnp.zeros((*shape, self.state_size), jnp.float32) if self.state_size else ()

    def step(self, params: Array, observation: Array, state: Any) -> tuple[PolicyOutput, Any]:
        """One env step of B environments: what the network gives, and the state after it.

        Args:
          observation: `[B, *obs]` as the network gets it; state: `[B, H]`, or ().
        """
        if self.unroll is None:
            return self.apply(params, observation), state
        start = jnp.zeros((1, len(observation)), bool)
        output = self.unroll(params, observation[None], start, state)
        state, output = output.state, output._replace(state=())
        return jax.tree.map(lambda x: x[0], output), state


def make_distribution(config: Config, spaces: Spaces) -> Distribution:
    if spaces.action_kind == "continuous":
        size = spaces.action_sizes[0]
        made = {"squashed": squashed, "beta": beta}.get(config.distribution, gaussian)
        return made(size)
    if spaces.action_kind == "multi_binary":
        return bernoulli(spaces.action_sizes[0])
    return multi_categorical(spaces.action_sizes)


def make_trunk(config: Config, spaces: Spaces) -> MakeTrunk:
    """A function `(name, parent) -> trunk` that builds what `config.network` names.

    Raises:
      BadInput: a user's `module:name` is not a flax module, nor a function that gives one.
    """
    spaces = seen_spaces(spaces)
    if spaces.pictures:
        return _combined_trunk(config, spaces)
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


def _combined_trunk(config: Config, spaces: Spaces) -> MakeTrunk:
    """Of observations that hold pictures beside something else: `config.network` is a picture's.

    With the MLP, pictures are flattened.
    """
    alone = [picture_alone(spaces, picture) for picture in spaces.pictures]
    of_pictures = config
    if config.network == "mlp":
        of_pictures = dataclasses.replace(config, hidden=())
    pictures = [make_trunk(of_pictures, one) for one in alone]
    mlp = make_trunk(dataclasses.replace(config, network="mlp"), spaces._replace(pictures=()))
    return partial(_named, partial(Combined, pictures, mlp))


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
        _cell_maker(config),
        noise,
    )
    remembers = state_size(config)
    lead = (1, 1) if remembers else (1,)

    def new_variables(key: Array) -> Params:
        seen = jnp.zeros((*lead, *spaces.observation_shape), spaces.observation_dtype)
        example: list[Any] = [seen_of(spaces, seen)]
        if remembers:
            example += [jnp.zeros((1, 1), bool), jnp.zeros((1, remembers), jnp.float32)]
        return network.init(key, *example)

    variables = jax.eval_shape(lambda: new_variables(jax.random.key(0)))
    check_collections(config, variables)
    unravel = _unraveler(variables)

    def init(key: Array) -> Array:
        return ravel_pytree(new_variables(key))[0]

    def apply(params: Array, observation: Array) -> PolicyOutput:
        output = network.apply(unravel(params), seen_of(spaces, observation))
        return output._replace(policy=valid_logits(spaces, observation, output.policy))

    def unroll(params: Array, observation: Array, start: Array, state: Array) -> PolicyOutput:
        output = network.apply(unravel(params), seen_of(spaces, observation), start, state)
        return output._replace(policy=valid_logits(spaces, observation, output.policy))

    memory: tuple[Any, ...] = ()
    if remembers:
        apply, memory = _no_apply, (remembers, unroll)
    if noise is None:

        def sample(params: Array, output: PolicyOutput, noise: Array) -> Array:
            return distribution.sample(output.policy, noise)

        return Policy(init, apply, unravel, distribution, sample, 1, *memory)
    features, size = variables["params"]["log_std"].shape

    def explored(params: Array, output: PolicyOutput, matrix: Array) -> Array:
        std = deviation(unravel(params)["params"]["log_std"], noise.expln)
        return explore(output.policy[..., :size], output.hidden, std, matrix)

    hold = config.sde_sample_freq or config.rollout_steps
    return Policy(init, apply, unravel, gsde(size, features), explored, hold, *memory)


def state_noise(config: Config, spaces: Spaces) -> StateNoise | None:
    """Returns how the exploration depends on the state; None if it does not."""
    if spaces.action_kind != "continuous" or config.distribution != "gsde":
        return None
    return StateNoise(config.sde_expln, config.sde_learn_features)


def state_size(config: Config) -> int:
    """H: numbers of the state of a recurrent policy in one environment; 0 if it has none."""
    trunks = 1 if config.trunk == "shared" else 2
    return trunks * STATES.get(config.recurrent, 0) * config.recurrent_width


def _cell_maker(config: Config) -> Callable[[str], nn.Module] | None:
    if config.recurrent == "none":
        return None
    cell, width = CELLS[config.recurrent], config.recurrent_width
    return lambda name: cell(width, name=name)


def _no_apply(params: Array, observation: Array) -> PolicyOutput:
    raise TypeError("a recurrent policy takes a state: use step or unroll")


def check_collections(config: Config, variables: Params) -> None:
    """Refuses a network with a state beside its parameters, which Adam must not train."""
    others = sorted(set(variables) - {"params"})
    if others:
        raise BadInput(
            f"network: {config.network} keeps {', '.join(others)} beside its parameters, which "
            "training does not carry; instead of BatchNorm use LayerNorm or GroupNorm"
        )


def act(policy: Policy, params: Array, observation: Array, noise: Array) -> tuple[Array, Array]:
    """Actions `[N, A]` in the N envs of a member, and their scores `[N, 3]` as `score` gives them.

    Args:
      observation: `[N, *obs]` normalised; noise: `[N, M]` from `distribution.draw`.
    """
    output = policy.apply(params, observation)
    action = policy.sample(params, output, noise)
    return action, scores_of(policy, output, action)


def score(policy: Policy, params: Array, observation: Array, action: Array) -> Array:
    """`[L, N, 3]`: log-probability of the action taken, value and Vex, side by side.

    Args:
      observation: `[L, N, *obs]` normalised; action: `[L, N, A]`.
    """
    output = policy.apply(params, observation)
    return scores_of(policy, output, action)


def scores_of(policy: Policy, output: PolicyOutput, action: Array) -> Array:
    """`[..., 3]`: log-probability of the action taken `[..., A]`, value and Vex, side by side."""
    log_prob = policy.distribution.log_prob(output.policy, action)
    return jnp.stack([log_prob, output.value, output.vex], -1)


def act_with_state(
    policy: Policy, params: Array, observation: Array, noise: Array, state: Array
) -> tuple[Array, Array]:
    """Actions `[N, A]` of a recurrent policy, and its states `[N, H]` after them; see `act`."""
    output, state = policy.step(params, observation, state)
    return policy.sample(params, output, noise), state


def score_with_state(
    policy: Policy, params: Array, observation: Array, action: Array, start: Array, state: Array
) -> Array:
    """As `score`, of consecutive steps `[L, N]` of a recurrent policy.

    Args:
      start: `[L, N]` bool, where an episode starts; state: `[N, H]` before the first step.
    """
    assert policy.unroll is not None
    return scores_of(policy, policy.unroll(params, observation, start, state), action)
