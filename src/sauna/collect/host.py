"""Collecting rollouts from host environments, for all members of a process in lockstep.

Acting and filtering are separate: the policy acts for a stretch of steps, then the filter decides
about the whole stretch in one call. A decision never changes how an env acts, so this gives the
mask that deciding after each step would give. With `dropped="replace"` a stretch is as long as the
smallest number of steps that some env still lacks: no env can overshoot.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from sauna.config import Config
from sauna.core.normalize import Moments, initial_moments, normalize, scale, update_moments
from sauna.core.population import Keys, Program
from sauna.core.types import Array, Hypers, Rollout
from sauna.envs.contract import HostEnvs, Step
from sauna.spaces import Spaces


class CollectState(NamedTuple):
    """What persists between rollouts; arrays with a leading member axis P, changed in place."""

    observation: np.ndarray  # [P, N, *obs] float64 or uint8, as the env gave it
    observation_moments: Moments  # [P, D]
    reward_moments: Moments  # [P, 1], of the discounted return
    discounted_return: np.ndarray  # [P, N] float64
    episode_return: np.ndarray  # [P, N] float64, raw rewards so far
    episode_length: np.ndarray  # [P, N] int64


class Episode(NamedTuple):
    """One finished episode of a member."""

    env: int
    return_: float
    length: int
    truncated: bool
    kept: bool  # whether its last step was kept (the released code reports only such episodes)


class Collected(NamedTuple):
    """What one member collected in one iteration."""

    rollout: Rollout
    env_steps: int
    kept_steps: int
    episodes: list[Episode]


class _Ending(NamedTuple):
    row: int
    env: int
    return_: float
    length: int
    truncated: bool
    final_value: float


class HostCollector:
    """Fills the rollouts of P members from `P * N` host environments.

    Args:
      program: of the population.
      spaces: of the environments.
      envs: env n of member p is row `p * N + n`.
      keys: of each member.
    """

    def __init__(self, program: Program, spaces: Spaces, envs: HostEnvs, keys: list[Keys]) -> None:
        self._program, self._config, self._spaces = program, program.config, spaces
        self._envs, self._keys = envs, keys
        self._shape = (len(keys), self._config.envs)
        self._normalizes = (
            self._config.normalize_observations and spaces.observation_kind == "vector"
        )
        self._capacity = capacity(self._config)
        self._buffers: Any = self._allocate()  # a Rollout of numpy arrays [P, S, N, ...]
        self.state = self._initial_state()

    def _initial_state(self) -> CollectState:
        members, shape = self._shape[0], self._shape
        size = int(np.prod(self._spaces.observation_shape)) if self._normalizes else 1
        dtype = np.uint8 if self._spaces.observation_kind == "image" else np.float64
        return CollectState(
            np.zeros((*shape, *self._spaces.observation_shape), dtype),
            initial_moments((members,), size),
            initial_moments((members,), 1),
            np.zeros(shape),
            np.zeros(shape),
            np.zeros(shape, np.int64),
        )

    def _allocate(self) -> Any:
        members, number = self._shape
        lead = (members, self._capacity, number)
        spaces = self._spaces
        arrays: dict[str, Any] = {
            "observation": np.zeros((*lead, *spaces.observation_shape), spaces.observation_dtype),
            "action": np.zeros((*lead, spaces.action_width), spaces.action_dtype),
        }
        for name in ("log_prob", "reward", "value", "next_value", "vex"):
            arrays[name] = np.zeros(lead, np.float32)
        for name in ("terminated", "truncated", "valid", "keep"):
            arrays[name] = np.zeros(lead, bool)
        return Rollout(**arrays)

    def start(self) -> None:
        """Resets every environment; the first observations enter the running moments."""
        observation = self._envs.reset().reshape(self.state.observation.shape)
        self.state.observation[:] = observation
        self._see(np.ones(self._shape, bool))

    def collect(
        self,
        params: Array,
        hypers: list[Hypers],
        iteration: int,
        limit: np.ndarray,
    ) -> list[Collected]:
        """One rollout of every member that may still act.

        Args:
          params: `[P, D]`.
          hypers: of each member; the filter reads them.
          iteration: the action noise and the filter's keys come from it.
          limit: `[P]` env steps per env that a member may try; 0 leaves it out.

        Returns:
          a `Collected` per member (with an empty rollout for those left out).
        """
        self._buffers.valid[:] = False
        self._buffers.keep[:] = False
        endings: list[list[_Ending]] = [[] for _ in self._keys]
        filters = self._start_filters()
        kept = np.zeros(self._shape, np.int64)
        noise: np.ndarray | None = None
        t = 0
        while True:
            wanted = np.minimum(self._config.rollout_steps - kept, limit[:, None] - t)
            if self._config.dropped == "mask":
                wanted = np.minimum(wanted, self._config.rollout_steps - t)
            acting = wanted > 0
            if not acting.any():
                break
            stretch = int(wanted[acting].min())
            for row in range(t, t + stretch):
                if row % self._config.rollout_steps == 0:
                    noise = self._draw(iteration, row // self._config.rollout_steps)
                assert noise is not None
                self._step(params, noise[row % self._config.rollout_steps], row, acting, endings)
            self._decide(filters, hypers, iteration, t, stretch, acting)
            kept += self._buffers.keep[:, t : t + stretch].sum(1)
            t += stretch
        self._fill_next_values(params, endings, t)
        return [self._collected(member, endings[member]) for member in range(len(self._keys))]

    def _draw(self, iteration: int, block: int) -> np.ndarray:
        """Action noise of T steps `[T, P, N, M]`."""
        return np.stack(
            [
                np.asarray(self._program.draw(keys.action, np.int32(iteration), np.int32(block)))
                for keys in self._keys
            ],
            axis=1,
        )

    def _start_filters(self) -> list[Any]:
        filter = self._program.filter
        if filter is None:
            return []
        return [filter.init(self._config.envs, self._capacity) for _ in self._keys]

    def _decide(
        self,
        filters: list[Any],
        hypers: list[Hypers],
        iteration: int,
        first: int,
        length: int,
        acting: np.ndarray,
    ) -> None:
        """Writes `keep` for the rows of a stretch."""
        buffers, rows = self._buffers, slice(first, first + length)
        if not filters:
            buffers.keep[:, rows] = buffers.valid[:, rows]
            return
        for member in np.flatnonzero(acting.any(1)):
            filters[member], mask = self._program.decide(
                filters[member],
                self._padded(buffers.observation[member, rows]),
                self._padded(buffers.vex[member, rows]),
                np.int32(first),
                np.int32(length),
                jax.random.fold_in(self._keys[member].filter, iteration),
                hypers[member],
            )
            buffers.keep[member, rows] = np.asarray(mask)[:length] & acting[member]

    def _padded(self, rows: np.ndarray) -> np.ndarray:
        """`[length, ...]` -> `[T, ...]`, so that stretches of every length share one program."""
        padded = np.zeros((self._config.rollout_steps, *rows.shape[1:]), rows.dtype)
        padded[: rows.shape[0]] = rows
        return padded

    def _step(
        self,
        params: Array,
        noise: np.ndarray,
        row: int,
        acting: np.ndarray,
        endings: list[list[_Ending]],
    ) -> None:
        """Acts once everywhere and writes row `row` of the buffers."""
        state, buffers, width = self.state, self._buffers, self._spaces.action_width
        observation = self._policy_observation()
        packed = np.asarray(self._program.act(params, observation, noise))
        action = packed[..., :width].astype(self._spaces.action_dtype)
        step = self._envs.step(action.reshape(-1, width), acting.reshape(-1))
        buffers.observation[:, row] = observation
        buffers.action[:, row] = action
        buffers.log_prob[:, row] = packed[..., width]
        buffers.value[:, row] = packed[..., width + 1]
        buffers.vex[:, row] = packed[..., width + 2]
        buffers.valid[:, row] = acting
        reward = np.where(acting, step.reward.reshape(self._shape), 0.0)
        terminated = step.terminated.reshape(self._shape) & acting
        truncated = step.truncated.reshape(self._shape) & acting
        buffers.terminated[:, row] = terminated
        buffers.truncated[:, row] = truncated
        state.observation[:] = step.observation.reshape(state.observation.shape)
        state.episode_return[:] += reward
        state.episode_length[:] += acting
        self._see(acting)
        buffers.reward[:, row] = self._scaled_reward(reward, acting)
        ended = terminated | truncated
        if ended.any():
            self._end_episodes(params, step, row, ended, truncated, endings)

    def _policy_observation(self) -> np.ndarray:
        raw = self.state.observation
        if not self._normalizes:
            return raw if raw.dtype == np.uint8 else raw.astype(np.float32)
        clip = self._config.clip_observations
        return normalize(self.state.observation_moments, raw, clip).astype(np.float32)

    def _see(self, acting: np.ndarray) -> None:
        """The observations just received enter the running moments."""
        if self._normalizes:
            moments = update_moments(self.state.observation_moments, self.state.observation, acting)
            self.state = self.state._replace(observation_moments=moments)

    def _scaled_reward(self, reward: np.ndarray, acting: np.ndarray) -> np.ndarray:
        """Rewards over the running std of the discounted return, as VecNormalize has it."""
        if not self._config.normalize_rewards:
            return reward
        discounted = self.state.discounted_return
        discounted[:] = np.where(acting, discounted * self._config.gamma + reward, discounted)
        moments = update_moments(self.state.reward_moments, discounted[..., None], acting)
        self.state = self.state._replace(reward_moments=moments)
        return scale(moments, reward, self._config.clip_rewards)

    def _end_episodes(
        self,
        params: Array,
        step: Step,
        row: int,
        ended: np.ndarray,
        truncated: np.ndarray,
        endings: list[list[_Ending]],
    ) -> None:
        state = self.state
        final = step.final_observation.reshape(state.observation.shape)
        for member, env in zip(*np.nonzero(ended), strict=True):
            final_value = 0.0
            if truncated[member, env] and self._config.truncation == "bootstrap":
                final_value = self._values(params, final, int(member))[env]
            endings[member].append(
                _Ending(
                    row,
                    int(env),
                    float(state.episode_return[member, env]),
                    int(state.episode_length[member, env]),
                    bool(truncated[member, env]),
                    float(final_value),
                )
            )
        state.discounted_return[ended] = 0.0
        state.episode_return[ended] = 0.0
        state.episode_length[ended] = 0

    def _values(self, params: Array, raw: np.ndarray, member: int) -> np.ndarray:
        """V of a member's N raw observations, `raw` being `[P, N, *obs]`."""
        observation = raw[member]
        if self._normalizes:
            moments = Moments(*(part[member] for part in self.state.observation_moments))
            observation = normalize(moments, observation, self._config.clip_observations)
        if observation.dtype != np.uint8:
            observation = observation.astype(np.float32)
        return np.asarray(self._program.value(params[member], observation))

    def _fill_next_values(self, params: Array, endings: list[list[_Ending]], rows: int) -> None:
        """The value of each step's true successor, once all values are known."""
        buffers = self._buffers
        buffers.next_value[:, : rows - 1] = buffers.value[:, 1:rows]
        steps = buffers.valid.sum(1)
        for member in np.flatnonzero(steps.any(1)):
            last = steps[member] - 1
            after = self._values(params, self.state.observation, int(member))
            buffers.next_value[member, last, np.arange(len(last))] = after
            for ending in endings[member]:
                buffers.next_value[member, ending.row, ending.env] = ending.final_value

    def _collected(self, member: int, endings: list[_Ending]) -> Collected:
        rollout = Rollout(*(buffer[member] for buffer in self._buffers))
        episodes = [
            Episode(e.env, e.return_, e.length, e.truncated, bool(rollout.keep[e.row, e.env]))
            for e in endings
        ]
        return Collected(rollout, int(rollout.valid.sum()), int(rollout.keep.sum()), episodes)


def capacity(config: Config) -> int:
    """Env steps per env (S) that one rollout can hold."""
    if config.filter == "none" or config.dropped == "mask":
        return config.rollout_steps
    return config.rollout_steps * config.max_env_steps_factor
