"""An exception in a user's code keeps its whole traceback, wherever it was raised."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import sauna
from helpers import SMALL, environment
from sauna.system.errors import BadInput, SaunaError
from sauna.system.tracebacks import WorkerTraceback, cause_of, describe_failure, user_frames
from small_envs import Failing

LINE = 'raise ValueError("the motor is on fire")'
FAILING = {"env_kwargs": {"what": "raise", "where": "step", "episode": 4}, "arm": "ppo", **SMALL}


def raising() -> None:
    raise KeyError("one\ntwo")


def wrapped() -> None:
    try:
        raising()
    except KeyError as error:
        raise SaunaError("a line of ours") from error


def test_only_the_users_frames_are_shown_and_everything_is_described() -> None:
    with pytest.raises(SaunaError) as caught:
        wrapped()
    shown = user_frames(caught.value)
    assert "in raising" in shown and shown.endswith("KeyError: 'one\\ntwo'")
    described = describe_failure(caught.value, in_process=False)
    assert described["frames"] == shown and "in wrapped" in described["traceback"]
    cause = cause_of(described)
    assert isinstance(cause, WorkerTraceback) and user_frames(cause) == shown
    assert user_frames(SaunaError("no code of a user's")) == ""
    assert user_frames(_of_a_library()) == ""


def _of_a_library() -> BaseException:
    try:
        re.compile("(")
    except re.error as error:
        error.__traceback__ = error.__traceback__.tb_next if error.__traceback__ else None
        return error
    raise AssertionError


def test_an_exception_of_this_process_is_the_cause_itself() -> None:
    with pytest.raises(SaunaError) as caught:
        wrapped()
    described = describe_failure(caught.value, in_process=True)
    assert cause_of(described) is caught.value.__cause__
    assert isinstance(cause_of(described), WorkerTraceback)  # taken once


@pytest.mark.processes
@pytest.mark.parametrize("env_processes", [0, 1])
def test_a_worker_that_fails_leaves_its_traceback(tmp_path: Path, env_processes: int) -> None:
    run = tmp_path / "run"
    with pytest.raises(SaunaError, match="motor is on fire") as caught:
        sauna.train(
            "small_envs:Failing", out=run, quiet=True, env_processes=env_processes, **FAILING
        )
    kept = (run / "failure.txt").read_text()
    assert LINE in kept and "small_envs.py" in kept and "Traceback" in kept
    assert str(run / "failure.txt") in str(caught.value)
    assert isinstance(caught.value.__cause__, WorkerTraceback)
    shown = user_frames(caught.value)
    assert LINE in shown and "gymnasium_envs.py" not in shown


def test_in_process_the_exception_is_the_cause(tmp_path: Path) -> None:
    with pytest.raises(SaunaError) as caught:
        sauna.train(lambda **kwargs: Failing(**kwargs), out=tmp_path / "run", quiet=True, **FAILING)
    assert isinstance(caught.value.__cause__, ValueError)
    assert caught.value.__cause__.__traceback__ is not None


def test_the_command_line_shows_the_users_frames(tmp_path: Path) -> None:
    """Of a network, whose failure is found before the run is made: nothing else is created."""
    (tmp_path / "mine.py").write_text(
        "from flax import linen\n\n\n"
        "class Network(linen.Module):\n    @linen.compact\n    def __call__(self, x):\n"
        "        return helper()\n\n\ndef helper():\n    return 1 / 0\n"
    )
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "sauna",
            "train",
            "small_envs:Scripted",
            "--network",
            "mine:Network",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=environment(),
    )
    *frames, line = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith("sauna: network: mine:Network cannot be used")
    assert (
        "return helper()" in "\n".join(frames)
        and frames[-1] == "ZeroDivisionError: division by zero"
    )
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "__pycache__") == [
        "mine.py"
    ]


def test_bad_input_found_before_the_run_has_its_cause() -> None:
    with pytest.raises(BadInput) as caught:
        sauna.train("small_envs:Raising", quiet=True)
    assert isinstance(caught.value.__cause__, ValueError)
