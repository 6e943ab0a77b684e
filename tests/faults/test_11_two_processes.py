"""Row 11: of several processes that want one run, one gets it; the others learn who has it."""

from __future__ import annotations

import random
import shutil
import signal
import time
from pathlib import Path

import pytest

from faults.chain import Chain, Stage, children, on_each_backend, orphans, send
from faults.nursery import Nursery, Process
from faults.result import Result, Tally, assert_held

AT_A_TIME = 3


def experiment(races: int, seed: int, place: Path) -> Result:
    """Lets three processes resume one run at the same moment, or start one in the same folder.

    The winner is then killed, so that the next race begins with the lock of a dead process;
    `races` on each backend.
    `worst`: seconds until the losers have ended.
    """
    tally = Tally()
    for stage in on_each_backend(place, tally):
        _race_again_and_again(stage, races, random.Random(seed), place, tally)
    return tally.result()


def _race_again_and_again(
    stage: Stage, races: int, rng: random.Random, place: Path, tally: Tally
) -> None:
    chain, end = stage.chain(place / "run", tally), tally.tried + races
    while tally.tried < end:
        arguments = ["resume", str(chain.run)]
        if rng.random() < 0.33 or not (chain.run / "config.json").exists():
            chain = stage.chain(place / "run", tally)  # in an empty folder
            arguments = stage.reference.arguments(chain.run)
        _race(stage.nursery, arguments, chain, tally, rng.uniform(0.0, 0.8))
    shutil.rmtree(chain.run)


def _race(nursery: Nursery, arguments: list[str], chain: Chain, tally: Tally, more: float) -> None:
    at = time.monotonic() + 0.2
    logs = [chain.run.with_suffix(f".log{number}") for number in range(AT_A_TIME)]
    racers = [nursery.start(arguments, log, at=at) for log in logs]
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        running = [racer for racer in racers if racer.wait(0.01) is None]
        if len(running) <= 1:
            break
    tally.tried += 1
    tally.took(time.monotonic() - at)
    what = f"race {tally.tried} ({arguments[0]})"
    tally.count(f"races to {arguments[0]}")
    if len(running) != 1:
        tally.lose(f"{what}: {len(running)} of {AT_A_TIME} go on")
    time.sleep(more)
    workers = [pid for racer in running for pid in children(racer.pid)]
    for racer in running:
        for loser in racers:
            if loser is not racer:
                _check_told(loser, racer, what, tally)
        racer.kill()
        racer.wait(30.0)
    orphans(workers, 5.0)
    for pid in workers:
        send(pid, signal.SIGKILL)
    chain.judge(what)


def _check_told(loser: Process, winner: Process, what: str, tally: Tally) -> None:
    said = loser.said()
    if loser.wait(0.0) != 2:
        tally.lose(f"{what}: a loser ended with {loser.wait(0.0)}: {said[-300:]}")
    elif f"is in use by process {winner.pid}" in said:
        tally.count("named the process that has it")
    elif "is not empty; `sauna resume" in said:
        tally.count("refused as there is a run")
    else:
        tally.miss(f"{what}: a loser said {said[-300:]!r}, the winner was {winner.pid}")


@pytest.mark.slow
def test_one_gets_the_run_and_the_others_are_told(stage: Stage, tmp_path: Path) -> None:
    tally = Tally()
    _race_again_and_again(stage, 3, random.Random(6), tmp_path, tally)
    assert_held(tally.result(), 3)
