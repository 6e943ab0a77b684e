"""A policy whose parameters and normaliser stay as they are, at rows and at raw observations."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from sauna.algorithm.policy.bounded import to_env
from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.algorithm.types import Array
from sauna.config.settings import Config
from sauna.envs.actions import action_writer
from sauna.envs.masked import MASK, OBSERVATION, flat_masks, is_masked
from sauna.envs.shapes import batch_size, one_of
from sauna.envs.spaces import Spaces, observation_reader
from sauna.envs.wrapping import wrapped_space, wrapping_of
from sauna.system.errors import BadInput


class FrozenNetwork:
    """`network(row) -> action`: of observations and actions as `HostEnvs` has them.

    A recurrent network remembers the observations that it is called with: call `reset` at the start
    of an episode.

    Args:
      config: whose network and normalisation it has.
      spaces: of the environment.
    """

    def __init__(self, config: Config, spaces: Spaces) -> None:
        self.config = config
        self._dtype = spaces.observation_dtype
        self.policy: Policy = make_policy(config, spaces)
        self.params: Any = None
        self.state: Any = ()  # [n, H] of a recurrent policy; () before an episode's first step
        self._moments: Moments | None = None
        self._act = jax.jit(self._choose, static_argnames="deterministic")

    def load(self, params: Array, moments: Moments | None) -> None:
        """Takes over parameters `[D]` and moments of `[obs]`; None: nothing is normalised."""
        self.params, self._moments = jax.numpy.asarray(params), moments
        self.reset()

    def reset(self, ended: Any = None) -> None:
        """Forgets what was observed; a policy that is not recurrent has nothing to forget.

        Args:
          ended: `[n]` bool, which of a batch's episodes have ended; default all.
        """
        if ended is None or isinstance(self.state, tuple):
            self.state = ()
        else:
            over = np.asarray(ended, bool).reshape(-1)
            self.state = np.where(over[:, None], np.float32(0.0), self.state)

    def _choose(
        self, params: Array, observation: Any, state: Any, key: Any, *, deterministic: bool
    ) -> Any:
        distribution = self.policy.distribution
        output, state = self.policy.step(params, observation, state)
        if deterministic:
            return distribution.mode(output.policy), state
        noise = distribution.draw(key, output.policy.shape[:-1])
        return self.policy.sample(params, output, noise), state

    def __call__(self, observation: Any, *, deterministic: bool = True, key: Any = None) -> Any:
        """The action `[A]` for an observation `[*obs]`; see `HostEnvs.step`."""
        action = self._choices(observation[None], deterministic, key)[0]
        return to_env(self.policy.distribution, action)

    def _choices(self, rows: np.ndarray, deterministic: bool, key: Any) -> np.ndarray:
        """What the network chooses for raw observations `[n, *obs]`: `[n, A]`."""
        if not deterministic and key is None:
            raise ValueError("a sampled action needs key=jax.random.key(...)")
        key = jax.random.key(0) if key is None else key
        state = self.state_for(len(rows))
        actions, self.state = self._act(
            self.params, self._seen(rows), state, key, deterministic=deterministic
        )
        return np.asarray(actions)

    def state_for(self, number: int) -> Any:
        """The states `[number, H]` with which as many episodes go on, or begin.

        Raises:
          BadInput: another number of episodes goes on.
        """
        if isinstance(self.state, tuple):
            return self.policy.initial_state(number)
        if len(self.state) != number:
            raise BadInput(
                f"a recurrent policy remembers {len(self.state)} episodes, and got observations of "
                f"{number}; call reset() first"
            )
        return self.state

    def _seen(self, rows: np.ndarray) -> np.ndarray:
        """What the network gets of raw observations `[n, *obs]`."""
        if self._moments is not None:
            rows = normalize(self._moments, rows, self.config.clip_observations)
        return rows.astype(self._dtype)


class FrozenPolicy(FrozenNetwork):
    """`policy(observation) -> action` for a raw observation of the environment, or a batch.

    The action is the distribution's mode unless `deterministic=False` and a key are given.

    A recurrent policy remembers the observations that it is called with: call `reset` at the start
    of an episode.

    Args:
      config: whose network and normalisation it has.
      spaces: of `env`.
      env: a Gymnasium environment, whose spaces are read.
    """

    def __init__(self, config: Config, spaces: Spaces, env: Any) -> None:
        super().__init__(config, spaces)
        self._space = wrapped_space(env, wrapping_of(config))
        self._sizes = spaces.action_sizes if spaces.mask else ()  # of the masks
        self._read = observation_reader(self._space)
        self._write = action_writer(env.action_space, config.rescale_actions)
        self._predict = jax.jit(self._heads)
        self._log_prob = jax.jit(self._likelihood)

    def __call__(
        self,
        observation: Any,
        *,
        deterministic: bool = True,
        key: Any = None,
        action_mask: Any = None,
    ) -> Any:
        """The action for a raw observation, clipped or stretched as the environment wants it.

        A batch of observations (each array with one more axis, in front) gives an array of actions.
        Each new size of a batch is compiled once. Sampled actions need a JAX `key`; the normaliser
        is never updated.

        Args:
          action_mask: of the valid actions, `[K]` or `[n, K]`, for a policy that was trained with
            masks.

        Raises:
          BadInput: `observation` is not of the environment's space, the mask is none, or a
            recurrent policy has another number of episodes to remember.
        """
        rows, is_batch = self._rows(self._with_mask(observation, action_mask))
        actions = self._choices(rows, deterministic, key)
        if is_batch:
            return np.stack([np.asarray(self.write(action)) for action in actions])
        return self.write(actions[0])

    def _with_mask(self, observation: Any, action_mask: Any) -> Any:
        """An observation together with its mask, as the space of masked observations has it."""
        if action_mask is None:
            if self._sizes and not is_masked(observation):
                raise BadInput(
                    "action_mask: this policy was trained with masks; "
                    "call policy(observation, action_mask=mask)"
                )
            return observation
        if not self._sizes:
            raise BadInput("action_mask: not read by a policy that was trained without masks")
        try:
            masks = flat_masks(action_mask, self._sizes)
        except ValueError as error:
            raise BadInput(f"action_mask: {error}") from None
        return {OBSERVATION: observation, MASK: masks}

    def write(self, action: np.ndarray) -> Any:
        """What the environment takes of what the network chooses `[A]`."""
        return self._write(to_env(self.policy.distribution, action))

    def act(self, observation: Any, *, deterministic: bool = True, key: Any = None) -> np.ndarray:
        """What the network chooses for one raw observation `[A]`, as a rollout holds it."""
        return self._choices(self._read(observation)[None], deterministic, key)[0]

    def _rows(self, observation: Any) -> tuple[np.ndarray, bool]:
        """Raw observations as arrays `[n, *obs]`, and whether they came as a batch."""
        try:
            size = batch_size(self._space, observation)
        except ValueError as error:
            raise BadInput(str(error)) from None
        if size is None:
            return self._read(observation)[None], False
        if size == 0:
            raise BadInput("the batch of observations is empty")
        ones = (one_of(self._space, observation, index) for index in range(size))
        return np.stack([self._read(one) for one in ones]), True

    def see(self, observation: Any) -> np.ndarray:
        """What the network gets of one raw observation `[*obs]`: float32, normalised; or uint8."""
        return self._seen(self._read(observation)[None])[0]

    def _heads(self, params: Array, observation: Any) -> Any:
        output = self.policy.apply(params, observation)
        return output.value, output.vex

    def _likelihood(self, params: Array, observation: Any, action: Any) -> Any:
        output = self.policy.apply(params, observation)
        return self.policy.distribution.log_prob(output.policy, action)
