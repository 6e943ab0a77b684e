"""A search on a cluster: the trials of a search on this machine, whatever happens on the way."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from clusters import Place, needs_ray, on_ray, until
from command_line import sauna_here, small_flags
from sauna.experiments.study.execute import ray_cluster, unit_process
from sauna.experiments.study.execute.local import LocalExecutor
from sauna.experiments.tune.on_cluster import TrialsView
from sauna.system import run_directory
from sauna.system.errors import Interrupted, SaunaError
from tunings import SPACE, tuned

optuna = pytest.importorskip("optuna")


@pytest.fixture
def no_ray(monkeypatch: pytest.MonkeyPatch, no_page: None) -> None:
    """The units of a cluster are trained in threads of the test."""

    @contextmanager
    def connected(address: str, jobs: int) -> Iterator[int]:
        yield jobs

    monkeypatch.setattr(ray_cluster, "check", lambda address: None)
    monkeypatch.setattr(ray_cluster, "connected", connected)
    monkeypatch.setattr(ray_cluster, "RayExecutor", LocalExecutor)


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory, no_page: None) -> dict[str, Any]:
    """Two batches of two trials and of one, of two seeds each, on this machine."""
    return cluster_tuning(tmp_path_factory.mktemp("here"), on="local")[0]


def cluster_tuning(folder: Path, **options: Any) -> tuple[dict[str, Any], Path]:
    options = {"on": "ray", "trials": 3, "lockstep": 2, **options}
    return tuned(folder, given={"seeds": "0,1"}, **options)


def training(monkeypatch: pytest.MonkeyPatch, before: Callable[[dict[str, Any]], None]) -> None:
    """Calls `before` with the settings of each unit that is to be trained."""
    real = unit_process.train

    def train(settings: dict[str, Any], *more: Any) -> None:
        before(settings)
        real(settings, *more)

    monkeypatch.setattr(unit_process, "train", train)


def test_the_trials_are_those_of_this_machine(no_ray, here, tmp_path: Path) -> None:
    found, folder = cluster_tuning(tmp_path)
    assert found["trials"] == here["trials"] and found["best"] == here["best"]
    assert all(len(trial["curve"]) == 20 for trial in found["trials"])
    assert found["env_steps"] == here["env_steps"] and "processes" not in found["tune"]["settings"]
    runs = [str(path.relative_to(folder)) for path in sorted(folder.glob("batches/*/*/*/run"))]
    assert runs == [
        "batches/0000/units/trial-0/run",
        "batches/0000/units/trial-1/run",
        "batches/0001/units/trial-2/run",
    ]


def test_a_trial_that_fails_is_shown_and_costs_the_others_nothing(
    no_ray, here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    starts: list[str] = []

    def lost(settings: dict[str, Any]) -> None:
        starts.append(settings["out"])
        if "trial-1" in settings["out"]:
            raise SaunaError("its node was lost")

    training(monkeypatch, lost)
    found, folder = cluster_tuning(tmp_path, trials=2)
    good, bad = found["trials"]
    assert good == here["trials"][0]
    assert (bad["state"], bad["error"], bad["env_steps"]) == ("fail", "its node was lost", 0)
    assert "failed: its node was lost" in (folder / "trials.txt").read_text()
    assert "FAILED: small_envs:MatchingAction, trial-1, seed 1: its node was lost" in (
        capsys.readouterr().out
    )
    # Once more as a whole, then each of its seeds; never again when the tuning goes on.
    assert sum("trial-1" in out for out in starts) == 4
    assert cluster_tuning(tmp_path, trials=2)[0] == found and len(starts) == 5


def test_a_pruned_trial_is_told_so_and_not_trained_again(
    no_ray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr(optuna.Trial, "should_prune", lambda trial: trial.number == 1)
    with monkeypatch.context() as patched:
        patched.setattr(optuna.Study, "tell", _stop)
        with pytest.raises(Interrupted):
            cluster_tuning(tmp_path, trials=2)
    assert "trial-1 is pruned at 32 env steps" in capsys.readouterr().out
    training(monkeypatch, lambda settings: pytest.fail("trained again"))
    for path in tmp_path.glob("*/batches/0000/units/trial-1/run/summary.json"):
        path.unlink()  # as if it had been stopped when it was pruned
    found, _ = cluster_tuning(tmp_path, trials=2)
    good, pruned = found["trials"]
    assert (good["state"], pruned["state"]) == ("complete", "pruned")
    assert len(good["curve"]) == 20 and len(pruned["curve"]) == 5
    assert pruned["env_steps"] > 0 and found["best"]["number"] == 0


def test_what_nobody_saw_of_a_unit_is_reported_when_it_goes_on(
    no_ray, here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a kill: a checkpoint had arrived, and not all messages from before it."""
    with monkeypatch.context() as patched:
        patched.setattr(TrialsView, "progress", lambda *given: None)
        patched.setattr(optuna.Study, "tell", _stop)
        with pytest.raises(Interrupted):
            cluster_tuning(tmp_path, trials=2)
    for path in tmp_path.glob("*/batches/0000/units/*/run/summary.json"):
        run_directory.reopen_summary(path.parent)
    found, _ = cluster_tuning(tmp_path, trials=2)
    assert found["trials"] == here["trials"][:2]


