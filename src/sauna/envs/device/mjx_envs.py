"""MuJoCo models on the accelerator, stepped by MJX: `mjx/HalfCheetah-v5`, or a model of your own.

A task is a model and a few functions of `mjx.Data`; `on_mjx` makes an environment of it. The tasks
here repeat Gymnasium's of the same name, with its models, rewards and ends; MJX computes in single
precision and solves contacts in its own way, so trajectories part after a while.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from sauna.envs.device.contract import JaxEnv, Transition, ended_where_broken


class MjxTask(NamedTuple):
    """A MuJoCo model and what makes a task of it.

    Attributes:
      model: its actuators' control ranges are the action space.
      frame_skip: physics steps per env step.
      start: `key -> (qpos, qvel)` of a new episode.
      observe: `data -> [D]`, from what the env step has reached.
      reward: `(data before the step, data after it, action) -> []`.
      terminated: `data -> [] bool`.
      time_limit: env steps.
    """

    model: mujoco.MjModel
    frame_skip: int
    start: Callable[[jax.Array], tuple[jax.Array, jax.Array]]
    observe: Callable[[Any], jax.Array]
    reward: Callable[[Any, Any, jax.Array], jax.Array]
    terminated: Callable[[Any], jax.Array]
    time_limit: int = 1000


class State(NamedTuple):
    """What MJX computes everything else from at the beginning of a step."""

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    time: jax.Array
    steps: jax.Array  # [] int32


def on_mjx(task: MjxTask, impl: str = "jax") -> JaxEnv:
    """The environment of a task.

    Only a handful of numbers are carried from step to step, not MJX's whole data: less memory to
    move, small checkpoints.

    Args:
      impl: MJX's implementation; `warp` needs the package warp-lang and an NVIDIA GPU.
    """
    model = mjx.put_model(task.model, impl=impl)
    empty = mjx.make_data(task.model, impl=impl)

    def data_of(state: State) -> Any:
        fields = state._asdict()
        del fields["steps"]
        return empty.replace(**fields)

    def state_of(data: Any, steps: jax.Array) -> State:
        return State(data.qpos, data.qvel, data.act, data.qacc_warmstart, data.time, steps)

    def reset(key: jax.Array) -> tuple[State, jax.Array]:
        with jax.default_matmul_precision("highest"):
            qpos, qvel = task.start(key)
            data = mjx.forward(model, empty.replace(qpos=qpos, qvel=qvel))
            return state_of(data, jnp.int32(0)), task.observe(data)

    def step(state: State, action: jax.Array) -> Transition:
        with jax.default_matmul_precision("highest"):
            before = data_of(state).replace(ctrl=action)
            after = jax.lax.fori_loop(
                0, task.frame_skip, lambda _, data: mjx.step(model, data), before
            )
            steps = state.steps + 1
            transition = Transition(
                state_of(after, steps),
                task.observe(after),
                task.reward(before, after, action),
                task.terminated(after),
                steps >= task.time_limit,
            )
            return ended_where_broken(transition)

    low, high = task.model.actuator_ctrlrange.T.astype(np.float32)
    size = jax.eval_shape(lambda key: reset(key)[1], jax.random.key(0)).shape
    observations = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float32)
    rate = 1.0 / (task.model.opt.timestep * task.frame_skip)
    render = functools.partial(_render, task.model)
    actions = gymnasium.spaces.Box(low, high, dtype=np.float32)
    return JaxEnv(reset, step, observations, actions, render, rate)


def _render(model: mujoco.MjModel, state: State) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.asarray(state.qpos), np.asarray(state.qvel)
    mujoco.mj_forward(model, data)
    camera = "track" if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "track") >= 0 else -1
    with mujoco.Renderer(model) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


def _gymnasium_model(file: str) -> mujoco.MjModel:
    folder = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    return mujoco.MjModel.from_xml_path(str(folder / file))


def _uniform(model: mujoco.MjModel, scale: float) -> Callable[[jax.Array], Any]:
    """The model's own position and speed, each plus uniform noise of +-`scale`."""

    def start(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        one, other = jax.random.split(key)
        qpos = jax.random.uniform(one, (model.nq,), minval=-scale, maxval=scale)
        qvel = jax.random.uniform(other, (model.nv,), minval=-scale, maxval=scale)
        return jnp.asarray(model.qpos0, jnp.float32) + qpos, qvel

    return start


def _speed(seconds: float) -> Callable[[Any, Any], jax.Array]:
    return lambda before, after: (after.qpos[0] - before.qpos[0]) / seconds


def inverted_pendulum() -> MjxTask:
    model = _gymnasium_model("inverted_pendulum.xml")

    def fell(data: Any) -> jax.Array:
        return jnp.abs(data.qpos[1]) > 0.2

    return MjxTask(
        model,
        2,
        _uniform(model, 0.01),
        lambda data: jnp.concatenate([data.qpos, data.qvel]),
        lambda before, after, action: 1.0 - fell(after),
        fell,
    )


def half_cheetah() -> MjxTask:
    model = _gymnasium_model("half_cheetah.xml")
    speed = _speed(5 * model.opt.timestep)

    def start(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        one, other = jax.random.split(key)
        qpos, _ = _uniform(model, 0.1)(one)
        return qpos, 0.1 * jax.random.normal(other, (model.nv,))

    return MjxTask(
        model,
        5,
        start,
        lambda data: jnp.concatenate([data.qpos[1:], data.qvel]),
        lambda before, after, action: speed(before, after) - 0.1 * jnp.sum(action**2),
        lambda data: jnp.bool_(False),
    )


def hopper() -> MjxTask:
    model = _gymnasium_model("hopper.xml")
    speed = _speed(4 * model.opt.timestep)

    def healthy(data: Any) -> jax.Array:
        rest = jnp.concatenate([data.qpos[2:], data.qvel])
        upright = (data.qpos[1] > 0.7) & (jnp.abs(data.qpos[2]) < 0.2)
        return upright & jnp.all(jnp.abs(rest) < 100.0)

    def reward(before: Any, after: Any, action: jax.Array) -> jax.Array:
        return speed(before, after) + healthy(after) - 1e-3 * jnp.sum(action**2)

    return MjxTask(
        model,
        4,
        _uniform(model, 5e-3),
        lambda data: jnp.concatenate([data.qpos[1:], jnp.clip(data.qvel, -10.0, 10.0)]),
        reward,
        lambda data: ~healthy(data),
    )


TASKS = {
    "InvertedPendulum-v5": inverted_pendulum,
    "HalfCheetah-v5": half_cheetah,
    "Hopper-v5": hopper,
}


def names() -> list[str]:
    return list(TASKS)


def make(name: str, impl: str = "jax", time_limit: int = 1000) -> JaxEnv:
    return on_mjx(TASKS[name]()._replace(time_limit=time_limit), impl)
