"""Row 9: the first signal finishes the iteration and saves, a second one stops at once."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import pytest

from faults.canned import Ended, Trap, go, played_back, record, until
from faults.chain import (
    PATIENCE,
    Chain,
    Stage,
    children,
    on_each_backend,
    orphans,
    send,
    wait_for_rows,
)
from faults.disk import Op
from faults.result import Result, Tally, assert_held
from sauna.system import checkpoint
from sauna.system.errors import Interrupted


def experiment(signals: int, seed: int, place: Path) -> Result:
    """Stops runs with SIGINT and SIGTERM at random moments, one in four twice; on each backend.

    `worst`: seconds from the first signal to the end of the process.
    """
    tally = Tally()
    for stage in on_each_backend(place, tally):
        _stop_again_and_again(stage, signals, random.Random(seed), place, tally)
    return tally.result()


def _stop_again_and_again(
    stage: Stage, signals: int, rng: random.Random, place: Path, tally: Tally
) -> None:
    chain, end = stage.chain(place / "run", tally), tally.tried + signals
    while tally.tried < end:
        _signal(chain, rng, tally, fresh=tally.tried % 10 == 9)
        if chain.is_complete() or tally.tried == end:
            if not chain.is_complete():
                chain.finish()
            chain = stage.chain(place / "run", tally)


def _signal(chain: Chain, rng: random.Random, tally: Tally, fresh: bool) -> None:
    process = chain.start(fresh)
    number, twice = rng.choice([signal.SIGINT, signal.SIGTERM]), rng.random() < 0.25
    if rng.random() < 0.2:
        time.sleep(rng.uniform(0.3, 4.0))
    else:
        wait_for_rows(chain, process, rng.randrange(1, 20_000))
    workers, clock = children(process.pid), time.monotonic()
    send(process.pid, number)
    if twice:
        time.sleep(rng.uniform(0.0, 0.1))
        send(process.pid, number)
    code = process.wait(PATIENCE)
    tally.tried += 1
    tally.took(time.monotonic() - clock)
    what = f"{signal.Signals(number).name}{' twice' if twice else ''} {tally.tried}"
    if code is None:
        tally.lose(f"{what}: still running")
        process.kill()
    elif (128 - code if code < 0 else code) != 128 + number and not chain.is_complete():
        tally.lose(f"{what}: exit code {code}: {process.said()[-300:]}")
    if orphans(workers, 5.0):
        tally.lose(f"{what}: a worker outlived its coordinator")
    chain.judge(what)
    _count(chain, process.said(), tally, what)


def _count(chain: Chain, said: str, tally: Tally, what: str) -> None:
    """How it ended; after an orderly stop no row may be behind the checkpoint."""
    if chain.is_complete():
        tally.count("came when the run was over")
    elif "stopped at once" in said:
        tally.count("second signal stopped at once")
    elif "after iteration" in said:
        tally.count("finished the iteration and saved")
        found = checkpoint.load_newest(chain.run / "checkpoints", print)
        if not found or found.manifest["logs"]["metrics.jsonl"] != chain.rows():
            tally.lose(f"{what}: rows behind the checkpoint after an orderly stop")
    else:
        tally.count("came before training began")


@pytest.mark.parametrize("twice", [False, True])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_a_file_operation_saves_and_a_second_one_stops_at_once(
    number: int, twice: bool, tmp_path: Path
) -> None:
    """The product's own handlers; the training is played back."""
    with played_back(record()):
        until(tmp_path / "whole", Trap())
        for at in (10, 26, 40):
            ops: list[Op] = []

            def strike(op: Op) -> None:
                ops.append(op)  # noqa: B023
                if len(ops) == at:  # noqa: B023
                    os.kill(os.getpid(), number)
                if twice and len(ops) == at + 1:  # noqa: B023
                    os.kill(os.getpid(), number)

            run = tmp_path / f"run{at}"
            error = until(run, strike)
            assert isinstance(error, Interrupted) and error.signal_number == number
            assert ("stopped at once" in str(error)) == twice
            found = checkpoint.load_newest(run / "checkpoints", print)
            if not twice:
                size = (run / "metrics.jsonl").stat().st_size
                assert found is not None and found.manifest["logs"]["metrics.jsonl"] == size
            go(run)
            assert Ended(tmp_path / "whole").differs(run) is None


@pytest.mark.slow
def test_a_signal_saves_and_a_second_one_leaves_a_safe_state(stage: Stage, tmp_path: Path) -> None:
    tally = Tally()
    _stop_again_and_again(stage, 3, random.Random(2), tmp_path, tally)
    assert_held(tally.result(), 3)