def _stop(*given: Any, **named: Any) -> None:
    raise Interrupted(2, "stopped")


def test_a_signal_lets_trials_save_and_the_same_command_goes_on(
    no_ray, here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def signalled(settings: dict[str, Any]) -> None:
        if "trial-0" in settings["out"]:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patched:
        training(patched, signalled)
        with pytest.raises(Interrupted, match=r"continue with: sauna tune .* --on ray$") as stop:
            cluster_tuning(tmp_path)
    assert stop.value.signal_number == signal.SIGINT
    (results,) = tmp_path.glob("*/results.json")
    assert len(json.loads(results.read_text())["trials"]) == 2
    assert cluster_tuning(tmp_path)[0]["trials"] == here["trials"]


def test_without_ray_one_line_says_what_to_install(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    done = sauna_here("tune", "A-v0", "--on", "ray", cwd=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "on: ray needs `pip install sauna-rl[cluster]`" in done.stderr
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------ on Ray

STEPS = 25_600  # 400 iterations of a trial


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    with on_ray(tmp_path, monkeypatch) as place:
        yield place


@pytest.mark.slow
@needs_ray
def test_stopped_and_continued_it_finds_what_this_machine_finds(place: Place, monkeypatch) -> None:
    """On a Ray of our own, which is started anew for the fresh seeds."""
    monkeypatch.delenv("RAY_AUTH_TOKEN_PATH")
    (place.path / "space.toml").write_text(SPACE)
    flags = small_flags(steps=STEPS, rollout_steps=64, preset="discrete")
    tune = ["tune", "small_envs:MatchingAction", *flags, "--space=../space.toml"]
    tune += ["--trials=3", "--lockstep=2", "--finalists=1", "--fresh-seeds=2"]
    place.finish(place.start(*tune, folder="here"))
    remote = [*tune, "--on=ray", "--processes=2"]
    started = place.start(*remote, folder="ray")
    saved = "runs/*/batches/0000/units/*/run/checkpoints/[0-9]*"
    until(lambda: place.runs(started) and list((place.path / "ray").glob(saved)))
    started.send_signal(signal.SIGINT)
    said = place.finish(started, 130)
    assert "continue with: sauna tune small_envs:MatchingAction" in said and said.strip().endswith(
        "--on ray"
    )
    until(lambda: not place.processes(), 60)
    units = list((place.path / "ray").rglob("trial-[01]/run/summary.json"))
    assert units and not any(run_directory.is_complete(path.parent) for path in units)
    said = place.finish(place.start(*remote, folder="ray"))
    assert said.count("too few seeds") == 1 and "give at least --fresh-seeds" in said
    assert not list((place.path / "nodes").iterdir())
    found, expected = (results(place.path / folder) for folder in ("ray", "here"))
    assert found == expected
    assert [trial["state"] for trial in found["trials"]] == ["complete"] * 3
    assert found["fresh"]["table"]


def results(folder: Path) -> dict[str, Any]:
    (path,) = folder.glob("runs/tune_*/results.json")
    return json.loads(path.read_text())
