"""How the members of a process choose actions at each vector step.

For an MLP the few small products are a loop of our own, because a call of a JAX program costs more
than they do. Acting needs the policy head alone: log-probabilities, values and Vex are computed
afterwards for a whole segment (`Program.score`). Another network acts by a call of a JAX program,
which gives these scores as well: a second pass through a CNN would take as long as the first.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from sauna.algorithm.policy.gsde import deviation
from sauna.algorithm.policy.observation import INVALID
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.memory import HostMemory
from sauna.config.choices import ACTIVATIONS
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.system.compiled import compiled

APART, ADDED, MATRIX = range(3)  # how `_act` adds noise to the policy head's outputs
_TANH, _RELU, _ELU, _GELU, _LEAKY_RELU, _SELU, _SIGMOID = range(7)  # places in ACTIVATIONS


class Actor(Protocol):
    """Chooses the actions of P members.

    Attributes:
      gives_scores: whether `scores` holds log-probability, value and Vex `[P, N, 3]` of the last
        actions; otherwise they have to be computed afterwards.
    """

    gives_scores: bool
    scores: np.ndarray

    def load(self, params: np.ndarray) -> None:
        """Takes over the parameters `[P, D]` of the coming rollout."""

    def prepare(self, noise: np.ndarray) -> np.ndarray:
        """Many steps' noise of the distribution, `[T, P, N, M]`, in the form that `act` takes."""

    def act(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Actions `[P, N, A]`, a new array.

        Args:
          observation: `[P, N, *obs]`, normalised.
          noise: one step's prepared noise `[P, N, M]`.
        """


class CompiledActor:
    """Acts by `Program.act`, whatever the network is."""

    gives_scores = True

    def __init__(self, act: Any) -> None:
        self._act = act
        self._params: Any = None
        self.scores = np.zeros(0)

    def load(self, params: np.ndarray) -> None:
        import jax.numpy as jnp

        self._params = jnp.asarray(params)

    def prepare(self, noise: np.ndarray) -> np.ndarray:
        return noise

    def act(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        action, scores = self._act(self._params, observation, noise)
        self.scores = np.asarray(scores)
        return np.asarray(action)


class RecurrentActor(CompiledActor):
    """Acts by `Program.act` with the states of `memory`, and moves them on."""

    gives_scores = False

    def __init__(self, act: Any, memory: HostMemory) -> None:
        super().__init__(act)
        self._memory = memory

    def act(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        action, state = self._act(self._params, observation, noise, self._memory.state)
        self._memory.advance(np.asarray(state))
        return np.asarray(action)


class MLPActor:
    """Acts by a compiled loop, for the MLP trunks of `policy/networks.py`.

    Below each layer's weights stands a row of biases; below that, if layers are normalised, a row
    of scales and one of biases. Numba looks at every array of a call, so that few are faster.
    """

    gives_scores = False
    scores = np.zeros(0)

    def __init__(self, config: Config, spaces: Spaces, policy: Policy, members: int) -> None:
        self._policy, self._sample = policy, _sampler(config, spaces)
        self._expln, self._adds = config.sde_expln, _noise_kind(config, spaces)
        self._trunk = "trunk" if config.trunk == "shared" else "policy_trunk"
        self._layers = [f"layer_{i}" for i in range(len(config.hidden))]
        widths = [spaces.numbers, *config.hidden, policy.distribution.num_outputs]
        self._outputs = widths[-1]
        self._norm_rows = 2 * config.layer_norm
        function = ACTIVATIONS.index(config.activation)
        self._how = self._norm_rows, function, self._adds, spaces.mask
        self._weights = tuple(
            np.zeros((members, before + 1 + self._norm_rows, after), np.float32)
            for before, after in itertools.pairwise(widths)
        )
        self._hidden = np.zeros((len(self._layers), config.envs, max(config.hidden)), np.float32)
        self._scale: Any = np.float32(1.0)
        if policy.distribution.has_log_std:
            features = widths[-2] if self._adds == MATRIX else 1
            self._scale = np.ones((members, 1, features * widths[-1]), np.float32)

    def load(self, params: np.ndarray) -> None:
        for p, vector in enumerate(params):
            tree = self._policy.unravel(vector)["params"]
            layers = [tree[self._trunk][name] for name in self._layers] + [tree["policy_head"]]
            for weight, layer in zip(self._weights, layers, strict=True):
                inputs = len(layer["kernel"])
                weight[p, :inputs], weight[p, inputs] = layer["kernel"], layer["bias"]
            for i, weight in enumerate(self._weights[:-1] if self._norm_rows else ()):
                norm = tree[self._trunk][f"norm_{i}"]
                weight[p, -2:] = norm["scale"], norm["bias"]
            if self._adds == MATRIX:
                self._scale[p] = np.asarray(deviation(tree["log_std"], self._expln)).ravel()
            elif "log_std" in tree:
                self._scale[p] = np.exp(tree["log_std"])

    def prepare(self, noise: np.ndarray) -> np.ndarray:
        return noise * self._scale

    def act(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        noisy = np.empty((*noise.shape[:2], self._outputs), np.float32)
        _act(observation, self._weights, self._hidden, noise, noisy, *self._how)
        return self._sample(noisy, noise)


@compiled
def _act(
    observation: Any,
    weights: Any,
    hidden: Any,
    noise: Any,
    noisy: Any,
    norm_rows: int,
    function: int,
    adds: int,
    mask: int,
) -> None:
    """Writes the policy head's outputs and their noise, member by member, to `noisy` `[P, N, K]`.

    `noise` `[P, N, M]` is added as it is, or as the last hidden layer times a matrix `[H, K]`, or
    not at all: as `adds` says. The last `mask` numbers of an observation say which actions are
    valid; 0: all are.
    """
    last, first = len(weights) - 1, observation.shape[2] - mask
    for p in range(observation.shape[0]):
        for n in range(observation.shape[1]):
            x = observation[p, n]
            for i in range(last):
                weight = weights[i][p]
                y = hidden[i, n, : weight.shape[1]]
                _affine(x, weight, len(weight) - 1 - norm_rows, y)
                if norm_rows:
                    _normalize(y, weight)
                if function == _TANH:
                    _tanh(y)
                else:
                    for j in range(len(y)):
                        y[j] = _activated(y[j], function)
                x = y
            y = noisy[p, n]
            _affine(x, weights[last][p], weights[last].shape[1] - 1 - norm_rows, y)
            if adds == ADDED:
                for j in range(len(y)):
                    y[j] += noise[p, n, j]
            elif adds == MATRIX:
                for k in range(len(x)):
                    for j in range(len(y)):
                        y[j] += x[k] * noise[p, n, k * len(y) + j]
            for j in range(mask):
                if observation[p, n, first + j] == 0:
                    y[j] = np.float32(INVALID)


@compiled
def _affine(x: Any, weight: Any, inputs: int, y: Any) -> None:
    """`y = x @ weight[:inputs] + weight[inputs]`, four inputs at a time to write y less often."""
    y[:] = weight[inputs]
    whole = inputs - inputs % 4
    for k in range(0, whole, 4):
        a, b, c, d = x[k], x[k + 1], x[k + 2], x[k + 3]
        for j in range(len(y)):
            y[j] += (a * weight[k, j] + b * weight[k + 1, j]) + (
                c * weight[k + 2, j] + d * weight[k + 3, j]
            )
    for k in range(whole, inputs):
        for j in range(len(y)):
            y[j] += x[k] * weight[k, j]


@compiled
def _normalize(y: Any, weight: Any) -> None:
    """Layer normalisation in place, with flax's epsilon, by the last two rows: scales, biases."""
    scales = len(weight) - 2
    mean = y.mean()
    scale = np.float32(1) / math.sqrt(((y - mean) ** 2).mean() + np.float32(1e-6))
    for j in range(len(y)):
        y[j] = (y[j] - mean) * scale * weight[scales, j] + weight[scales + 1, j]


@compiled
def _activated(x: Any, function: int) -> Any:
    """An activation but tanh, as `jax.nn` has it; `function` is its place in `ACTIVATIONS`."""
    if function == _RELU:
        return max(x, np.float32(0))
    if function == _ELU:
        return x if x > 0 else math.expm1(x)
    if function == _GELU:  # by a tanh, as is the default there
        inner = np.float32(math.sqrt(2 / math.pi)) * (x + np.float32(0.044715) * x**3)
        return np.float32(0.5) * x * (1 + math.tanh(inner))
    if function == _LEAKY_RELU:
        return x if x > 0 else np.float32(0.01) * x
    if function == _SELU:
        inner = x if x > 0 else np.float32(1.6732632423543772) * math.expm1(x)
        return np.float32(1.0507009873554805) * inner
    sigmoid = 1 / (1 + math.exp(-x))
    return sigmoid if function == _SIGMOID else x * sigmoid


@compiled
def _tanh(y: Any) -> None:
    """tanh in place, by the rational approximation of Eigen and XLA.

    Unlike the library's function it is computed for many numbers at once.
    """
    number = np.float32
    for j in range(len(y)):
        x = min(max(y[j], number(-7.90531110763549805)), number(7.90531110763549805))
        s = x * x
        p = number(-2.76076847742355e-16) * s + number(2.00018790482477e-13)
        p = p * s + number(-8.60467152213735e-11)
        p = p * s + number(5.12229709037114e-08)
        p = p * s + number(1.48572235717979e-05)
        p = p * s + number(6.37261928875436e-04)
        p = p * s + number(4.89352455891786e-03)
        q = number(1.19825839466702e-06) * s + number(1.18534705686654e-04)
        q = q * s + number(2.26843463243900e-03)
        q = q * s + number(4.89352518554385e-03)
        y[j] = x * p / q


@compiled
def _beta(heads: Any, noise: Any, actions: Any) -> None:
    """Writes Beta variates of the outputs `heads` `[P, N, 2 A]`: see `policy/bounded.py`."""
    size, one = actions.shape[-1], np.float32(1)
    tries = noise.shape[-1] // (4 * size)
    for p in range(heads.shape[0]):
        for n in range(heads.shape[1]):
            for i in range(2 * size):
                output = heads[p, n, i]
                soft = max(output, np.float32(0)) + np.log1p(np.exp(-abs(output)))
                d = one + soft - one / np.float32(3)
                c = one / np.sqrt(np.float32(9) * d)
                taken = np.float32(0)
                for k in range(i * tries, (i + 1) * tries):
                    z, e = noise[p, n, k], noise[p, n, 2 * size * tries + k]
                    root = one + z * c
                    log_v = np.float32(3) * np.log(max(root, np.float32(1e-3)))
                    if k == i * tries:
                        taken = log_v
                    bound = np.float32(0.5) * z * z + d * (one - root * root * root + log_v)
                    if root > np.float32(1e-3) and -e < bound:
                        taken = log_v
                        break
                half = np.float32(0.5) * (np.log(d) + taken)
                if i < size:
                    actions[p, n, i] = half
                else:
                    actions[p, n, i - size] -= half


def _sampler(config: Config, spaces: Spaces) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """From the policy head's outputs plus noise to actions, as `policy/distributions.py` has it.

    Where `_act` adds no noise, the second argument has it.
    """
    if spaces.action_kind == "continuous":
        return _beta_sample if config.distribution == "beta" else lambda noisy, noise: noisy
    if spaces.action_kind == "multi_binary":
        return lambda noisy, noise: (noisy > 0).astype(np.int32)
    ends = np.cumsum(spaces.action_sizes)

    def largest(noisy: np.ndarray, noise: np.ndarray) -> np.ndarray:
        chosen = np.empty((*noisy.shape[:-1], len(ends)), np.int32)
        _largest(noisy, ends, chosen)
        return chosen

    return largest


def _beta_sample(heads: np.ndarray, noise: np.ndarray) -> np.ndarray:
    actions = np.empty((*heads.shape[:-1], heads.shape[-1] // 2), np.float32)
    _beta(heads, noise, actions)
    return actions


def _noise_kind(config: Config, spaces: Spaces) -> int:
    """How `_act` adds the noise of the distribution."""
    if spaces.action_kind != "continuous":
        return ADDED
    return {"beta": APART, "gsde": MATRIX}.get(config.distribution, ADDED)


@compiled
def _largest(logits: Any, ends: Any, chosen: Any) -> None:
    """Writes the largest of each categorical's logits `[P, N, sum(sizes)]` to `[P, N, len(sizes)]`.

    As `np.argmax`: of equals the first, and of numbers the first that is none.
    """
    for p in range(logits.shape[0]):
        for n in range(logits.shape[1]):
            start = 0
            for i in range(len(ends)):
                best = start
                for j in range(start + 1, ends[i]):
                    x, y = logits[p, n, j], logits[p, n, best]
                    if x > y or (np.isnan(x) and not np.isnan(y)):
                        best = j
                chosen[p, n, i] = best - start
                start = ends[i]


def make_actor(
    config: Config,
    spaces: Spaces,
    policy: Policy,
    act: Any,
    members: int,
    memory: HostMemory | None = None,
) -> Actor:
    """The fastest actor for the network of `config`; `memory` is read if it is recurrent."""
    if policy.state_size and memory is not None:
        return RecurrentActor(act, memory)
    if config.network == "mlp" and len(spaces.observation_shape) == 1 and not spaces.pictures:
        return MLPActor(config, spaces, policy, members)
    return CompiledActor(act)
