"""Collecting rollouts from host environments, for all members of a process in lockstep.

Acting, scoring and filtering are separate: the policy acts for a segment of steps, then one
compiled call per member computes log-probabilities, values and Vex of the whole segment (if acting
has not done so), and one more lets the filter decide about it. A decision never changes how an env
acts, so this gives the mask that deciding after each step would give. With `dropped="replace"` a
segment is as long as the smallest number of steps that some env still lacks: no env can overshoot.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from sauna.algorithm.policy.bounded import to_env
from sauna.algorithm.policy.normalize import (
    Moments,
    initial_moments,
    moments_after_each,
    normalize,
    scale_rewards,
)
from sauna.algorithm.rollout.actor import make_actor
from sauna.algorithm.rollout.collected import Collected, Episode, capacity, chunk_sizes
from sauna.algorithm.rollout.memory import HostMemory
from sauna.algorithm.rollout.moments import ObservationMoments, discounted_returns, running_sum
from sauna.algorithm.rollout.program import Program
from sauna.algorithm.types import Hypers, Keys, Rollout, ScoredStep
from sauna.envs.host.contract import HostEnvs, Step
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.envs.info import info_means
from sauna.envs.spaces import Spaces

_fold_in = jax.jit(jax.random.fold_in)  # compiled: rollouts of few steps draw a key often


class CollectState(NamedTuple):
    """What persists between rollouts; arrays with a leading member axis P, changed in place."""

    observation: np.ndarray  # [P, N, *obs] float64 or uint8, as the env gave it
    discounted_return: np.ndarray  # [P, N] float64
    episode_return: np.ndarray  # [P, N] float64, raw rewards so far
    episode_length: np.ndarray  # [P, N] int64
    memory: Any = ()  # [P, N, H] float32, the states of a recurrent policy


class _Segment(NamedTuple):
    """Rows `first` to `last` of one member, in which the envs of `acting` `[N]` act."""

    first: int
    last: int  # 0: the member has finished its rollout
    acting: np.ndarray


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
        self._capacity = capacity(self._config)
        self._memory = HostMemory(self._config, program.policy, len(keys), self._capacity)
        self._actor = make_actor(
            self._config, spaces, program.policy, program.act, len(keys), self._memory
        )
        # What the policy sees [S + 1, P, N, *obs], rows first: each is written and read as a whole.
        self._observed = np.zeros(
            (self._capacity + 1, *self._shape, *spaces.observation_shape), spaces.observation_dtype
        )
        self._buffers: Any = self._allocate()  # a Rollout of numpy arrays [P, S, N, ...]
        self._rewards = np.zeros((len(keys), self._capacity, self._config.envs))
        self._over = np.zeros(self._rewards.shape, bool)  # episodes; a lost life is not one's end
        self._idle = np.zeros(self._over.shape, bool)  # rows of envs that waited for an episode
        self._infos: list[list[Any]] = [[] for _ in keys]  # of each member's ended episodes
        self._chunks = chunk_sizes(self._config.rollout_steps)
        self._uncompiled = program.filter is not None  # without one, every segment is a rollout
        if program.filter is not None:
            self._fresh_filter = program.filter.init(self._config.envs, self._capacity)
        self.observation_moments = self._observation_moments()
        self.reward_moments = initial_moments((len(keys),), 1)
        self.state = CollectState(
            np.zeros(
                (*self._shape, *spaces.observation_shape),
                np.uint8 if spaces.observation_kind == "image" else np.float64,
            ),
            np.zeros(self._shape),
            np.zeros(self._shape),
            np.zeros(self._shape, np.int64),
            self._memory.state if program.policy.state_size else (),
        )

    def _observation_moments(self) -> ObservationMoments | None:
        size = self._spaces.normalized
        if not self._config.normalize_observations or not size:
            return None
        return ObservationMoments(self._shape[0], size, self._config.clip_observations)

    def _allocate(self) -> Any:
        members, number = self._shape
        lead = (members, self._capacity, number)
        spaces = self._spaces
        arrays: dict[str, Any] = {
            "observation": self._observed[:-1].swapaxes(0, 1),
            "action": np.zeros((*lead, spaces.action_width), spaces.action_dtype),
        }
        for name in ("log_prob", "reward", "value", "next_value", "vex"):
            arrays[name] = np.zeros(lead, np.float32)
        for name in ("terminated", "truncated", "valid", "keep"):
            arrays[name] = np.zeros(lead, bool)
        return Rollout(**arrays, memory=self._memory.rollout)

    def start(self) -> None:
        """Resets every environment; the first observations enter the running moments."""
        self.state.observation[:] = self._envs.reset().reshape(self.state.observation.shape)
        if self.observation_moments is not None:
            there = np.ones(self._shape, bool) & ~self._waiting()
            self.observation_moments.see(self.state.observation, there)

    def collect(
        self, params: np.ndarray, hypers: list[Hypers], iteration: int, limit: np.ndarray
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
        buffers, members = self._buffers, range(len(self._keys))
        for name in ("valid", "keep", "terminated", "truncated"):
            getattr(buffers, name)[:] = False
        self._over[:], self._idle[:] = False, False
        self._infos = [[] for _ in members]
        if self._uncompiled:
            self._compile_segments(params[0], hypers[0])
        self._actor.load(params)
        self._memory.begin()
        self._show()
        filters, keys = self._start_filters(), self._filter_keys(iteration)
        plans = [self._plan(member, 0, limit) for member in members]
        noise, t, block = np.zeros(0), 0, self._config.rollout_steps
        final_values: dict[tuple[int, int, int], float] = {}
        while any(plan.last > t for plan in plans):
            if t % block == 0:
                noise = self._actor.prepare(self._draw(iteration, t // block))
            ends = [plan.last for plan in plans if plan.last > t]
            until = min(*ends, t - t % block + block)
            acting = np.stack([plan.acting for plan in plans])
            buffers.valid[:, t:until] = acting[:, None]
            self._act(params, noise, t, until, acting, final_values)
            t = until
            for member in members:
                if plans[member].last == t:
                    first = plans[member].first
                    if not self._actor.gives_scores:
                        self._score(params[member], member, first, t)
                    self._decide(filters, keys, hypers[member], member, first, t)
                    plans[member] = self._plan(member, t, limit)
        self._fill_next_values(params, final_values, t)
        return [self._collected(member) for member in members]

    def _compile_segments(self, params: np.ndarray, hypers: Hypers) -> None:
        """Compiles for every length of a segment now, so that none has to be later on."""
        filters, key = self._start_filters(), self._keys[0].filter
        for size in self._chunks:
            observation, action = (
                np.zeros((size, *buffer.shape[2:]), buffer.dtype)
                for buffer in (self._buffers.observation, self._buffers.action)
            )
            scores = np.zeros((*observation.shape[:2], 3), np.float32)
            if not self._actor.gives_scores:
                memory = self._memory.of_segment(0, slice(0, size))
                scores = np.asarray(self._program.score(params, observation, action, *memory))
            steps = ScoredStep(observation, action, *(scores[..., i] for i in range(3)))
            none = np.int32(0)
            self._program.decide(filters[0], steps, none, none, key, hypers)
        self._uncompiled = False

    def _plan(self, member: int, t: int, limit: np.ndarray) -> _Segment:
        """A member's next segment, from row `t` on. It depends on nothing but the member."""
        steps = self._config.rollout_steps
        wanted = np.minimum(steps - self._buffers.keep[member].sum(0), limit[member] - t)
        if self._config.dropped == "mask" or self._program.filter is None:
            wanted = np.minimum(wanted, steps - t)
        acting = wanted > 0
        self._memory.begin_segment(member)
        return _Segment(t, t + int(wanted[acting].min()) if acting.any() else 0, acting)

    def _draw(self, iteration: int, block: int) -> np.ndarray:
        """Action noise of T steps `[T / hold, P, N, M]`."""
        return np.stack(
            [
                np.asarray(self._program.draw(keys.action, np.int32(iteration), np.int32(block)))
                for keys in self._keys
            ],
            axis=1,
        )

    def _act(
        self,
        params: np.ndarray,
        noise: np.ndarray,
        first: int,
        last: int,
        acting: np.ndarray,
        final_values: dict[tuple[int, int, int], float],
    ) -> None:
        """Acts everywhere for rows `first` to `last` of the buffers; `noise` is of their block."""
        policy, block = self._program.policy, self._config.rollout_steps
        actor, moments, seen = self._actor, self.observation_moments, self.state.observation
        shape, active, width = self._shape, acting.reshape(-1), self._spaces.action_width
        observations = self._observed
        self._memory.acting = acting
        waits, bounded = self._envs.waiting is not None, policy.distribution.bounded
        hold, scored = policy.hold, actor.gives_scores
        actions, rewards = self._buffers.action.swapaxes(0, 1), self._rewards.swapaxes(0, 1)
        for row in range(first, last):
            if waits:
                self._memory.acting = acting & ~self._waiting()
                self._note_idle(row, acting)
            own = noise[row % block // hold]
            actions[row] = action = actor.act(observations[row], own)
            if scored:
                self._write_scores((slice(None), row), actor.scores)
            shown = to_env(policy.distribution, action) if bounded else action
            step = self._envs.step(shown.reshape(-1, width), active)
            rewards[row] = step.reward.reshape(shape)
            seen = step.observation.reshape(seen.shape)
            if moments is None:
                observations[row + 1] = seen
            else:
                there = acting & ~self._waiting() if waits else acting
                moments.see_and_normalize(seen, there, observations[row + 1])
            if step.ended:
                self._note_ends(params, step, row, acting, final_values)
        self.state.observation[:] = seen

    def _waiting(self) -> np.ndarray | np.bool:
        """Which envs wait for their next episode: `[P, N]`, or False for none."""
        waiting = self._envs.waiting
        return np.False_ if waiting is None else waiting.reshape(self._shape)

    def _note_idle(self, row: int, acting: np.ndarray) -> None:
        """Writes which envs take no step in a row.

        Raises:
          EnvironmentFailure: a step filter, which looks at every row, would see it.
        """
        if self._envs.waiting is None or not self._envs.waiting.any():
            return
        if self._program.filter is not None or self._config.gae_over == "kept":
            raise EnvironmentFailure(
                "an environment waits for its next episode to begin, and a step filter cannot "
                "pass over that; train arms without one (ppo, or a sampler)"
            )
        self._idle[:, row] = acting & self._waiting()
        self._buffers.valid[:, row] = acting & ~self._waiting()

    def _show(self) -> None:
        """Writes the current observations, normalised, to the first row."""
        if self.observation_moments is None:
            self._observed[0] = self.state.observation
        else:
            self.observation_moments.normalize(self.state.observation, self._observed[0])

    def _note_ends(
        self,
        params: np.ndarray,
        step: Step,
        row: int,
        acting: np.ndarray,
        final_values: dict[tuple[int, int, int], float],
    ) -> None:
        """Writes which episodes ended; the value of what a truncated one had reached is kept."""
        terminated = step.terminated.reshape(self._shape) & acting
        truncated = step.truncated.reshape(self._shape) & acting
        self._over[:, row] = terminated | truncated
        for index in sorted(step.info):
            member, env = divmod(index, self._shape[1])
            if self._over[member, row, env]:
                self._infos[member].append(step.info[index])
        terminated |= step.life_lost.reshape(self._shape) & acting
        self._buffers.terminated[:, row] = terminated
        self._buffers.truncated[:, row] = truncated
        if self._config.truncation == "bootstrap" and truncated.any():
            final = step.final_observation.reshape(self.state.observation.shape)
            for member, env in np.argwhere(truncated).tolist():
                value = self._values(params, final, member)[env]
                final_values[member, row, env] = float(value)
        self._memory.forget(self._over[:, row])

    def _values(self, params: np.ndarray, raw: np.ndarray, member: int) -> np.ndarray:
        """V of a member's N raw observations, `raw` being `[P, N, *obs]`."""
        observation = raw[member]
        if self.observation_moments is not None:
            moments = self.observation_moments.of(member)
            observation = normalize(moments, observation, self._config.clip_observations)
        observation = observation.astype(self._spaces.observation_dtype)
        state = self._memory.now(member)
        return np.asarray(self._program.value(params[member], observation, *state))

    def _score(self, params: np.ndarray, member: int, first: int, last: int) -> None:
        """Writes the scores of a member's segment."""
        buffers, rows = self._buffers, slice(first, last)
        observation = self._padded(buffers.observation[member, rows])
        action = self._padded(buffers.action[member, rows])
        memory = self._memory.of_segment(member, rows)
        memory[:1] = map(self._padded, memory[:1])
        found = self._program.score(params, observation, action, *memory)
        self._write_scores((member, rows), np.asarray(found)[: last - first])

    def _write_scores(self, place: Any, scores: np.ndarray) -> None:
        """Writes log-probability, value and Vex `[..., 3]` to a place of the buffers."""
        for i, name in enumerate(("log_prob", "value", "vex")):
            getattr(self._buffers, name)[place] = scores[..., i]

    def _start_filters(self) -> list[Any]:
        return [] if self._program.filter is None else [self._fresh_filter for _ in self._keys]

    def _filter_keys(self, iteration: int) -> list[Any]:
        if self._program.filter is None:
            return []
        return [_fold_in(keys.filter, np.int32(iteration)) for keys in self._keys]

    def _decide(
        self,
        filters: list[Any],
        keys: list[Any],
        hypers: Hypers,
        member: int,
        first: int,
        last: int,
    ) -> None:
        """Writes `keep` for the rows of a member's segment."""
        buffers, rows = self._buffers, slice(first, last)
        valid = buffers.valid[member, rows]
        if not filters:
            buffers.keep[member, rows] = valid
            return
        filters[member], mask = self._program.decide(
            filters[member],
            ScoredStep(
                *(self._padded(getattr(buffers, n)[member, rows]) for n in ScoredStep._fields)
            ),
            np.int32(first),
            np.int32(last - first),
            keys[member],
            hypers,
        )
        buffers.keep[member, rows] = np.asarray(mask)[: last - first] & valid

    def _padded(self, rows: np.ndarray) -> np.ndarray:
        """`[length, ...]` -> `[chunk, ...]`: segments of all lengths share a few programs."""
        size = next(size for size in self._chunks if size >= len(rows))
        if size == len(rows):
            return rows
        padded = np.zeros((size, *rows.shape[1:]), rows.dtype)
        padded[: len(rows)] = rows
        return padded

    def _fill_next_values(
        self, params: np.ndarray, final_values: dict[tuple[int, int, int], float], rows: int
    ) -> None:
        """The value of each step's true successor, once all values are known."""
        buffers = self._buffers
        buffers.next_value[:, : rows - 1] = buffers.value[:, 1:rows]
        steps = (buffers.valid | self._idle).sum(1)
        for member in np.flatnonzero(steps.any(1)):
            last = steps[member] - 1
            after = self._values(params, self.state.observation, int(member))
            buffers.next_value[member, last, np.arange(len(last))] = after
        ended = buffers.terminated | buffers.truncated
        buffers.next_value[ended] = 0.0
        for place, value in final_values.items():
            buffers.next_value[place] = value

    def _collected(self, member: int) -> Collected:
        episodes = self._finish(member)
        rollout = jax.tree.map(lambda buffer: buffer[member], self._buffers)
        returns = [episode.return_ for episode in episodes]
        lengths = [episode.length for episode in episodes]
        return Collected(
            rollout,
            int(rollout.valid.sum()),
            int(rollout.keep.sum()),
            len(episodes),
            sum(returns) / len(returns) if returns else math.nan,
            sum(lengths) / len(lengths) if lengths else math.nan,
            episodes,
            info_means(self._infos[member]),
        )

    def _finish(self, member: int) -> list[Episode]:
        """Scales a member's rewards; its episodes, in the order in which they ended."""
        buffers, state = self._buffers, self.state
        used = int((buffers.valid | self._idle)[member].any(1).sum())
        valid = buffers.valid[member, :used]
        reward = np.where(valid, self._rewards[member, :used], 0.0)
        ended = (buffers.terminated | buffers.truncated)[member, :used]
        learned = np.sign(reward) if self._config.sign_rewards else reward
        buffers.reward[member, :used] = self._scaled(member, learned, ended, valid)
        returns, lengths = state.episode_return[member], state.episode_length[member]
        starts, episodes = [0] * len(returns), []
        for row, env in np.argwhere(self._over[member, :used]).tolist():
            episodes.append(
                Episode(
                    env,
                    running_sum(returns[env], reward[starts[env] : row + 1, env]),
                    int(lengths[env] + valid[starts[env] : row + 1, env].sum()),
                    bool(buffers.truncated[member, row, env]),
                    bool(buffers.keep[member, row, env]),
                )
            )
            returns[env], lengths[env], starts[env] = 0.0, 0, row + 1
        for env, start in enumerate(starts):
            returns[env] = running_sum(returns[env], reward[start:, env])
            lengths[env] += int(valid[start:, env].sum())
        return episodes

    def _scaled(
        self, member: int, reward: np.ndarray, ended: np.ndarray, valid: np.ndarray
    ) -> np.ndarray:
        """Rewards `[S, N]` over the running std of the discounted return, as in VecNormalize."""
        if not self._config.normalize_rewards or not len(reward):
            return reward
        own = Moments(*(float(part[member, 0]) for part in self.reward_moments))
        sums, last = discounted_returns(
            reward, ended, valid, self.state.discounted_return[member], self._config.gamma
        )
        self.state.discounted_return[member] = last
        after = moments_after_each(own, sums, valid)
        for part, value in zip(self.reward_moments, after, strict=True):
            part[member, 0] = value[-1]
        return scale_rewards(after, reward, self._config.clip_rewards)
