"""The actor-critic with its third head, and the trunks it stands on (flax.linen).

Initialisation follows baselines: orthogonal weights with gain sqrt(2) in the trunks, 0.01 for the
policy head, 1 for the value and Vex heads, zero biases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from sauna.algorithm.policy.convolutions import LAYERS, Layer, convolutions
from sauna.algorithm.policy.gsde import deviation, state_log_std
from sauna.algorithm.types import Array, PolicyOutput


def dense(width: int, gain: float, name: str) -> nn.Dense:
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(gain), name=name)


class MLP(nn.Module):
    """`[..., obs]` -> `[..., hidden[-1]]`, one activation after each layer.

    With `layer_norm` a layer's sums are normalised before it (Ba et al. 2016, eq. 4), each by the
    mean and the variance over the layer, and then scaled and shifted by learned numbers.

    A picture `[..., H, W, C]` (`axes` 3) becomes one vector. Its bytes are divided by `high`.
    """

    hidden: Sequence[int]
    activation: str = "tanh"
    layer_norm: bool = False
    high: float = 255.0
    axes: int = 1

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        activate = getattr(nn, self.activation)
        x = observation
        if x.dtype == jnp.uint8:
            x = x.reshape((*x.shape[:-3], -1)).astype(jnp.float32) / self.high
        elif self.axes == 3:
            x = x.reshape((*x.shape[:-3], -1))
        for i, width in enumerate(self.hidden):
            x = dense(width, math.sqrt(2.0), f"layer_{i}")(x)
            if self.layer_norm:
                x = nn.LayerNorm(name=f"norm_{i}")(x)
            x = activate(x)
        return x


class Convolution(nn.Module):
    """The parameters of one of `convolutions`: kernel `[K, K, C, F]` and bias `[F]`."""

    features: int
    width: int

    @nn.compact
    def __call__(self, channels: int) -> Layer:
        shape = (self.width, self.width, channels, self.features)
        kernel = self.param("kernel", nn.initializers.orthogonal(math.sqrt(2.0)), shape)
        return kernel, self.param("bias", nn.initializers.zeros, (self.features,))


class NatureCNN(nn.Module):
    """Images `[..., H, W, C]` -> `[..., 512]` (Mnih et al. 2015, as in baselines).

    uint8 images are scaled to [0, 1] here, so that rollouts hold bytes: they are divided by
    `high`.
    """

    high: float = 255.0

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        lead = observation.shape[:-3]
        x = observation.reshape((-1, *observation.shape[-3:]))
        layers, channels = [], x.shape[-1]
        for i, (features, width, _) in enumerate(LAYERS):
            layers.append(Convolution(features, width, name=f"conv_{i}")(channels))
            channels = features
        x = convolutions(layers, x, self.high)
        x = nn.relu(dense(512, math.sqrt(2.0), "dense")(x.reshape((x.shape[0], -1))))
        return x.reshape((*lead, -1))


class StateNoise(NamedTuple):
    """How gSDE's noise depends on the features; see `gsde.py`."""

    expln: bool  # the standard deviation of a log-std above 0 grows slowly
    learn_features: bool  # the gradient of the log-std goes into the features


class ActorCritic(nn.Module):
    """Policy, value and Vex heads on a shared trunk or on two separate ones.

    The Vex head is one linear unit on the value's last hidden layer. It always exists, so that
    arms with and without it share one program and one initialisation.

    Attributes:
      make_trunk: builds the trunk module under a given name, as a part of a given module.
      num_outputs: width of the policy head.
      log_std_init: start of the log-std, or None for a distribution without one.
      shared: one trunk for all heads.
      predicted: width of the auxiliary head, which stands beside the value head; 0: there is none.
      make_cell: builds the recurrent cell behind a trunk, by its name; None: nothing is remembered.
      noise: how the log-std depends on the last hidden layer; None: it does not.
    """

    make_trunk: Callable[[str, nn.Module], nn.Module]
    num_outputs: int
    log_std_init: float | None
    shared: bool
    predicted: int = 0
    make_cell: Callable[[str], nn.Module] | None = None
    noise: StateNoise | None = None

    @nn.compact
    def __call__(
        self, observation: Array, start: Array | None = None, state: Any = ()
    ) -> PolicyOutput:
        """`[..., *obs]` -> `PolicyOutput` with leading axes `[...]`.

        Args:
          observation: `[L, B, *obs]`, in time order, if there are cells.
          start: `[L, B]` bool, where an episode starts; state: `[B, H]` before the first step, the
            policy's cell first. Of cells alone.
        """
        first = self.make_trunk("trunk" if self.shared else "policy_trunk", self)
        policy_features = first(observation)
        value_features = (
            policy_features if self.shared else self.make_trunk("value_trunk", self)(observation)
        )
        if self.make_cell is not None:
            own = jnp.split(state, 1 if self.shared else 2, -1)
            name = "cell" if self.shared else "policy_cell"
            policy_features, state = self.make_cell(name)(policy_features, start, own[0])
            if self.shared:
                value_features = policy_features
            else:
                value_cell = self.make_cell("value_cell")
                value_features, of_value = value_cell(value_features, start, own[1])
                state = jnp.concatenate([state, of_value], -1)
        hidden = policy_features
        policy = dense(self.num_outputs, 0.01, "policy_head")(policy_features)
        if self.log_std_init is not None:
            log_std = self._log_std(hidden, self.log_std_init)
            policy = jnp.concatenate([policy, jnp.broadcast_to(log_std, policy.shape)], -1)
        value = dense(1, 1.0, "value_head")(value_features)[..., 0]
        vex = dense(1, 1.0, "vex_head")(value_features)[..., 0]
        prediction = None
        if self.predicted:
            prediction = dense(self.predicted, 1.0, "auxiliary_head")(value_features)
        return PolicyOutput(policy, value, vex, hidden, prediction, state)

    def _log_std(self, hidden: Array, first: float) -> Array:
        """The log-std `[A]`; one that depends on the state is `[..., A]`, of a matrix `[H, A]`.

        The matrix begins where features of size 1 give the log-std `first`, however many there are.
        """
        if self.noise is None:
            return self.param("log_std", nn.initializers.constant(first), (self.num_outputs,))
        width = hidden.shape[-1]
        start = nn.initializers.constant(first - 0.5 * math.log(width))
        log_std = self.param("log_std", start, (width, self.num_outputs))
        features = hidden if self.noise.learn_features else jax.lax.stop_gradient(hidden)
        return state_log_std(features, deviation(log_std, self.noise.expln))
