"""Playing the episodes of an evaluation: in this process, in a worker, or on the device.

An episode's seed follows from the member's seed and the episode's number alone, so it is the same
wherever it is played.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from sauna.algorithm.policy.frozen import FrozenNetwork, FrozenPolicy
from sauna.algorithm.policy.normalize import Moments
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.play import Episode, play, play_on_device
from sauna.config.presets import Member
from sauna.envs.device.contract import JaxEnv
from sauna.envs.host.answers import close
from sauna.envs.host.contract import EVALUATION, HostEnvs, episode_seed
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.envs.make import make_env
from sauna.envs.workers import ProcessEnvs
from sauna.envs.wrapping import wrapping_of
from sauna.training.loop.job import Job


class Frozen(NamedTuple):
    """What a member acts with at the end of an iteration."""

    params: Any  # [D]
    moments: Moments | None  # of [obs], float64; None: nothing is normalised


Play = Callable[[Frozen, Member, Sequence[int]], list[Episode]]


def _seed(member: Member, number: int) -> int:
    """The seed of the episode of that number among all evaluations of a member."""
    return episode_seed(member.seed, EVALUATION, number)


def host_player(job: Job) -> HostPlayer | WorkerPlayer:
    """Makes what plays where the job's environments are stepped: here, or in workers."""
    return WorkerPlayer(job) if job.config.env_processes else HostPlayer(job)


class _FinitePolicy(FrozenPolicy):
    """Refuses an observation that is not finite, as training does."""

    def _seen(self, rows: np.ndarray) -> np.ndarray:
        if not (finite := np.isfinite(rows)).all():
            component = int(np.flatnonzero(~finite)[0])
            value = rows.reshape(-1)[component]
            raise EnvironmentFailure(f"observation[{component}] is {value}")
        return super()._seen(rows)


class HostPlayer:
    """Plays in one environment of its own, which is made at the first evaluation."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._env: Any = None
        self._policy: FrozenPolicy | None = None

    def __call__(self, frozen: Frozen, member: Member, numbers: Sequence[int]) -> list[Episode]:
        config = self._job.config
        if self._policy is None:
            kwargs = dict(self._job.env_kwargs)
            self._env = make_env(config.env, kwargs, wrapping_of(config))
            self._policy = _FinitePolicy(config, self._job.spaces, self._env)
        self._policy.load(frozen.params, frozen.moments)
        how, hold = config.eval_deterministic, self._policy.policy.hold
        seeds = [_seed(member, number) for number in numbers]
        return [play(self._policy, self._env, how, seed, hold=hold) for seed in seeds]

    def close(self) -> None:
        """Closes the environment, if there is one."""
        if self._env is not None:
            close(self._env, "the environment of the evaluations")


class WorkerPlayer:
    """Plays in a worker, which is started at the first evaluation, with an environment per member.

    What happens to the worker is found out as it is in training; see `ProcessEnvs`.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._network: FrozenNetwork | None = None
        self._envs: HostEnvs | None = None
        self._rows: dict[str, _Row] = {}  # of each member

    def _start(self) -> FrozenNetwork:
        config, members = self._job.config, self._job.members
        pairs = [(member.seed, EVALUATION) for member in members]
        # Gymnasium steps each: it gives the numbers that `HostPlayer` sees, whatever the task.
        how = "gymnasium", config.rescale_actions, wrapping_of(config)
        kwargs = self._job.env_kwargs
        self._envs = ProcessEnvs(config.env, kwargs, pairs, 1, config.env_timeout, *how)
        zeros = np.zeros(
            (len(members), self._job.spaces.action_width), self._job.spaces.action_dtype
        )
        self._rows = {
            member.name: _Row(self._envs, index, zeros) for index, member in enumerate(members)
        }
        return FrozenNetwork(config, self._job.spaces)

    def __call__(self, frozen: Frozen, member: Member, numbers: Sequence[int]) -> list[Episode]:
        if self._network is None:
            self._network = self._start()
        self._network.load(frozen.params, frozen.moments)
        how, hold = self._job.config.eval_deterministic, self._network.policy.hold
        row, found = self._rows[member.name], []
        for number in numbers:
            row.number = number
            found.append(play(self._network, row, how, _seed(member, number), hold=hold))
        return found

    def close(self) -> None:
        """Ends the worker, if there is one."""
        if self._envs is not None:
            self._envs.close()


class _Row:
    """One of several environments as `play` has it; its seeds follow from its episodes' numbers.

    Attributes:
      number: of the episode that the next reset begins.
    """

    number = 0

    def __init__(self, envs: HostEnvs, index: int, actions: np.ndarray) -> None:
        self._envs, self._index, self._actions = envs, index, actions
        self._active = np.arange(len(actions)) == index
        self._begun: tuple[int, np.ndarray] | None = None  # by the end of the episode before

    def reset(self, *, seed: int) -> tuple[np.ndarray, dict[str, Any]]:
        begun, self._begun = self._begun, None
        if begun is not None and begun[0] == self.number:
            return begun[1], {}
        before = {"episode": np.asarray(self.number - 1)}
        return self._envs.start_after(self._index, before), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
        actions = self._actions.copy()
        actions[self._index] = action
        step, index = self._envs.step(actions, self._active), self._index
        seen, terminated, truncated = (
            part[index] for part in (step.observation, step.terminated, step.truncated)
        )
        if terminated or truncated:
            self._begun = self.number + 1, seen
        return seen, step.reward[index], terminated, truncated, step.info.get(index)


class DevicePlayer:
    """Plays all episodes of an evaluation at once, in one compiled program."""

    def __init__(self, job: Job, env: JaxEnv, policy: Policy) -> None:
        self._episodes = jax.jit(
            partial(
                play_on_device,
                config=job.config,
                env=env,
                policy=policy,
                deterministic=job.config.eval_deterministic,
            )
        )

    def __call__(self, frozen: Frozen, member: Member, numbers: Sequence[int]) -> list[Episode]:
        seeds = [_seed(member, number) for number in numbers]
        keys = jax.vmap(jax.random.key)(np.array(seeds, np.uint32))
        moments = frozen.moments
        if moments is not None:
            moments = Moments(*(np.asarray(part, np.float32) for part in moments))
        played = jax.device_get(self._episodes(np.asarray(frozen.params), moments, keys))
        return [
            Episode(float(return_), int(length), bool(cut), float(s) if np.isfinite(s) else None)
            for return_, length, cut, s in zip(*played, strict=True)
        ]
