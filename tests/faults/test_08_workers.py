"""Row 8: a worker that dies, hangs or raises is named in time, and nothing is left running."""

from __future__ import annotations

import json
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from faults.chain import (
    PATIENCE,
    Chain,
    Stage,
    children,
    is_alive,
    on_each_backend,
    orphans,
    send,
    wait_for_rows,
)
from faults.result import Result, Tally, assert_held
from sauna.envs.host.contract import episode_seed
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.envs.workers import ProcessEnvs

SEEDS = [(0, 0), (0, 1), (1, 0)]
DEADLINE = 1.5  # seconds without an answer, in the trials that hang
NOTICED = 1.0  # seconds by which a death has to be noticed
SLACK = 4.0  # seconds more on a machine that is busy with other things
# What an environment does, where it does it, and what has to be said of it.
SILENT = f"did not answer within {DEADLINE:g} s"
INSIDE = {
    "exit": "ended with exit code 7",
    "abort": "ended with exit code -6",
    "kill": "ended with exit code -9",
    "raise": "raised ValueError: the motor is on fire",
    "hang": SILENT,
    "stop": SILENT,
}
OUTSIDE = {
    "SIGKILL": "ended with exit code -9",
    "SIGSEGV": "ended with exit code -11",
    "SIGSTOP": SILENT,
}


