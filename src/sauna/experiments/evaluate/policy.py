"""A trained policy with everything it needs to act: parameters, frozen normaliser, spaces."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.algorithm.policy.normalize import Moments
from sauna.algorithm.policy.policy import scores_of
from sauna.algorithm.policy.recurrent import at_start
from sauna.envs.host.answers import close
from sauna.envs.make import make_env
from sauna.envs.wrapping import wrapping_of
from sauna.system.checkpoint import BadCheckpoint, under
from sauna.training.artifact import Artifact, best_of, check_spaces, find_member
from sauna.training.loop.member_state import fitting, flat_params

CHUNK = 512  # observations of one call of `heads`: one compiled shape, and bounded memory


class TrainedPolicy(FrozenPolicy):
    """`policy(observation) -> action` for a raw observation of the environment, or a batch.

    The action is the distribution's mode unless `deterministic=False` and a key are given.

    Args:
      artifact: of the run.
      member: name (`sauna/0`) or index.
      env: an environment with the run's spaces; made and closed here if not given.
      best: as it was at its best evaluation during training.

    Raises:
      BadInput: there is no such member, `env` has other spaces than the run, or the member was not
        evaluated during training.
    """

    def __init__(
        self, artifact: Artifact, member: str | int = 0, env: Any = None, best: bool = False
    ) -> None:
        config, self.name = artifact.config, find_member(artifact.members, member)
        made = env is None
        env = env or make_env(config.env, json.loads(config.env_kwargs), wrapping_of(config))
        check_spaces(artifact, env)
        own = under(self.name + "/", artifact.checkpoint.arrays)
        if best:
            own = best_of(artifact, self.name)
        if len(config.hidden + config.value_hidden) > len(own):  # each layer has arrays of its own
            raise BadCheckpoint(f"{artifact.checkpoint.path}: it lacks layers that its config has")
        super().__init__(config, artifact.spaces, env)
        if made:
            close(env)
        example = jax.eval_shape(self.policy.init, jax.random.key(0))
        params = flat_params(self.policy, example, under("params/", own))
        moments = None
        if config.normalize_observations:
            size = (artifact.spaces.normalized,)
            parts = {"mean": size, "variance": size, "count": (1,)}
            moments = Moments(
                **{
                    name: fitting(own, f"observation_moments/{name}", np.zeros(shape))
                    for name, shape in parts.items()
                }
            )
        self.load(params, moments)
        self._calls = 0  # of `predict`
        self._step_by_step = jax.jit(self._scored)

    def make_env(self, **more: Any) -> Any:
        """Makes the environment of the run, with the run's wrappers.

        Args:
          **more: further keyword arguments of the environment, such as `render_mode`.

        Raises:
          BadInput: it cannot be made.
        """
        config = self.config
        return make_env(config.env, json.loads(config.env_kwargs), wrapping_of(config), **more)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[Any, Any]:
        """The same with the arguments, the default and the answer of Stable-Baselines3's `predict`.

        Sampled actions follow from how many calls there were before.

        Args:
          state: of a recurrent policy, what the call before gave; None: episodes begin.
          episode_start: `[n]` bool, which episodes begin all the same; of a recurrent policy.
          action_masks: of the valid actions, as sb3-contrib's `MaskablePPO.predict` takes them.

        Returns:
          the action, and the state after it (None of a policy that is not recurrent).

        Raises:
          BadInput: as a call of the policy.
        """
        key = jax.random.fold_in(jax.random.key(0), self._calls)
        self._calls += 1
        how: dict[str, Any] = {"deterministic": deterministic, "action_mask": action_masks}
        if not self.policy.state_size:
            return self(observation, key=key, **how), None
        before, self.state = self.state, () if state is None else state
        if episode_start is not None:
            self.reset(episode_start)
        try:
            return self(observation, key=key, **how), self.state
        finally:
            self.state = before

    def scores(
        self, seen: np.ndarray, action: np.ndarray, start: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What a recurrent policy gives for consecutive steps, and the state before each.

        Args:
          seen: `[L, *obs]` as the network got it; action: `[L, A]` as it chose it.
          start: `[L]` bool, where an episode starts.

        Returns:
          log-probability, value and Vex `[L, 3]`, and states `[L, H]`.
        """
        state = self.policy.initial_state()

        def chunk(*rows: np.ndarray) -> tuple[Any, Any]:
            nonlocal state
            state, found = self._step_by_step(self.params, state, rows)
            return found

        scores, states = _in_chunks(chunk, seen, action, start)
        return scores, states

    def heads(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """V and the Vex head, `[L]` each, at what the network got `[L, *obs]`."""
        value, vex = _in_chunks(partial(self._predict, self.params), seen)
        return value, vex

    def log_prob(self, seen: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Log-probabilities `[L]` of what the network chose `[L, A]` at what it got `[L, *obs]`."""
        (found,) = _in_chunks(lambda *rows: (self._log_prob(self.params, *rows),), seen, action)
        return found

    def _scored(self, params: Any, state: Any, rows: Any) -> Any:
        """The state after rows `[L, ...]`, and of each row its scores and the state before it."""

        def step(state: Any, row: Any) -> Any:
            seen, action, start = row
            before = at_start(start[None], state[None])
            output, after = self.policy.step(params, seen[None], before)
            return after[0], (scores_of(self.policy, output, action[None])[0], before[0])

        return jax.lax.scan(step, state, rows)


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
