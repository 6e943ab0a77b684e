"""Row 2: SIGKILL at any moment; what is left is a prefix of the run left alone, to the bit."""

from __future__ import annotations

import json
import random
import signal
import time
from pathlib import Path

import pytest

from faults.chain import (
    BACKENDS,
    PATIENCE,
    SETTINGS,
    Chain,
    Stage,
    children,
    is_saving,
    on_each_backend,
    orphans,
    send,
    wait_for_rows,
    wait_until,
)
from faults.nursery import Started
from faults.result import Result, Tally, assert_held

AIMS = ("save", "save", "rows", "start")
CHAIN = 25  # kills of one run


def experiment(kills: int, seed: int, place: Path) -> Result:
    """Kills runs again and again, in chains of 25 kills of one run; `kills` on each backend.

    A third of the kills hit the coordinator alone, whose workers then have to end by themselves;
    every tenth process is started as a user starts it. `worst`: seconds from a resume's start to
    its first new row.
    """
    tally = Tally()
    for stage in on_each_backend(place, tally):
        _kill_again_and_again(stage, kills, random.Random(seed), place, tally)
    return tally.result()


def _kill_again_and_again(
    stage: Stage, kills: int, rng: random.Random, place: Path, tally: Tally
) -> None:
    chain, in_chain, end = stage.chain(place / "run", tally), 0, tally.tried + kills
    while tally.tried < end:
        in_chain += _kill(chain, rng, tally, fresh=tally.tried % 10 == 9)
        if in_chain == CHAIN or chain.is_complete() or tally.tried == end:
            if not chain.is_complete():
                chain.finish()
            tally.notes["longest chain"] = max(tally.notes.get("longest chain", 0), in_chain)
            chain, in_chain = stage.chain(place / "run", tally), 0


def _kill(chain: Chain, rng: random.Random, tally: Tally, fresh: bool) -> bool:
    """Starts the run and kills it; False if it had ended before."""
    aim, clock = rng.choice(AIMS), time.monotonic()
    process = chain.start(fresh)
    if aim == "start":
        time.sleep(rng.uniform(0.0, 4.0))
    elif wait_for_rows(chain, process, 1):
        tally.took(time.monotonic() - clock)
        wait_for_rows(chain, process, rng.randrange(1, 15_000))
    if aim == "save":
        wait_until(lambda: is_saving(chain.run), process, 20.0, 0.0002)
        time.sleep(rng.choice([0.0, 0.0, rng.uniform(0.0, 0.004)]))
    workers = children(process.pid)
    send(process.pid, signal.SIGKILL)
    if rng.random() < 0.67:
        for pid in workers:
            send(pid, signal.SIGKILL)
    if process.wait(30.0) != -signal.SIGKILL:
        return False
    tally.tried += 1
    tally.count(f"aimed at: {aim}")
    left = list((chain.run / "checkpoints").glob(".writing-*"))
    saved = list((chain.run / "checkpoints").glob("[0-9]" * 8))
    if left or len(saved) > 2:
        tally.count("inside a save")
    if orphans(workers, 5.0):
        tally.lose("a worker outlived its coordinator")
    chain.judge(f"kill {tally.tried} (aimed at {aim})")
    return True


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_comparison_that_is_killed_goes_on_to_the_same_bytes(
    backend: str, tmp_path: Path
) -> None:
    """Its runs notice, save and end by themselves; the same command continues them."""
    env, own = BACKENDS[backend]
    settings = {**SETTINGS, **own, "steps": 32 * 400}
    del settings["arm"]
    command = ["compare", env, "--arms=ppo,sauna", "--no-controls"]
    command += [f"--{k}={v}" for k, v in settings.items()]

    def start(out: Path) -> Started:
        return Started([*command, "--out", str(out)], out.with_suffix(".log"))

    def logs(out: Path) -> dict[str, bytes]:
        found = (out / "units").rglob("metrics.jsonl")
        return {str(path.relative_to(out)): path.read_bytes() for path in found}

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert start(whole).wait(5 * PATIENCE) == 0
    for least in (1, 20_000):
        process = start(killed)
        wait_until(lambda: sum(map(len, logs(killed).values())) >= least, process, PATIENCE, 0.1)  # noqa: B023
        process.kill()
        assert process.wait(30.0) == -signal.SIGKILL
    process = start(killed)
    assert process.wait(5 * PATIENCE) == 0, process.said()
    assert logs(killed) == logs(whole) and len(logs(whole)) == 2
    name = next(path.name for path in whole.iterdir() if path.name.startswith("compare_"))
    table = [json.loads((o / name / "summary.json").read_text())["table"] for o in (whole, killed)]
    assert table[0] == table[1]


def test_killed_at_any_moment_it_goes_on_to_the_same_bytes(stage: Stage, tmp_path: Path) -> None:
    tally = Tally()
    _kill_again_and_again(stage, 2, random.Random(1), tmp_path, tally)
    assert_held(tally.result(), 2)
