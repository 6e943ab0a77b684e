"""The tasks that need a memory: hand arithmetic, and Gymnasium's Pendulum as the oracle."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sauna.envs.memory_tasks import Swing, hidden_pendulum, recall


@pytest.mark.parametrize("answer", [0, 1])
def test_only_the_last_answer_of_recall_counts(answer: int) -> None:
    env = recall(length=3)
    for seed in range(4):
        state, seen = env.reset(jax.random.key(seed))
        cue = int(state.cue)
        assert seen.tolist() == [2 * cue - 1, 0]
        shown, rewards = [], []
        for action in (1 - answer, 1 - answer, answer):
            transition = env.step(state, jnp.int32(action))
            state = transition.state
            shown.append(transition.observation.tolist())
            rewards.append(float(transition.reward))
        assert shown[:2] == [[0, 0], [0, 1]]
        assert rewards == [0, 0, 1 if answer == cue else -1] and bool(transition.terminated)
    cues = {int(env.reset(jax.random.key(seed))[0].cue) for seed in range(8)}
    assert cues == {0, 1}


def test_the_pendulum_swings_as_gymnasiums() -> None:
    theirs = gymnasium.make("Pendulum-v1")
    seen, _ = theirs.reset(seed=0)
    angle, velocity = theirs.unwrapped.state
    ours, shown = hidden_pendulum(), hidden_pendulum(shows_velocity=True)
    state = Swing(jnp.float32(angle), jnp.float32(velocity), jnp.int32(0))
    step = jax.jit(shown.step)
    for i in range(200):
        torque = np.array([3.0 * np.sin(i)], np.float32)  # also beyond the bounds
        seen, reward, _, truncated, _ = theirs.step(np.clip(torque, -2, 2))
        before, transition = state, step(state, torque)
        state = transition.state
        np.testing.assert_allclose(transition.observation, seen, atol=2e-3)
        assert float(transition.reward) == pytest.approx(float(reward), abs=2e-2)
        assert bool(transition.truncated) == truncated == (i == 199)
    hidden = ours.step(before, torque).observation
    np.testing.assert_allclose(hidden, transition.observation[:2], atol=1e-5)
    _, first = ours.reset(jax.random.key(0))
    assert first.shape == ours.observation_space.shape == (2,)
