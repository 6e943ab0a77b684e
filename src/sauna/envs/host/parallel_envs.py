"""PettingZoo's parallel environments: each agent is a row, and all share the member's parameters.

An agent that leaves before the others is idle until the episode has ended for all of them. The
next episode begins for all at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sauna.envs.host.answers import first_of, five_of, one_number
from sauna.envs.host.contract import episode_seed
from sauna.envs.host.grouped_envs import Group, GroupedEnvs
from sauna.envs.host.vector_envs import batch_of
from sauna.envs.info import numbers_of
from sauna.system.errors import BadInput


def shared_spaces(env: Any) -> tuple[Any, Any]:
    """The observation and the action space that all agents have.

    Raises:
      BadInput: an agent has others; one set of parameters cannot serve both.
    """
    agents = list(env.possible_agents)
    first = env.observation_space(agents[0]), env.action_space(agents[0])
    for agent in agents[1:]:
        for name, space in zip(("observation", "action"), first, strict=True):
            if getattr(env, f"{name}_space")(agent) != space:
                raise BadInput(
                    f"env: agent {agent} has another {name} space than {agents[0]}, so that they "
                    "cannot share a policy; SuperSuit's pad_observations_v0 and "
                    "pad_action_space_v0 make them equal"
                )
    return first


class ParallelEnvs(GroupedEnvs):
    """M rows, one for each agent of M / A parallel environments of A agents.

    Args:
      make: makes one parallel environment.
      seeds: `(member seed, env index)` of each row.
      rescale: as of `action_writer`.

    Raises:
      BadInput: agents have different spaces.
    """

    kind = "parallel environment"

    def __init__(
        self, make: Callable[[], Any], seeds: Sequence[tuple[int, int]], rescale: bool = False
    ) -> None:
        first = make()
        spaces, self._agents = shared_spaces(first), list(first.possible_agents)
        size = len(self._agents)
        groups = [
            Group(make() if start else first, seeds[start], slice(start, start + size))
            for start in range(0, len(seeds), size)
        ]
        super().__init__(groups, *spaces, rescale)

    def _begin(self, group: Group) -> None:
        group.episode += 1
        group.actions = []
        seed = episode_seed(*group.seeds, group.episode)
        for agent, observation in first_of(group.env.reset(seed=seed)).items():
            self._put(self._observation, self._row(group, agent), observation)
        self._note_who_is_there(group)

    def _row(self, group: Group, agent: Any) -> int:
        return int(group.rows.start) + self._agents.index(agent)

    def _note_who_is_there(self, group: Group) -> None:
        there = set(group.env.agents)
        self._waiting[group.rows] = [agent not in there for agent in self._agents]

    def _step_group(self, group: Group, action: np.ndarray) -> None:
        group.actions.append(action.copy())
        waiting = self._waiting[group.rows]
        taken = {
            agent: self._write(action[n]) for n, agent in enumerate(self._agents) if not waiting[n]
        }
        seen, reward, terminated, truncated, info = five_of(group.env.step(taken))
        there = set(group.env.agents)
        for agent in taken:
            row = self._row(group, agent)
            self._reward[row] = one_number(reward[agent])
            self._terminated[row] = terminated[agent]
            self._truncated[row] = truncated[agent] and not terminated[agent]
            self._put(self._observation, row, seen[agent])
            if self._terminated[row] or self._truncated[row]:
                self._final[row] = self._observation[row]
                if numbers := numbers_of(info.get(agent)):
                    self._info[row] = numbers
            elif agent not in there:
                raise ValueError(f"{agent} left, neither terminated nor truncated")
        for agent in there - set(taken):  # that comes later than the others
            self._put(self._observation, self._row(group, agent), seen[agent])
        if there:
            self._note_who_is_there(group)
        else:
            self._begin(group)


class AgentsAsOne:
    """A parallel environment as a plain one, whose observation is a batch, a row for each agent.

    The reward is the mean over all agents, those that have left included: an episode's return is
    the mean of theirs. It ends when the last agent does. Evaluations play in it.
    """

    def __init__(self, env: Any) -> None:
        self.env, self.agents = env, list(env.possible_agents)
        self.metadata, self.render_mode = env.metadata, getattr(env, "render_mode", None)
        self.observation_space, self.action_space = shared_spaces(env)
        self._there: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        seen, _ = self.env.reset(seed=seed, options=options)
        return self._batch(seen), {}

    def step(self, action: Any) -> Any:
        taken = dict(zip(self._there, action, strict=True))
        seen, rewards, terminated, _, info = self.env.step(taken)
        reward = sum(one_number(rewards[agent]) for agent in taken) / len(self.agents)
        if self.env.agents:
            return self._batch(seen), reward, False, False, {}
        last = [agent for agent in taken if agent in terminated]
        is_end = any(bool(terminated[agent]) for agent in last)
        numbers = [numbers_of(info.get(agent)) for agent in last]
        names = set.intersection(*map(set, numbers)) if numbers else set()
        means = {name: float(np.mean([one[name] for one in numbers])) for name in sorted(names)}
        self._there = last
        return self._stacked(seen), reward, is_end, not is_end, means

    def _batch(self, seen: Any) -> np.ndarray:
        self._there = [agent for agent in self.agents if agent in set(self.env.agents)]
        return self._stacked(seen)

    def _stacked(self, seen: Any) -> Any:
        return batch_of(self.observation_space, [seen[agent] for agent in self._there])

    def sample(self) -> list[Any]:
        """Draws an action for each agent that is there."""
        return [self.action_space.sample() for _ in self._there]

    def rows(self, batch: Any) -> list[Any]:
        """The observation of each agent that is there, of the last answer."""
        from gymnasium.vector.utils import batch_space, iterate

        return list(iterate(batch_space(self.observation_space, len(self._there)), batch))

    def render(self) -> Any:
        return self.env.render()

    def close(self) -> None:
        self.env.close()
