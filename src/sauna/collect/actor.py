"""How the members of a process choose actions at each vector step.

Acting needs the policy head alone: log-probabilities, values and Vex are computed afterwards for a
whole stretch (`Program.score`). For an MLP the few small products are done in numpy, because a
compiled call costs more than they do; another network acts by a compiled function.

Members keep their own products (a batched `matmul` calls BLAS once for each), so that a member's
actions do not depend on its neighbours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from sauna.config import Config
from sauna.core.policy import Policy
from sauna.spaces import Spaces


class Actor(Protocol):
    """Attributes:
    observation: `[P, N, *obs]` where the normalised observations are written before `act`.
    """

    observation: np.ndarray

    def load(self, params: np.ndarray) -> None:
        """Takes over the parameters `[P, D]` of the coming rollout."""

    def prepare(self, noise: np.ndarray) -> np.ndarray:
        """Many steps' noise of the distribution, `[T, P, N, M]`, in the form that `act` takes."""

    def act(self, noise: np.ndarray) -> np.ndarray:
        """Actions `[P, N, A]`, a new array, with one step's prepared noise `[P, N, M]`."""


class CompiledActor:
    """Acts by `Program.act`, whatever the network is."""

    def __init__(self, act: Any, spaces: Spaces, members: int, envs: int) -> None:
        shape = (members, envs, *spaces.observation_shape)
        self.observation = np.zeros(shape, spaces.observation_dtype)
        self._act = act
        self._params: Any = None

    def load(self, params: np.ndarray) -> None:
        import jax.numpy as jnp

        self._params = jnp.asarray(params)

    def prepare(self, noise: np.ndarray) -> np.ndarray:
        return noise

    def act(self, noise: np.ndarray) -> np.ndarray:
        return np.asarray(self._act(self._params, self.observation, noise))


class MLPActor:
    """Acts by numpy, for the MLP trunks of `core.networks`.

    Each layer's input has a last component 1, whose weights are the biases.
    """

    def __init__(self, config: Config, spaces: Spaces, policy: Policy, members: int) -> None:
        self._policy, self._sample = policy, _sampler(spaces)
        self._trunk = "trunk" if config.trunk == "shared" else "policy_trunk"
        self._activate: Any = np.tanh if config.activation == "tanh" else _relu
        widths = [spaces.observation_shape[0], *config.hidden]
        inputs = [np.ones((members, config.envs, width + 1), np.float32) for width in widths]
        self.observation = inputs[0][..., :-1]
        self._layers = [f"layer_{i}" for i in range(len(config.hidden))]
        outputs = policy.distribution.num_outputs
        self._weights = [
            np.zeros((members, width + 1, after), np.float32)
            for width, after in zip(widths, [*config.hidden, outputs], strict=True)
        ]
        self._inputs = inputs
        self._hidden = [x[..., :-1] for x in inputs[1:]]
        self._sums = [np.zeros((*x.shape[:2], w.shape[2]), np.float32)
                      for x, w in zip(inputs, self._weights, strict=True)]  # fmt: skip
        self._scale = np.ones((members, 1, outputs), np.float32)

    def load(self, params: np.ndarray) -> None:
        for p, vector in enumerate(params):
            tree = self._policy.unravel(vector)["params"]
            layers = [tree[self._trunk][name] for name in self._layers] + [tree["policy_head"]]
            for weight, layer in zip(self._weights, layers, strict=True):
                weight[p, :-1], weight[p, -1] = layer["kernel"], layer["bias"]
            if "log_std" in tree:
                self._scale[p] = np.exp(tree["log_std"])

    def prepare(self, noise: np.ndarray) -> np.ndarray:
        return noise * self._scale

    def act(self, noise: np.ndarray) -> np.ndarray:
        inputs, weights, sums = self._inputs, self._weights, self._sums
        for i, hidden in enumerate(self._hidden):
            np.matmul(inputs[i], weights[i], out=sums[i])
            self._activate(sums[i], out=hidden)
        np.matmul(inputs[-1], weights[-1], out=sums[-1])
        return self._sample(sums[-1] + noise)


def _sampler(spaces: Spaces) -> Callable[[np.ndarray], np.ndarray]:
    """From the policy head's outputs plus noise to actions, as `core.distributions` has it."""
    if spaces.action_kind == "continuous":
        return lambda noisy: noisy
    if spaces.action_kind == "multi_binary":
        return lambda noisy: (noisy > 0).astype(np.int32)
    return lambda noisy: _largest(noisy, spaces.action_sizes)


def _relu(x: np.ndarray, out: np.ndarray) -> None:
    np.maximum(x, np.float32(0), out=out)


def _largest(logits: np.ndarray, sizes: tuple[int, ...]) -> np.ndarray:
    """The largest of each categorical's logits `[..., sum(sizes)]`: int32 `[..., len(sizes)]`."""
    parts = np.split(logits, np.cumsum(sizes)[:-1], -1)
    return np.stack([part.argmax(-1) for part in parts], -1).astype(np.int32)


def make_actor(config: Config, spaces: Spaces, policy: Policy, act: Any, members: int) -> Actor:
    """The fastest actor for the network of `config`."""
    if config.network == "mlp":
        return MLPActor(config, spaces, policy, members)
    return CompiledActor(act, spaces, members, config.envs)
