"""LSTM and GRU cells that are run over a stream of env steps (flax.linen).

A cell's state is one vector per environment. It is zero at the start of every episode. What does
not depend on the state is computed for all steps at once, so that only one small product per step
is left to the loop.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array

STATES = {"lstm": 2, "gru": 1}  # vectors of a cell's width that its state holds


def at_start(start: Array, state: Array) -> Array:
    """The states `[B, H]` before a step: zero where an episode starts (`start` `[B]`)."""
    return jnp.where(start[:, None], 0.0, state)


def _recurrent_kernel(module: nn.Module, width: int, gates: int) -> Array:
    start = nn.initializers.orthogonal(1.0)
    kernel: Array = module.param("recurrent_kernel", start, (width, gates * width))
    return kernel


class LSTM(nn.Module):
    """A long short-term memory with forget gates (Gers et al. 2000); its state is c beside h.

        i, f, g, o = W x + U h + b
        c' = sigmoid(f) c + sigmoid(i) tanh(g),    h' = sigmoid(o) tanh(c')

    W and U start orthogonal with gain 1. The bias of f starts at 1 (Jozefowicz et al. 2015), the
    others at 0.
    """

    width: int

    @nn.compact
    def __call__(self, x: Array, start: Array, state: Array) -> tuple[Array, Array]:
        """Runs over `L` steps of `B` environments.

        Args:
          x: `[L, B, F]`; start: `[L, B]` bool; state: `[B, 2 * width]` before the first step.

        Returns:
          h after each step `[L, B, width]`, and the state after the last `[B, 2 * width]`.
        """
        width = self.width

        def bias(key: Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> Array:
            return jnp.zeros(shape, dtype).at[width : 2 * width].set(1.0)

        first = nn.initializers.orthogonal(1.0)
        inputs = nn.Dense(4 * width, kernel_init=first, bias_init=bias, name="input")(x)
        kernel = _recurrent_kernel(self, width, 4)

        def step(state: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
            inputs, start = row
            c, h = jnp.split(at_start(start, state), 2, -1)
            i, f, g, o = jnp.split(inputs + h @ kernel, 4, -1)
            c = nn.sigmoid(f) * c + nn.sigmoid(i) * jnp.tanh(g)
            h = nn.sigmoid(o) * jnp.tanh(c)
            return jnp.concatenate([c, h], -1), h

        state, h = jax.lax.scan(step, state, (inputs, start))
        return h, state


class GRU(nn.Module):
    """A gated recurrent unit (Cho et al. 2014), in the form of cuDNN; its state is h.

        r, z = sigmoid(W x + U h + b)
        n = tanh(W_n x + b_n + r (U_n h + c_n)),    h' = (1 - z) n + z h

    W and U start orthogonal with gain 1, all biases at 0.
    """

    width: int

    @nn.compact
    def __call__(self, x: Array, start: Array, state: Array) -> tuple[Array, Array]:
        """Runs over `L` steps of `B` environments; see `LSTM`. The state is `[B, width]`."""
        width = self.width
        first = nn.initializers.orthogonal(1.0)
        inputs = nn.Dense(3 * width, kernel_init=first, name="input")(x)
        kernel = _recurrent_kernel(self, width, 3)
        bias = self.param("recurrent_bias", nn.initializers.zeros, (width,))

        def step(h: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
            inputs, start = row
            h = at_start(start, h)
            r, z, n = jnp.split(inputs, 3, -1)
            of_r, of_z, of_n = jnp.split(h @ kernel, 3, -1)
            z = nn.sigmoid(z + of_z)
            n = jnp.tanh(n + nn.sigmoid(r + of_r) * (of_n + bias))
            h = (1.0 - z) * n + z * h
            return h, h

        state, h = jax.lax.scan(step, state, (inputs, start))
        return h, state


CELLS = {"lstm": LSTM, "gru": GRU}
