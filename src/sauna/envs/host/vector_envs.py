"""Vector environments, each of which steps all environments of a member by itself.

A `gymnasium.vector.VectorEnv` begins the next episode of a row in one of three ways
(`metadata["autoreset_mode"]`):

    SAME_STEP  in the step that ends one; `info["final_obs"]` holds what the ended one had reached
    NEXT_STEP  in the step after it, whose action and reward are void: the row is idle there
    DISABLED   when it is asked to, by `reset(options={"reset_mask": ...})`

A row cannot be brought back alone: a resumed run starts new episodes everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from sauna.envs.host.answers import first_of, five_of
from sauna.envs.host.contract import episode_seed
from sauna.envs.host.grouped_envs import Group, GroupedEnvs
from sauna.envs.info import numbers_of
from sauna.system.errors import BadInput

MODES = ("NEXT_STEP", "SAME_STEP", "DISABLED")


def autoreset_mode(env: Any) -> str:
    """Names the autoreset mode of a vector environment.

    Raises:
      BadInput: it says none.
    """
    mode = getattr(env, "metadata", {}).get("autoreset_mode")
    name = getattr(mode, "name", mode)
    if name not in MODES:
        raise BadInput(
            "env: the vector environment does not say how it begins episodes; set "
            'metadata["autoreset_mode"] to a gymnasium.vector.AutoresetMode'
        )
    return str(name)


class VectorEnvs(GroupedEnvs):
    """The environments of several members, each member's stepped by one vector environment.

    Args:
      make: makes a vector environment of so many rows.
      seeds: `(member seed, env index)` of each row; a member's rows stand together.
      rescale: as of `action_writer`.

    Raises:
      BadInput: it has another number of rows, or does not say how it begins episodes.
    """

    kind = "vector environment"

    def __init__(
        self, make: Callable[[int], Any], seeds: Sequence[tuple[int, int]], rescale: bool = False
    ) -> None:
        groups: list[Group] = []
        start = 0
        for _, rows in groupby(seeds, key=lambda pair: pair[0]):
            stop = start + len(list(rows))
            groups.append(Group(made_of(make, stop - start), seeds[start], slice(start, stop)))
            start = stop
        env = groups[0].env
        self._mode = autoreset_mode(env)
        super().__init__(groups, env.single_observation_space, env.single_action_space, rescale)

    def _begin(self, group: Group) -> None:
        group.episode += 1
        seed = episode_seed(*group.seeds, group.episode)
        self._put_batch(self._observation, group, first_of(group.env.reset(seed=seed)))
        self._waiting[group.rows] = False

    def _put_batch(
        self, rows: np.ndarray, group: Group, batch: Any, only: np.ndarray | None = None
    ) -> None:
        """Writes a batch of observations to a group's rows, or to those of `only` `[N]`."""
        from gymnasium.vector.utils import iterate

        if only is None and self._put_all(rows, group, batch):
            return
        for n, observation in enumerate(iterate(group.env.observation_space, batch)):
            if only is None or only[n]:
                self._put(rows, group.rows.start + n, observation)

    def _step_group(self, group: Group, action: np.ndarray) -> None:
        batch = batch_of(group.env.single_action_space, [self._write(one) for one in action])
        observation, reward, terminated, truncated, info = five_of(group.env.step(batch))
        rows, idle = group.rows, self._waiting[group.rows]
        terminated, truncated = (np.asarray(end, bool) for end in (terminated, truncated))
        self._reward[rows] = np.where(idle, 0.0, np.asarray(reward, np.float64))
        self._terminated[rows] = terminated & ~idle
        self._truncated[rows] = truncated & ~terminated & ~idle
        ended = self._terminated[rows] | self._truncated[rows]
        self._put_batch(self._observation, group, observation)
        if ended.any():
            self._end(group, ended, observation, info)
        self._waiting[rows] = ended & (self._mode == "NEXT_STEP")

    def _end(self, group: Group, ended: np.ndarray, observation: Any, info: Any) -> None:
        """Writes what ended episodes had reached, and begins the next ones if that is due."""
        if self._mode == "SAME_STEP":
            for n in np.flatnonzero(ended).tolist():
                self._put(self._final, group.rows.start + n, final_of(info, n))
            info = info.get("final_info", info)
        else:
            self._put_batch(self._final, group, observation, ended)
        for n in np.flatnonzero(ended).tolist():
            if numbers := numbers_of(row_of(info, n)):
                self._info[group.rows.start + n] = numbers
        if self._mode == "DISABLED":
            answer = group.env.reset(options={"reset_mask": ended.copy()})
            self._put_batch(self._observation, group, first_of(answer), ended)


def made_of(make: Callable[[int], Any], number: int) -> Any:
    """Makes a vector environment of `number` rows.

    Raises:
      BadInput: it has another number.
    """
    env = make(number)
    if env.num_envs != number:
        raise BadInput(
            f"env: the vector environment has {env.num_envs} rows instead of {number}; the "
            "function must make as many as num_envs says"
        )
    return env


def batch_of(space: Any, rows: Sequence[Any]) -> Any:
    """Several actions as a vector environment takes them."""
    from gymnasium.vector.utils import concatenate, create_empty_array

    return concatenate(space, rows, create_empty_array(space, len(rows)))


def final_of(info: Any, n: int) -> Any:
    """What the ended episode of row `n` had reached, of an environment that resets at once.

    Raises:
      ValueError: `info` does not say.
    """
    given = info.get("final_obs")
    if given is None or given[n] is None:
        raise ValueError("info holds no final_obs where an episode ended")
    return given[n]


def row_of(info: Any, n: int) -> dict[str, Any]:
    """What the `info` of a vector environment says of one row.

    `_name` says of which rows `name` does.
    """
    found = {}
    for name, values in (info or {}).items():
        is_said = info.get(f"_{name}")
        if isinstance(values, dict) or str(name).startswith("_"):
            continue
        if np.ndim(values) and len(values) > n and (is_said is None or is_said[n]):
            found[name] = values[n]
    return found


class OneRow:
    """A vector environment of one row, as a plain environment: evaluations play in it."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self.metadata, self.spec = env.metadata, getattr(env, "spec", None)
        self.render_mode = getattr(env, "render_mode", None)
        self.mode = autoreset_mode(env)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._first(observation), row_of(info, 0)

    def step(self, action: Any) -> Any:
        batch = batch_of(self.action_space, [action])
        observation, reward, terminated, truncated, info = self.env.step(batch)
        seen, over = self._first(observation), bool(terminated[0] or truncated[0])
        if over and self.mode == "SAME_STEP":
            seen, info = final_of(info, 0), info.get("final_info", info)
        return seen, float(reward[0]), bool(terminated[0]), bool(truncated[0]), row_of(info, 0)

    def _first(self, batch: Any) -> Any:
        from gymnasium.vector.utils import iterate

        return next(iter(iterate(self.env.observation_space, batch)))

    def render(self) -> Any:
        pictures = self.env.render()
        return pictures[0] if isinstance(pictures, tuple | list) else pictures

    def close(self) -> None:
        self.env.close()