def experiment(least: int, seed: int, place: Path) -> Result:
    """Faults of environment workers, and of the training processes of whole runs.

    `worst`: seconds from the fault to the error that names it (a hang: beyond its deadline).
    """
    rng, tally = random.Random(seed), Tally()
    whole = max(1, least // 10)
    for number in range(least - whole):
        if number % 2:
            _from_outside(rng, tally)
        else:
            _from_inside(rng, tally)
    for stage in on_each_backend(place, tally, iterations=200):
        _training_processes(stage, whole, rng, place, tally)
    return tally.result()


def _from_inside(rng: random.Random, tally: Tally) -> None:
    """The environment itself does it, at a reset or at a step."""
    what, where = rng.choice(list(INSIDE)), rng.choice(["reset", "step"])
    kwargs = {"what": what, "where": where, "episode": rng.randrange(2, 5)}
    envs = ProcessEnvs("small_envs:Failing", kwargs, SEEDS, 2, timeout=60.0)
    envs._timeout = DEADLINE
    _until_named(envs, f"{what} at {where}", INSIDE[what], tally, lambda: None)


def _from_outside(rng: random.Random, tally: Tally) -> None:
    """A signal hits one of the workers at some moment."""
    name, victim = rng.choice(list(OUTSIDE)), rng.randrange(2)
    envs = ProcessEnvs("small_envs:Scripted", {}, SEEDS, 2, timeout=60.0)
    envs._timeout = DEADLINE
    pid = envs._workers[victim].process.pid
    pause = rng.uniform(0.0, 0.3)

    def strike() -> None:
        time.sleep(pause)
        strikes.append(time.monotonic())
        os.kill(pid, getattr(signal, name))

    strikes: list[float] = []
    who = f"worker {victim} (process {pid})"
    _until_named(envs, f"{name} to worker {victim}", OUTSIDE[name], tally, strike, strikes, who)


def _until_named(
    envs: ProcessEnvs,
    what: str,
    wanted: str,
    tally: Tally,
    strike: Callable[[], None],
    strikes: list[float] | None = None,
    who: str = "environment worker ",
) -> None:
    pids = [worker.process.pid for worker in envs._workers]
    tally.tried += 1
    tally.count(f"environment worker: {what.split(' ')[0]}")
    threading.Thread(target=strike, daemon=True).start()
    message = "nothing was noticed"
    try:
        envs.reset()
        last = time.monotonic()
        for _ in range(100_000):
            last = time.monotonic()
            envs.step(np.zeros((len(SEEDS), 2), np.float32), np.ones(len(SEEDS), bool))
    except EnvironmentFailure as error:
        message = str(error)
    seconds = time.monotonic() - (strikes[0] if strikes else last)
    allowed = DEADLINE if "did not answer" in wanted else 0.0
    tally.took(max(0.0, seconds - allowed))
    if wanted not in message or who not in message:
        tally.miss(f"{what}: {message!r} instead of {wanted!r}")
    if seconds > allowed + NOTICED + SLACK:
        tally.lose(f"{what}: noticed after {seconds:.1f} s")
    envs.close()
    if orphans(pids, 5.0):
        tally.lose(f"{what}: a worker is still there")


def _training_processes(
    stage: Stage, number: int, rng: random.Random, place: Path, tally: Tally
) -> None:
    """A training process of a run is killed or stopped."""
    chain = stage.chain(place / "run", tally)
    for _ in range(number):
        what = rng.choice(["SIGKILL", "SIGSTOP", "coordinator"])
        arguments = stage.reference.arguments(chain.run, {"processes": 2})
        if (chain.run / "config.json").exists():
            arguments = ["resume", str(chain.run), "--processes=2"]
        process = stage.nursery.start(arguments, chain.run.with_suffix(".log"), silence=4.0)
        wait_for_rows(chain, process, rng.randrange(1, 8000))
        _strike_run(chain, process, what, rng, tally)
        if chain.is_complete():
            chain = stage.chain(place / "run", tally)
    chain.finish()


def _strike_run(chain: Chain, process: Any, what: str, rng: random.Random, tally: Tally) -> None:
    workers = children(process.pid)
    if not workers:
        return  # the run was over
    victim = rng.choice(workers)
    tally.tried += 1
    tally.count(f"training process: {what}")
    clock = time.monotonic()
    if what == "coordinator":
        send(rng.choice(workers), signal.SIGSTOP)  # stopped, it cannot end by itself
        send(process.pid, signal.SIGKILL)
    else:
        send(victim, getattr(signal, what))
    code, allowed = process.wait(PATIENCE), 4.0 if what == "SIGSTOP" else 0.0
    seconds = time.monotonic() - clock
    tally.took(max(0.0, seconds - allowed))
    wanted = {
        "SIGKILL": (1, f"({victim}) ended with exit code -9"),
        "coordinator": (-9, ""),
        "SIGSTOP": (1, f"({victim}) sent no heartbeat for 4 s"),
    }[what]
    named = code == wanted[0] and wanted[1] in process.said()
    if not named and not chain.is_complete():
        tally.miss(f"training process, {what}: {code}, {process.said()[-300:]!r}")
    if orphans(workers, 5.0):
        tally.lose(f"training process, {what}: one is still there")
    if seconds > allowed + NOTICED + 2 * SLACK:
        tally.lose(f"training process, {what}: noticed after {seconds:.1f} s")
    chain.judge(f"training process, {what}")


def test_a_worker_that_fails_is_named_in_time_and_none_is_left(tmp_path: Path) -> None:
    rng, tally = random.Random(0), Tally()
    _from_inside(rng, tally)
    _from_outside(rng, tally)
    assert_held(tally.result(), 2)


def test_a_dead_worker_is_noticed_while_another_one_is_awaited() -> None:
    """Worker 0 takes its time; worker 1 is gone. It must not take worker 0's deadline."""
    kwargs = {"what": "hang", "where": "step", "episode": 1, "seed": episode_seed(0, 0, 0)}
    envs = ProcessEnvs("small_envs:Failing", kwargs, SEEDS, 2, timeout=60.0)
    tally = Tally()
    pid = envs._workers[1].process.pid
    strikes: list[float] = []

    def strike() -> None:
        time.sleep(0.3)
        strikes.append(time.monotonic())
        os.kill(pid, signal.SIGKILL)

    _until_named(
        envs,
        "SIGKILL while waiting",
        OUTSIDE["SIGKILL"],
        tally,
        strike,
        strikes,
        f"worker 1 (process {pid})",
    )
    assert_held(tally.result(), 1)


def test_an_environment_worker_that_hangs_dies_with_its_parent(tmp_path: Path) -> None:
    """No pipe can tell it: its only thread is inside of a step that never ends."""
    import subprocess
    import sys

    from faults.nursery import environment

    kwargs = json.dumps({"what": "hang", "where": "step", "episode": 1})
    code = (
        "import numpy as np\nfrom sauna.envs.workers import ProcessEnvs\n"
        f"envs = ProcessEnvs('small_envs:Failing', {kwargs}, {SEEDS}, 1, timeout=60.0)\n"
        "envs.reset(); print(envs._workers[0].process.pid, flush=True)\n"
        "envs.step(np.zeros((3, 2), np.float32), np.ones(3, bool))"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment()
    )
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    time.sleep(0.3)
    assert is_alive(pid)
    parent.kill()
    parent.wait()
    assert not orphans([pid], 5.0)
