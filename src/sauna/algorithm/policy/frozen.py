"""A policy whose parameters and normaliser stay as they are, one raw observation at a time."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.algorithm.types import Array
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces, action_writer, observation_reader


class FrozenPolicy:
    """`policy(observation) -> action` for one raw observation of the environment.

    The action is the distribution's mode unless `deterministic=False` and a key are given.

    Args:
      config: whose network and normalisation it has.
      spaces: of `env`.
      env: a Gymnasium environment, whose spaces are read.
    """

    def __init__(self, config: Config, spaces: Spaces, env: Any) -> None:
        self.config = config
        self._read = observation_reader(env.observation_space)
        self.write = action_writer(env.action_space, config.rescale_actions)
        self._dtype = spaces.observation_dtype
        self.policy: Policy = make_policy(config, spaces)
        self.params: Any = None
        self._moments: Moments | None = None
        self._act = jax.jit(self._choose, static_argnames="deterministic")
        self._predict = jax.jit(self._heads)
        self._log_prob = jax.jit(self._likelihood)

    def load(self, params: Array, moments: Moments | None) -> None:
        """Takes over parameters `[D]` and moments of `[obs]`; None: nothing is normalised."""
        self.params, self._moments = jax.numpy.asarray(params), moments

    def _choose(self, params: Array, observation: Any, key: Any, *, deterministic: bool) -> Any:
        distribution = self.policy.distribution
        parameters = self.policy.apply(params, observation).policy
        if deterministic:
            return distribution.mode(parameters)
        return distribution.sample(parameters, distribution.draw(key, parameters.shape[:-1]))

    def __call__(self, observation: Any, *, deterministic: bool = True, key: Any = None) -> Any:
        """The action for one raw observation, clipped or stretched as the environment wants it.

        Sampled actions need a JAX `key`; the normaliser is never updated.
        """
        return self.write(self.act(observation, deterministic=deterministic, key=key))

    def act(self, observation: Any, *, deterministic: bool = True, key: Any = None) -> np.ndarray:
        """What the network chooses for one raw observation `[A]`, neither clipped nor stretched."""
        if not deterministic and key is None:
            raise ValueError("a sampled action needs key=jax.random.key(...)")
        key = jax.random.key(0) if key is None else key
        seen = self.see(observation)[None]
        action = self._act(self.params, seen, key, deterministic=deterministic)
        return np.asarray(action)[0]

    def see(self, observation: Any) -> np.ndarray:
        """What the network gets of one raw observation `[*obs]`: float32, normalised; or uint8."""
        seen = self._read(observation)[None]
        if self._moments is not None:
            seen = normalize(self._moments, seen, self.config.clip_observations)
        return seen[0].astype(self._dtype)

    def _heads(self, params: Array, observation: Any) -> Any:
        output = self.policy.apply(params, observation)
        return output.value, output.vex

    def _likelihood(self, params: Array, observation: Any, action: Any) -> Any:
        output = self.policy.apply(params, observation)
        return self.policy.distribution.log_prob(output.policy, action)
