"""The actor-critic with its third head, and the trunks it stands on (flax.linen).

Initialisation follows baselines: orthogonal weights with gain sqrt(2) in the trunks, 0.01 for the
policy head, 1 for the value and Vex heads, zero biases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import flax.linen as nn
import jax.numpy as jnp

from sauna.core.types import Array, PolicyOutput


def dense(width: int, gain: float, name: str) -> nn.Dense:
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(gain), name=name)


class MLP(nn.Module):
    """`[..., obs]` -> `[..., hidden[-1]]`, one activation after each layer."""

    hidden: Sequence[int]
    activation: str = "tanh"

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        activate = {"tanh": nn.tanh, "relu": nn.relu}[self.activation]
        x = observation
        for i, width in enumerate(self.hidden):
            x = activate(dense(width, math.sqrt(2.0), f"layer_{i}")(x))
        return x


class Convolution(nn.Module):
    """A VALID convolution `[B, H, W, C]` -> `[B, H', W', F]` as a few products of matrices.

    The picture is cut into blocks of `stride` x `stride` pixels, after which the kernel moves by
    one; then one product per row of the kernel. XLA's own convolution is many times slower than
    this on a CPU, because its gradient inside a loop (and every update is one) has no fast path.

    Attributes:
      features: F; kernel: its width and height, a multiple of `stride`.
    """

    features: int
    kernel: int
    stride: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        shape = (self.kernel, self.kernel, x.shape[-1], self.features)
        weight = self.param("kernel", nn.initializers.orthogonal(math.sqrt(2.0)), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        across = self.kernel // self.stride  # blocks that the kernel covers
        blocks = into_blocks(x, self.kernel, self.stride)
        width = blocks.shape[2] - across + 1
        beside = jnp.concatenate([blocks[:, :, j : j + width] for j in range(across)], -1)
        if beside.dtype == jnp.uint8:
            beside = beside.astype(jnp.float32) / 255.0
        per_block = (across, self.stride, across, self.stride, -1, self.features)
        rows = weight.reshape(per_block).transpose(0, 2, 1, 3, 4, 5)
        rows = rows.reshape(across, -1, self.features)
        height = blocks.shape[1] - across + 1
        return sum((beside[:, i : i + height] @ rows[i] for i in range(across)), start=bias)


def into_blocks(x: Array, kernel: int, stride: int) -> Array:
    """`[B, H, W, C]` -> `[B, H / stride, W / stride, stride * stride * C]`.

    Pixels that no step of the kernel reaches are cut off.
    """
    height, width = ((n - kernel) // stride * stride + kernel for n in x.shape[1:3])
    x = x[:, :height, :width].reshape(len(x), height // stride, stride, width // stride, -1)
    return x.transpose(0, 1, 3, 2, 4).reshape(len(x), height // stride, width // stride, -1)


class NatureCNN(nn.Module):
    """Images `[..., H, W, C]` -> `[..., 512]` (Mnih et al. 2015, as in baselines).

    uint8 images are scaled to [0, 1] here, so that rollouts hold bytes.
    """

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        lead = observation.shape[:-3]
        x = observation.reshape((-1, *observation.shape[-3:]))
        for i, (features, kernel, stride) in enumerate([(32, 8, 4), (64, 4, 2), (64, 3, 1)]):
            x = nn.relu(Convolution(features, kernel, stride, name=f"conv_{i}")(x))
        x = nn.relu(dense(512, math.sqrt(2.0), "dense")(x.reshape((x.shape[0], -1))))
        return x.reshape((*lead, -1))


class ActorCritic(nn.Module):
    """Policy, value and Vex heads on a shared trunk or on two separate ones.

    The Vex head is one linear unit on the value's last hidden layer. It always exists, so that
    arms with and without it share one program and one initialisation.

    Attributes:
      make_trunk: builds the trunk module under a given name.
      num_outputs: width of the policy head.
      log_std_init: start of the state-independent log-std, or None for discrete actions.
      shared: one trunk for all heads.
    """

    make_trunk: Callable[[str], nn.Module]
    num_outputs: int
    log_std_init: float | None
    shared: bool

    @nn.compact
    def __call__(self, observation: Array) -> PolicyOutput:
        """`[..., *obs]` -> `PolicyOutput` with leading axes `[...]`."""
        policy_features = self.make_trunk("trunk" if self.shared else "policy_trunk")(observation)
        value_features = (
            policy_features if self.shared else self.make_trunk("value_trunk")(observation)
        )
        policy = dense(self.num_outputs, 0.01, "policy_head")(policy_features)
        if self.log_std_init is not None:
            start = nn.initializers.constant(self.log_std_init)
            log_std = self.param("log_std", start, (self.num_outputs,))
            policy = jnp.concatenate([policy, jnp.broadcast_to(log_std, policy.shape)], -1)
        value = dense(1, 1.0, "value_head")(value_features)[..., 0]
        vex = dense(1, 1.0, "vex_head")(value_features)[..., 0]
        return PolicyOutput(policy, value, vex)
