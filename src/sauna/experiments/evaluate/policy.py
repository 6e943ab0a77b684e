"""A trained policy with everything it needs to act: parameters, frozen normaliser, spaces."""

from __future__ import annotations

import json
from typing import Any

import jax
import numpy as np

from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.envs.host.answers import close
from sauna.envs.make import make_env
from sauna.envs.shapes import batch_size, one_of
from sauna.envs.spaces import action_writer, observation_reader
from sauna.experiments.evaluate.artifact import Artifact, check_spaces, find_member
from sauna.system.checkpoint import BadCheckpoint
from sauna.system.errors import BadInput
from sauna.training.loop.member_state import fitting, flat_params, under

CHUNK = 512  # observations of one call of `heads`: one compiled shape, and bounded memory


class TrainedPolicy:
    """`policy(observation) -> action` for a raw observation of the environment, or a batch.

    The action is the distribution's mode unless `deterministic=False` and a key are given.

    Args:
      artifact: of the run.
      member: name (`sauna/0`) or index.
      env: an environment with the run's spaces; made and closed here if not given.

    Raises:
      BadInput: there is no such member, or `env` has other spaces than the run.
    """

    def __init__(self, artifact: Artifact, member: str | int = 0, env: Any = None) -> None:
        self.config, self.name = artifact.config, find_member(artifact.members, member)
        made = env is None
        env = env or make_env(self.config.env, json.loads(self.config.env_kwargs))
        check_spaces(artifact, env)
        self._space = env.observation_space
        self._read = observation_reader(env.observation_space)
        self._write = action_writer(env.action_space, self.config.rescale_actions)
        if made:
            close(env)
        own = under(self.name + "/", artifact.checkpoint.arrays)
        if len(self.config.hidden) > len(own):  # each layer has arrays of its own
            raise BadCheckpoint(f"{artifact.checkpoint.path}: it lacks layers that its config has")
        self._policy: Policy = make_policy(self.config, artifact.spaces)
        example = jax.eval_shape(self._policy.init, jax.random.key(0))
        self._params = flat_params(self._policy, example, under("params/", own))
        if self.config.normalize_observations:
            size = artifact.spaces.observation_shape
            parts = {"mean": size, "variance": size, "count": (1,)}
            self._moments = Moments(
                **{
                    name: fitting(own, f"observation_moments/{name}", np.zeros(shape))
                    for name, shape in parts.items()
                }
            )
        self._dtype = artifact.spaces.observation_dtype
        self._act = jax.jit(self._choose, static_argnames="deterministic")
        self._compiled_heads = jax.jit(self._heads)
        self._calls = 0  # of `predict`

    def _choose(self, observation: Any, key: Any, *, deterministic: bool) -> Any:
        distribution = self._policy.distribution
        parameters = self._policy.apply(self._params, observation).policy
        if deterministic:
            return distribution.mode(parameters)
        return distribution.sample(parameters, distribution.draw(key, parameters.shape[:-1]))

    def __call__(self, observation: Any, *, deterministic: bool = True, key: Any = None) -> Any:
        """The action for a raw observation, clipped or stretched as the environment wants it.

        A batch of observations (each array with one more axis, in front) gives an array of actions.
        Each new size of a batch is compiled once. Sampled actions need a JAX `key`; the normaliser
        is never updated.

        Raises:
          BadInput: `observation` is not of the environment's space.
        """
        if not deterministic and key is None:
            raise ValueError("a sampled action needs key=jax.random.key(...)")
        key = jax.random.key(0) if key is None else key
        rows, is_batch = self._rows(observation)
        actions = np.asarray(self._act(self._seen(rows), key, deterministic=deterministic))
        if is_batch:
            return np.stack([np.asarray(self._write(action)) for action in actions])
        return self._write(actions[0])

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, None]:
        """The same with the arguments, the default and the answer of Stable-Baselines3's `predict`.

        Sampled actions follow from how many calls there were before.

        Args:
          state, episode_start: of recurrent policies, which there are none of; not read.

        Returns:
          `(action, None)`.

        Raises:
          BadInput: as `__call__`.
        """
        key = jax.random.fold_in(jax.random.key(0), self._calls)
        self._calls += 1
        return self(observation, deterministic=deterministic, key=key), None

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

    def _seen(self, rows: np.ndarray) -> np.ndarray:
        """What the network gets of raw observations `[n, *obs]`."""
        if self.config.normalize_observations:
            rows = normalize(self._moments, rows, self.config.clip_observations)
        return rows.astype(self._dtype)

    def _heads(self, observation: Any) -> Any:
        output = self._policy.apply(self._params, observation)
        return output.value, output.vex

    def heads(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """V and the Vex head, `[L]` each, at what the network got `[L, *obs]`."""
        found = []
        for first in range(0, len(seen), CHUNK):
            part = seen[first : first + CHUNK]
            padded = np.zeros((CHUNK, *part.shape[1:]), part.dtype)
            padded[: len(part)] = part
            found.append([np.asarray(head)[: len(part)] for head in self._compiled_heads(padded)])
        value, vex = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return value, vex
