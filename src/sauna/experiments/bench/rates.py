"""Rates in env steps per second: of a whole training, and of the simulator alone.

That is MuJoCo's `mj_step`, or ale-py's own vector environment as it comes.

Both use the same number of processes. They are taken alternately, because a machine's speed drifts
from minute to minute: only ratios of neighbouring measurements mean anything.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.presets import PRESETS, Member
from sauna.config.settings import Config
from sauna.system.errors import SaunaError
from sauna.training import run as runs
from sauna.training.train import train_run

WARM_UP = 2  # iterations that are not counted: imports, compilation, first pages of memory


class Clock:
    """A display that shows nothing and notes when each iteration's rows arrive."""

    def __init__(self) -> None:
        # Of each member: time, iteration, env steps.
        self.seen: dict[str, list[tuple[float, int, int]]] = {}
        self.started = time.perf_counter()

    def say(self, text: str) -> None:
        pass

    def open(
        self, config: Config, members: list[Member], path: Path, rows: list[dict[str, Any]]
    ) -> None:
        self.seen = {member.name: [] for member in members}

    def phase(self, process: int, text: str) -> None:
        pass

    def rows(self, rows: list[dict[str, Any]]) -> None:
        now = time.perf_counter()
        for row in rows:
            self.seen[row["member"]].append((now, row["iteration"], row["env_steps"]))

    def refresh(self) -> None:
        pass

    def summary(self, members: dict[str, dict[str, Any]]) -> None:
        pass

    def close(self) -> None:
        pass

    def rate(self) -> float:
        """Returns env steps per second, each member's from its own warm-up to its own last row, in
        sum.

        A common start would count an iteration of one process that began before it.
        """
        return sum(map(_rate_of_a_member, self.seen.values()))


def _rate_of_a_member(seen: list[tuple[float, int, int]]) -> float:
    warm = [entry for entry in seen if entry[1] >= WARM_UP - 1]
    if len(warm) < 2:
        raise SaunaError("too few iterations to measure a rate")
    (first, _, before), (last, _, after) = warm[0], warm[-1]
    return (after - before) / (last - first)


def training_rate(settings: Mapping[str, Any]) -> float:
    """Returns env steps per second of a whole training in a folder that is removed afterwards."""
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        run = runs.start({**settings, "out": os.path.join(folder, "run")}, clock)
        train_run(run, clock, resume=False)
    return clock.rate()


def simulator(env: str) -> str | None:
    """Returns what steps an environment: `raw mj_step`, `ale-py alone`, or None where it is not
    known."""
    from sauna.envs.host.atari_envs import is_atari
    from sauna.envs.make import steps_mujoco

    if is_atari(env):
        return "ale-py alone"
    return "raw mj_step" if steps_mujoco(env) else None


def physics_rate(env: str, env_kwargs: Mapping[str, Any], processes: int, seconds: float) -> float:
    """Steps per second of the simulator alone, with random actions, in all processes.

    Each process calls `mj_step` (with the task's frame skip) in three environments in turn, through
    episodes that are begun anew where the task ends them; the time of everything else is left out.
    Or it steps a vector of eight Atari games, which ale-py begins anew.
    """
    command = [sys.executable, "-m", __name__, env, json.dumps(dict(env_kwargs)), str(seconds)]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(processes)]
    return sum(float(process.communicate()[0].split()[-1]) for process in started)


def alternate(
    measures: Mapping[str, Callable[[], float]], rounds: int, say: Callable[[str], None]
) -> dict[str, list[float]]:
    """Takes each measure once per round, in turn: `{name: [rate of each round]}`."""
    found: dict[str, list[float]] = {name: [] for name in measures}
    for number in range(rounds):
        for name, measure in measures.items():
            found[name].append(measure())
            say(f"round {number + 1} of {rounds}: {name}: {found[name][-1]:,.0f} env steps/s")
    return found


def ratio(rates: list[float], others: list[float]) -> dict[str, float]:
    """Computes the median, lowest and highest of the rounds' ratios."""
    each = np.array(rates) / np.array(others)
    return {"median": float(np.median(each)), "low": float(each.min()), "high": float(each.max())}


def _step_physics(env: str, env_kwargs: dict[str, Any], seconds: float) -> float:
    """Steps per second that this process's `mj_step` does, timed in blocks between resets."""
    import mujoco

    from sauna.envs.make import make_env

    number, block = 3, 50
    envs = [make_env(env, env_kwargs) for _ in range(number)]
    for seed, made in enumerate(envs):
        made.reset(seed=seed)
    bare = [made.unwrapped for made in envs]
    low, high = bare[0].action_space.low, bare[0].action_space.high
    rng = np.random.default_rng(0)
    mj_step, steps, spent = mujoco.mj_step, 0, 0.0
    while spent < seconds:
        # Played once by Gymnasium, to see where episodes end; then again by `mj_step`, timed.
        actions = rng.uniform(low, high, (block, number, len(low)))
        for i, made in enumerate(envs):
            start = _state(mujoco, bare[i])
            length = 0
            for action in actions[:, i]:
                length += 1
                _, _, terminated, truncated, _ = made.step(action.astype(np.float32))
                if terminated or truncated:
                    break
            after, ended = _state(mujoco, bare[i]), terminated or truncated
            _put(mujoco, bare[i], start)
            model, data, frame_skip = bare[i].model, bare[i].data, bare[i].frame_skip
            ctrl = data.ctrl
            clock = time.perf_counter()
            for action in actions[:length, i]:
                ctrl[:] = action
                mj_step(model, data, frame_skip)
            spent += time.perf_counter() - clock
            steps += length
            _put(mujoco, bare[i], after)
            if ended:
                made.reset()
    return steps / spent


def _step_games(env: str, seconds: float) -> float:
    """Steps per second of ale-py's vector environment of as many games as the preset has."""
    from ale_py.vector_env import AtariVectorEnv

    from sauna.envs.host.atari_envs import game_of

    number, block = PRESETS["atari"]["envs"], 100
    games = AtariVectorEnv(game_of(env), number)
    games.reset(seed=0)
    rng, steps, start = np.random.default_rng(0), 0, time.perf_counter()
    while time.perf_counter() < start + seconds:
        for action in rng.integers(0, games.single_action_space.n, (block, number)):
            games.step(action)
        steps += block * number
    return steps / (time.perf_counter() - start)


def _state(mujoco: Any, env: Any) -> np.ndarray:
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, state, kind)
    return state


def _put(mujoco: Any, env: Any, state: np.ndarray) -> None:
    mujoco.mj_setState(env.model, env.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)


if __name__ == "__main__":
    name, kwargs, length = sys.argv[1], json.loads(sys.argv[2]), float(sys.argv[3])
    games = simulator(name) == "ale-py alone"
    print(_step_games(name, length) if games else _step_physics(name, kwargs, length))
