"""A trained policy with everything it needs to act: parameters, frozen normaliser, spaces."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.envs.host.answers import close
from sauna.envs.make import make_env
from sauna.envs.spaces import action_writer, observation_reader
from sauna.experiments.evaluate.artifact import Artifact, check_spaces, find_member
from sauna.system.checkpoint import BadCheckpoint
from sauna.training.loop.member_state import fitting, flat_params, under

CHUNK = 512  # observations of one call of `predict`: one compiled shape, and bounded memory


class TrainedPolicy:
    """`policy(observation) -> action` for one raw observation of the environment.

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
        self._read = observation_reader(env.observation_space)
        self.write = action_writer(env.action_space, self.config.rescale_actions)
        if made:
            close(env)
        own = under(self.name + "/", artifact.checkpoint.arrays)
        if len(self.config.hidden) > len(own):  # each layer has arrays of its own
            raise BadCheckpoint(f"{artifact.checkpoint.path}: it lacks layers that its config has")
        self.policy: Policy = make_policy(self.config, artifact.spaces)
        example = jax.eval_shape(self.policy.init, jax.random.key(0))
        self.params = flat_params(self.policy, example, under("params/", own))
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
        self._predict = jax.jit(self._heads)
        self._log_prob = jax.jit(self._likelihood)

    def _choose(self, observation: Any, key: Any, *, deterministic: bool) -> Any:
        distribution = self.policy.distribution
        parameters = self.policy.apply(self.params, observation).policy
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
        action = self._act(self.see(observation)[None], key, deterministic=deterministic)
        return np.asarray(action)[0]

    def see(self, observation: Any) -> np.ndarray:
        """What the network gets of one raw observation `[*obs]`: float32, normalised; or uint8."""
        seen = self._read(observation)[None]
        if self.config.normalize_observations:
            seen = normalize(self._moments, seen, self.config.clip_observations)
        return seen[0].astype(self._dtype)

    def _heads(self, observation: Any) -> Any:
        output = self.policy.apply(self.params, observation)
        return output.value, output.vex

    def _likelihood(self, observation: Any, action: Any) -> Any:
        output = self.policy.apply(self.params, observation)
        return self.policy.distribution.log_prob(output.policy, action)

    def predict(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """V and the Vex head, `[L]` each, at what the network got `[L, *obs]`."""
        value, vex = _in_chunks(self._predict, seen)
        return value, vex

    def log_prob(self, seen: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Log-probabilities `[L]` of what the network chose `[L, A]` at what it got `[L, *obs]`."""
        (found,) = _in_chunks(lambda *rows: (self._log_prob(*rows),), seen, action)
        return found


def _in_chunks(function: Callable[..., tuple[Any, ...]], *rows: np.ndarray) -> list[np.ndarray]:
    """What `function` gives for rows `[L, ...]`, asked for `CHUNK` of them at a time."""
    found = []
    for first in range(0, len(rows[0]), CHUNK):
        parts = [x[first : first + CHUNK] for x in rows]
        padded = [np.zeros((CHUNK, *x.shape[1:]), x.dtype) for x in parts]
        for place, part in zip(padded, parts, strict=True):
            place[: len(part)] = part
        found.append([np.asarray(x)[: len(parts[0])] for x in function(*padded)])
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]
