"""What a training does, and does not, before its first env step."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

from command_line import sauna_here, small_flags
from helpers import environment
from sauna.system import spawn
from sauna.training.loop.device_program import MAX_PER_CALL, Report, several

ENV = """
import gc
import gymnasium
import numpy as np

class Says(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        info = {"collects": float(gc.isenabled())}
        return np.zeros(1, np.float32), 1.0, self.t == 8, False, info
"""


def imported(code: str, *names: str) -> list[str]:
    """Which of these a new process has imported after `code`."""
    code += f"\nimport sys; print(*[name for name in {names!r} if name in sys.modules])"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment())
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_a_training_on_the_device_imports_nothing_that_draws_and_no_numba() -> None:
    code = "import sauna.training.loop.device, sauna.envs.device.gymnax_envs"
    found = imported(code, "jax", "gymnax", "matplotlib", "seaborn", "pandas", "numba")
    assert found == ["jax", "gymnax"]


def test_gymnax_can_still_draw() -> None:
    code = (
        "import sauna.envs.device.gymnax_envs, matplotlib.pyplot\n"
        "from gymnax.environments.misc import pong\n"
        "assert pong.plt.subplots is matplotlib.pyplot.subplots\n"
        "assert pong.colors.ListedColormap is matplotlib.colors.ListedColormap\n"
    )
    assert imported(code, "matplotlib", "seaborn") == ["matplotlib"]


def test_what_is_imported_ahead_of_a_job_leaves_its_devices_open() -> None:
    code = (
        "from sauna.training import worker\nworker._import_ahead()\n"
        "worker.configure_jax(2)\nimport jax\nassert len(jax.devices()) == 2"
    )
    assert imported(code, "jax", "flax", "numba", "sauna.training.loop.metrics") == [
        "jax",
        "flax",
        "sauna.training.loop.metrics",
    ]


def test_a_program_that_compiles_in_no_time_is_read_from_the_cache_as_well(tmp_path: Path) -> None:
    code = (
        "from sauna.system.jax_setup import configure_jax\nconfigure_jax()\n"
        "import jax\nseen = []\n"
        "jax.monitoring.register_event_listener(lambda event, **more: seen.append(event))\n"
        "for n in range(5): jax.jit(lambda x: x + n)(1.0)\n"
        "print(sum(event.endswith('cache_hits') for event in seen))"
    )
    own = {name: value for name, value in environment().items() if not name.startswith("JAX_")}
    own["XDG_CACHE_HOME"] = str(tmp_path)
    hits = [
        int(subprocess.check_output([sys.executable, "-c", code], text=True, env=own))
        for _ in range(2)
    ]
    assert hits[0] == 0 and hits[1] >= 5


@pytest.mark.processes
def test_the_process_that_is_started_with_the_command_trains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It imports without collecting garbage, and collects it while it trains."""
    (tmp_path / "says.py").write_text(ENV)
    started: list[str] = []
    start = spawn._start
    monkeypatch.setattr(spawn, "_start", lambda own: started.append(own.module) or start(own))
    flags = small_flags(arm="ppo", processes=1)
    done = sauna_here("train", "says:Says", "--out", "run", *flags, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert started == ["sauna.training.worker"]
    row = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[0])
    assert row["info_collects"] == 1.0


class Finite(NamedTuple):
    finite: Any


class Found(NamedTuple):
    found: Any


def test_an_iteration_is_traced_once() -> None:
    traced = []

    def iterate(state: Any, setting: Any, iteration: Any) -> tuple[Any, Report]:
        traced.append(iteration)
        yes = jnp.bool_(True)
        report = Report(yes, state, state, (), Found(~yes), Finite(yes), setting)  # type: ignore[arg-type]
        return state + iteration, report

    run = jax.jit(lambda *given: several(iterate, *given))
    state, reports = run(jnp.int32(0), jnp.float32(0.0), jnp.int32(5), jnp.int32(3))
    assert int(state) == 5 + 6 + 7
    assert reports.ran.tolist() == [True] * 3 + [False] * (MAX_PER_CALL - 3)
    assert len(traced) == 1
