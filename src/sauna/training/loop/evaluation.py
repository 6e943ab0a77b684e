"""Evaluations while a run trains: episodes in environments of their own, and what follows.

A member is evaluated at the end of the first iteration that reaches a multiple of `eval_every` env
steps. The episodes' seeds follow from the member's seed and that multiple, so an evaluation is the
same in a run that was resumed, and training is the same without any.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.play import Episode, success_rate
from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.system.checkpoint import under
from sauna.system.errors import one_line
from sauna.training.loop.budget import budget_left
from sauna.training.loop.job import Arrays, Job
from sauna.training.loop.member_state import Counters, fitting, named_params
from sauna.training.loop.players import Frozen, Play
from sauna.training.summary import STOPS


@dataclass
class Evaluated:
    """What a member's evaluations have come to."""

    env_steps: int = 0  # taken in evaluations, and counted apart from training's
    best: float = -math.inf  # the highest mean return
    best_env_steps: int = 0  # of training, when that was reached
    since_best: int = 0  # evaluations
    best_policy: Arrays = field(default_factory=dict)  # parameters and normaliser at the best

    def see(
        self, episodes: Sequence[Episode], env_steps: int, policy: Callable[[], Arrays]
    ) -> dict[str, Any]:
        """Takes in an evaluation after `env_steps` of training; returns what a row says of it."""
        returns = [episode.return_ for episode in episodes]
        lengths = [episode.length for episode in episodes]
        mean = float(np.mean(returns))
        self.env_steps += sum(lengths)
        self.since_best += 1
        if mean > self.best:
            self.best, self.best_env_steps, self.since_best = mean, env_steps, 0
            self.best_policy = policy()
        return {
            "eval_return_mean": mean,
            "eval_return_std": float(np.std(returns)),
            "eval_length_mean": float(np.mean(lengths)),
            "eval_return_best": self.best,
            "eval_returns": returns,
            "eval_env_steps": self.env_steps,
            **{f"eval_{name}": rate for name, rate in success_rate(episodes).items()},
        }

    def stop(self, config: Config, mean: float) -> int:
        """Returns why the member has to stop now, as its index in `STOPS`; 0: it goes on."""
        if config.stop_at is not None and mean >= config.stop_at:
            return STOPS.index("stop_at")
        if config.stop_when_flat and self.since_best >= config.stop_when_flat:
            return STOPS.index("stop_when_flat")
        return 0

    def to_arrays(self) -> Arrays:
        """Named as in a checkpoint; nothing before the first evaluation."""
        if not self.best_policy:
            return {}
        whole = {
            name: getattr(self, name) for name in ("env_steps", "best_env_steps", "since_best")
        }
        arrays = {f"evaluation/{name}": np.asarray(v, np.int64) for name, v in whole.items()}
        arrays["evaluation/best"] = np.asarray(self.best, np.float64)
        return arrays | {f"best/{name}": array for name, array in self.best_policy.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Evaluated:
        """The inverse of `to_arrays`.

        Raises:
          BadCheckpoint: a number is missing, or of another shape or type.
        """
        if not (best_policy := under("best/", arrays)):
            return cls()
        number = partial(_number, arrays)
        return cls(
            number("env_steps", np.int64),
            number("best", np.float64),
            number("best_env_steps", np.int64),
            number("since_best", np.int64),
            best_policy,
        )


def _number(arrays: Mapping[str, np.ndarray], name: str, dtype: Any) -> Any:
    return fitting(arrays, f"evaluation/{name}", np.zeros((), dtype)).item()


class Evaluator:
    """Evaluates the members of a job when that is due, and stops those that are done.

    Args:
      policy: of the members, to name the parameters of the best.
      play: plays episodes of a member, by their numbers.
    """

    def __init__(self, job: Job, policy: Policy, play: Play) -> None:
        self._config, self._members, self._policy, self._play = (
            job.config,
            job.members,
            policy,
            play,
        )
        self.seconds = 0.0  # that evaluations took so far
        restored = job.restored or {}
        self._found = [Evaluated.from_arrays(under(f"{m.name}/", restored)) for m in job.members]

    def after(
        self, p: int, counters: Counters, steps_before: int, frozen: Callable[[], Frozen]
    ) -> dict[str, Any]:
        """Evaluates member `p` if its iteration reached a multiple of `eval_every`.

        Args:
          counters: of the member, after the iteration; `stopped` is set if it has to stop early.
          steps_before: its env steps before the iteration.

        Returns:
          what its row says besides; nothing if it was not evaluated.

        Raises:
          EnvironmentFailure: the environment raised, or a return is not finite.
        """
        every = self._config.eval_every
        if not every or counters.env_steps // every == steps_before // every:
            return {}
        clock, member, now = time.perf_counter(), self._members[p], frozen()
        first = counters.env_steps // every * self._config.eval_episodes
        numbers = range(first, first + self._config.eval_episodes)
        episodes = self._episodes(member, now, numbers)
        found = self._found[p]
        row = found.see(episodes, counters.env_steps, partial(named_frozen, self._policy, now))
        stop = found.stop(self._config, row["eval_return_mean"])
        if budget_left(member.config, counters):  # else it has ended anyway
            counters.stopped = stop
        self.seconds += time.perf_counter() - clock
        return row

    def _episodes(self, member: Member, frozen: Frozen, numbers: Sequence[int]) -> list[Episode]:
        where = f"evaluation of {member.name}"
        try:
            episodes = self._play(frozen, member, numbers)
        except EnvironmentFailure as error:
            raise EnvironmentFailure(f"{where}: {error}") from error.__cause__
        except Exception as error:
            raise EnvironmentFailure(
                f"{where}: the environment raised {one_line(error)}"
            ) from error
        for number, episode in enumerate(episodes):
            if not math.isfinite(episode.return_):
                raise EnvironmentFailure(
                    f"{where}: the return of episode {number} is {episode.return_}"
                )
        return episodes

    def iterations_until_due(self, counters: Sequence[Counters]) -> int:
        """Counts iterations that end before, or where, the first running member is evaluated."""
        every, most = self._config.eval_every, capacity(self._config) * self._config.envs
        left = [every - own.env_steps % every for own in counters if every and not own.stopped]
        return max(1, -(-min(left) // most)) if left else 2**30

    def to_arrays(self) -> Arrays:
        """Names all that a resumed run needs, by member."""
        return {
            f"{member.name}/{name}": array
            for member, found in zip(self._members, self._found, strict=True)
            for name, array in found.to_arrays().items()
        }


def named_frozen(policy: Policy, frozen: Frozen) -> Arrays:
    """Parameters and normaliser as arrays, named as in a checkpoint."""
    moments = frozen.moments._asdict() if frozen.moments is not None else {}
    return {
        **{
            f"params/{name}": np.array(a) for name, a in named_params(policy, frozen.params).items()
        },
        **{f"observation_moments/{name}": np.array(a) for name, a in moments.items()},
    }


def stop_named(members: Sequence[Member], counters: Sequence[Counters], names: set[str]) -> None:
    """Stops the members that a callback has asked to stop."""
    for member, own in zip(members, counters, strict=True):
        if member.name in names and not own.stopped:
            own.stopped = STOPS.index("callback")
