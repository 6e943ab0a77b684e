"""Two small tasks that need a memory, as pure functions for the device.

sauna train sauna.envs.memory_tasks:recall --recurrent lstm
sauna train sauna.envs.memory_tasks:hidden_pendulum --recurrent gru
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from sauna.envs.device.contract import JaxEnv, Transition


class Cue(NamedTuple):
    """The state of `recall`."""

    cue: jax.Array  # [] int32, 0 or 1
    steps: jax.Array  # [] int32


def recall(length: int = 10) -> JaxEnv:
    """A cue is shown in the first step, and the action of the last step has to be that cue.

    The observation is two numbers: the cue as -1 or 1 in the first step and 0 after it, and 1 in
    the last step, else 0. The last step's reward is 1 if the action is the cue, and -1 if not; all
    others are 0. A policy without a memory has a mean return of 0, the best one of 1.

    Args:
      length: env steps of an episode, at least 2.
    """

    def observe(state: Cue) -> jax.Array:
        shown = jnp.where(state.steps == 0, 2.0 * state.cue - 1.0, 0.0)
        return jnp.stack([shown, (state.steps == length - 1).astype(jnp.float32)])

    def reset(key: jax.Array) -> tuple[Cue, jax.Array]:
        state = Cue(jax.random.bernoulli(key).astype(jnp.int32), jnp.int32(0))
        return state, observe(state)

    def step(state: Cue, action: jax.Array) -> Transition:
        is_last = state.steps == length - 1
        reward = jnp.where(action == state.cue, 1.0, -1.0) * is_last
        after = state._replace(steps=state.steps + 1)
        return Transition(after, observe(after), reward, is_last, jnp.bool_(False))

    space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    return JaxEnv(reset, step, space, gymnasium.spaces.Discrete(2))


class Swing(NamedTuple):
    """The state of `hidden_pendulum`."""

    angle: jax.Array  # [] float32, radians; 0 is upright
    velocity: jax.Array  # [] float32, radians per second
    steps: jax.Array  # [] int32


GRAVITY, TIME_STEP, MAX_SPEED, MAX_TORQUE, LIMIT = 10.0, 0.05, 8.0, 2.0, 200


def hidden_pendulum(shows_velocity: bool = False) -> JaxEnv:
    """Gymnasium's Pendulum-v1, of which only the angle is observed: its cosine and its sine.

    The equations, the reward and the time limit of 200 env steps are Gymnasium's
    (`classic_control/pendulum.py`); mass and length are 1.

    Args:
      shows_velocity: observe it, too, as Pendulum-v1 does.
    """

    def observe(state: Swing) -> jax.Array:
        seen = [jnp.cos(state.angle), jnp.sin(state.angle)]
        return jnp.stack([*seen, state.velocity] if shows_velocity else seen)

    def reset(key: jax.Array) -> tuple[Swing, jax.Array]:
        high = jnp.array([math.pi, 1.0])
        angle, velocity = jax.random.uniform(key, (2,), minval=-high, maxval=high)
        state = Swing(angle, velocity, jnp.int32(0))
        return state, observe(state)

    def step(state: Swing, action: jax.Array) -> Transition:
        torque = jnp.clip(action[0], -MAX_TORQUE, MAX_TORQUE)
        angle = (state.angle + math.pi) % (2.0 * math.pi) - math.pi
        cost = angle**2 + 0.1 * state.velocity**2 + 0.001 * torque**2
        change = 1.5 * GRAVITY * jnp.sin(state.angle) + 3.0 * torque
        velocity = jnp.clip(state.velocity + change * TIME_STEP, -MAX_SPEED, MAX_SPEED)
        after = Swing(state.angle + velocity * TIME_STEP, velocity, state.steps + 1)
        return Transition(after, observe(after), -cost, jnp.bool_(False), after.steps >= LIMIT)

    high: Any = np.array([1.0, 1.0, MAX_SPEED][: 3 if shows_velocity else 2], np.float32)
    space = gymnasium.spaces.Box(-high, high)
    return JaxEnv(reset, step, space, gymnasium.spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,)))
