"""Environments whose rows are stepped together, with known answers."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from small_envs import SmallEnv

SAME, NEXT, DISABLED = (
    AutoresetMode.SAME_STEP,
    AutoresetMode.NEXT_STEP,
    AutoresetMode.DISABLED,
)


class Counting(SmallEnv):
    """Shows the step. Action 1 in step 3 ends an episode; step 5 is a time limit."""

    def observe(self) -> np.ndarray:
        return np.array([float(self.t)])

    def reward(self, action: Any) -> float:
        self.action = int(action)
        return 10.0 * self.t + self.action

    def terminated(self) -> bool:
        return self.t == 3 and self.action == 1

    def truncated(self) -> bool:
        return self.t >= 5

    def step(self, action: Any) -> Any:
        answer = super().step(action)
        return *answer[:4], {"is_success": float(self.t == 3), "name": "text"}


def same(num_envs: int, **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([Counting] * num_envs, autoreset_mode=SAME)


def later(num_envs: int, **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([Counting] * num_envs, autoreset_mode=NEXT)


def never(num_envs: int, **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([Counting] * num_envs, autoreset_mode=DISABLED)


def two_always(num_envs: int) -> SyncVectorEnv:
    return same(2)


def numbered(num_envs: int) -> Counting:
    return Counting()


def nameless(num_envs: int) -> SyncVectorEnv:
    env = same(num_envs)
    env.metadata = {}
    return env


class Agents:
    """A parallel environment of agents that leave after 2, 3 and 4 steps: the last by a time limit.

    What an agent sees is its number, the step and its last action.
    """

    metadata: dict[str, Any] = {}  # noqa: RUF012
    possible_agents = ("a", "b", "c")
    render_mode = None

    def __init__(self, together: bool = False, wide: bool = False) -> None:
        self.together, self.wide = together, wide

    def observation_space(self, agent: str) -> spaces.Space:
        size = 4 if self.wide and agent == "b" else 3
        return spaces.Box(-100, 100, (size,), np.float64)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.t = list(self.possible_agents), 0
        return self.seen({}), {}

    def seen(self, actions: dict) -> dict:
        return {
            agent: np.array(
                [self.possible_agents.index(agent), self.t, actions.get(agent, -1)], float
            )
            for agent in self.agents
        }

    def step(self, actions: dict) -> Any:
        assert set(actions) == set(self.agents) and self.agents
        self.t += 1
        seen = self.seen(actions)
        limits = {agent: 4 if self.together else 2 + n for n, agent in enumerate("abc")}
        over = {agent: self.t >= limits[agent] for agent in self.agents}
        terminated = {agent: over[agent] and agent != "c" for agent in self.agents}
        truncated = {agent: over[agent] and agent == "c" for agent in self.agents}
        reward = {agent: float(actions[agent]) for agent in self.agents}
        info = {agent: {"is_success": 1.0} for agent in self.agents}
        self.agents = [agent for agent in self.agents if not over[agent]]
        return seen, reward, terminated, truncated, info

    def close(self) -> None:
        pass
