"""HumanoidFlagrunHarder on the accelerator: the same model in MJX, the same task.

What compiles is kept small: a reset needs kinematics alone, and the model leaves out the flag.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from mujoco import mjx

from sauna.envs.device.contract import JaxEnv, Transition
from sauna.envs.flagrun import task as rules
from sauna.envs.flagrun.physics import (
    after_throw,
    anatomy,
    first_qpos,
    load_model,
    read_robot,
    spaces,
)
from sauna.envs.flagrun.picture import Painter


class FlagrunState(NamedTuple):
    """All that the next step depends on; `mjx.Data` is made anew of it in each step."""

    qpos: Array  # [31] float32
    qvel: Array  # [29] float32
    warmstart: Array  # [29] float32, where the solver begins
    task: rules.Task
    key: Array  # [] PRNG key


def flagrun_mjx() -> JaxEnv:
    """HumanoidFlagrunHarder as pure functions; float32, matrix products not rounded further."""
    model = load_model()
    body = jax.tree.map(_as_float32, anatomy(model))
    device_model = mjx.put_model(load_model(flag=False), impl="jax")
    blank = mjx.make_data(device_model, impl="jax")

    def robot_of(data: Any) -> rules.Robot:
        placed = mjx.kinematics(device_model, data)
        return read_robot(jnp, body, data.qpos, data.qvel, placed)

    def reset(key: Array) -> tuple[FlagrunState, Array]:
        with jax.default_matmul_precision("highest"):
            key, draw = jax.random.split(key)
            start = rules.start(jnp, jax.random.uniform(draw, (rules.RESET_DRAWS,)))
            data = blank.replace(qpos=first_qpos(jnp, start))
            task, observation = rules.begin(jnp, robot_of(data), start.flag)
        return FlagrunState(data.qpos, data.qvel, data.qacc_warmstart, task, key), observation

    def step(state: FlagrunState, action: Array) -> Transition:
        with jax.default_matmul_precision("highest"):
            key, draw = jax.random.split(state.key)
            action = jnp.clip(action, -1.0, 1.0)
            data = blank.replace(
                qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=action
            )
            substep = lambda _, data: mjx.step(device_model, data)  # noqa: E731
            data = jax.lax.fori_loop(0, rules.SUBSTEPS, substep, data)
            draws = jax.random.uniform(draw, (rules.STEP_DRAWS,))
            outcome = rules.advance(jnp, state.task, robot_of(data), action, draws)
            qpos, qvel = after_throw(jnp, outcome.throw, data.qpos, data.qvel)
        next_state = FlagrunState(qpos, qvel, data.qacc_warmstart, outcome.task, key)
        reward = sum(outcome.reward, start=jnp.zeros(()))
        return Transition(
            next_state,
            outcome.observation,
            reward,
            outcome.terminated,
            outcome.truncated,
            outcome.reward._asdict(),
        )

    painters: list[Painter] = []  # made when first used

    def render(state: FlagrunState) -> np.ndarray:
        if not painters:
            painters.append(Painter(model))
        return painters[0].draw(np.asarray(state.qpos), np.asarray(state.task.flag))

    return JaxEnv(reset, step, *spaces(), render, 1 / rules.CONTROL_DT)


def _as_float32(value: Any) -> Any:
    return value.astype(np.float32) if getattr(value, "dtype", None) == np.float64 else value
