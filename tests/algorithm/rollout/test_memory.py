"""States on the host, row by row: who moves on, who is forgotten, what learning begins with."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from helpers import configured
from sauna.algorithm.rollout.memory import HostMemory

YES = np.ones((1, 2), bool)


def made(size: int = 1) -> HostMemory:
    config = configured(recurrent="gru", envs=2, rollout_steps=6, minibatches=2, sequence_length=3)
    policy: Any = SimpleNamespace(state_size=size)
    return HostMemory(config, policy, 1, 6)


def row(memory: HostMemory, value: float, acting: Any = YES, over: Any = None) -> None:
    memory.acting = np.asarray(acting)
    memory.advance(np.full((1, 2, 1), value, np.float32))
    if over is not None:
        memory.forget(np.asarray(over))


def test_states_move_on_and_are_forgotten_at_an_end() -> None:
    memory = made()
    memory.begin()
    row(memory, 1)
    row(memory, 2, over=[[True, False]])
    row(memory, 3)
    memory.begin_segment(0)
    row(memory, 4, acting=[[True, False]])  # the second is full
    assert memory.state[0, :, 0].tolist() == [4, 3]
    assert memory.rollout.state[0, :, :, 0].tolist() == [[0, 0], [3, 3]]  # before rows 0 and 3
    assert memory.rollout.start[0, :4].tolist() == [
        [False] * 2,
        [False] * 2,
        [True, False],
        [False] * 2,
    ]
    start, state = memory.of_segment(0, slice(3, 5))
    assert state[:, 0].tolist() == [3, 3] and start.shape == (2, 2)
    row(memory, 5, over=[[False, True]])
    row(memory, 6, over=[[True, False]])  # with the last row: there is none behind it
    memory.begin()
    assert not memory.rollout.start.any() and memory.now(0)[0][:, 0].tolist() == [0, 6]


def test_an_environment_that_waited_starts_an_episode() -> None:
    """Its state is still zero, and learning is said so behind every row of waiting."""
    memory = made()
    memory.begin()
    row(memory, 1, over=[[True, False]])
    row(memory, 2, acting=[[False, True]])
    row(memory, 3, acting=[[False, True]])
    assert memory.state[0, :, 0].tolist() == [0, 3]
    row(memory, 4)
    assert memory.rollout.start[0, :5, 0].tolist() == [False, True, True, True, False]
    assert memory.rollout.state[0, 1, :, 0].tolist() == [0, 3]


def test_nothing_is_kept_of_a_policy_without_a_memory() -> None:
    memory = made(size=0)
    memory.begin()
    memory.forget(YES)
    memory.begin_segment(0)
    assert memory.rollout is None and memory.now(0) == memory.of_segment(0, slice(0, 2)) == []
