"""How a run's end is kept from hiding what came before it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from helpers import SMALL
from sauna.experiments.compute import training_seconds
from sauna.system import checkpoint, run_directory
from sauna.system.errors import SaunaError
from sauna.training import run as runs
from sauna.training.coordinator import Coordinator
from sauna.training.display import PlainDisplay
from sauna.training.train import train_run


class Part:
    """A watchdog, worker, tracker or display; each of them may fail as it ends."""

    def __init__(self, error: Exception | None) -> None:
        self.error, self.ended = error, 0

    def close(self, *_: float) -> None:
        self.ended += 1
        if self.error is not None:
            raise self.error

    stop = close


PARTS = ("_watchdog", "_trackers", "_display")


def coordinator(error: Exception | None) -> tuple[Coordinator, list[Part]]:
    """One whose parts raise `error` as they end; it trains nothing."""
    parts = [Part(error) for _ in range(5)]
    made = Coordinator.__new__(Coordinator)
    made.__dict__ |= dict(zip(PARTS, parts, strict=False)) | {"_workers": parts[3:]}
    return made, parts


@pytest.mark.parametrize("error", [OSError("the disk\nis full"), ValueError("closed"), None])
def test_what_fails_at_the_end_costs_no_training_and_ends_nothing_else(error, capsys) -> None:
    made, parts = coordinator(error)
    with made:
        pass
    assert [part.ended for part in parts] == [1] * 5
    said = capsys.readouterr().err.splitlines()
    assert len(said) == (5 if error else 0)
    assert all(line.startswith("warning: the training has ended") for line in said)


def test_what_fails_at_the_end_hides_no_error() -> None:
    made, _ = coordinator(RuntimeError("while closing"))
    with pytest.raises(SaunaError, match="what went wrong"), made:
        raise SaunaError("what went wrong")


def test_nobody_has_to_read_what_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr("sys.stderr", SimpleNamespace(write=broken, flush=broken))
    made, parts = coordinator(BrokenPipeError())
    with made:
        pass
    assert [part.ended for part in parts] == [1] * 5


@pytest.mark.parametrize(
    "env", ["small_envs:MatchingAction", pytest.param("jax_envs:walk", marks=pytest.mark.slow)]
)
def test_a_run_that_pauses_is_saved_there_and_goes_on_to_the_same_bytes(
    env: str, tmp_path: Path
) -> None:
    files = []
    for name, pauses in (("whole", ()), ("paused", (2,))):
        settings = {"env": env, **SMALL, "seeds": 2, "processes": 2, "out": str(tmp_path / name)}
        run, resume = runs.start(settings, PlainDisplay()), False
        for until in (*pauses, None):
            train_run(run, PlainDisplay(), resume=resume, until=until)
            assert run_directory.is_complete(run.path) == (until is None)
            newest = checkpoint.load_newest(run.path / "checkpoints", print)
            assert newest is not None
            assert until in (None, newest.manifest["iteration"])
            run, resume = runs.reopen(run.path, {}, PlainDisplay()), True
        run.lock.close()
        files.append((run.path / "metrics.jsonl").read_bytes())
        timings = run_directory.rows(run.path, "timing.jsonl")
        for member in ("ppo/0", "ppo/1"):
            seconds = training_seconds(timings, member)
            assert [*seconds] == [row["iteration"] for row in timings]
            assert all(value > 0 for value in seconds.values())
    assert files[0] == files[1]
