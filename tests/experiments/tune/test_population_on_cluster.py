"""A population on a cluster: the exchanges and the numbers of one on this machine."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from clusters import Place, needs_ray, on_ray, until
from command_line import small_flags
from helpers import SMALL, Silent
from sauna.experiments.study.execute import ray_cluster, ray_files, unit_process
from sauna.experiments.study.execute.local import LocalExecutor
from sauna.experiments.tune import population
from sauna.experiments.tune.command import tune
from sauna.system import run_directory
from sauna.system.errors import BadInput, Interrupted, SaunaError

GIVEN = {"env": "small_envs:MatchingAction", **{k: v for k, v in SMALL.items() if k != "seeds"}}
GIVEN |= {"preset": "discrete", "steps": 192}  # 6 iterations of 32 steps
SPACE = "learning_rate = {low = 1e-4, high = 1e-1, log = true}\ngamma = [0.5, 0.9, 0.99]\n"
Found = tuple[dict[str, Any], Path]


@pytest.fixture(autouse=True)
def no_ray(monkeypatch: pytest.MonkeyPatch, no_page: None, request: Any) -> None:
    """The units of a cluster are trained in threads of the test."""
    if "place" in request.fixturenames:
        return

    @contextmanager
    def connected(address: str, jobs: int) -> Iterator[int]:
        yield jobs

    monkeypatch.setattr(ray_cluster, "check", lambda address: None)
    monkeypatch.setattr(ray_cluster, "connected", connected)
    monkeypatch.setattr(ray_cluster, "RayExecutor", LocalExecutor)


def trained(folder: Path, on: str = "ray", **given: Any) -> Found:
    """Three members, which exchange at iterations 2 and 4."""
    (folder / "space.toml").write_text(SPACE)
    return tune(
        {**GIVEN, **given},
        folder,
        display=Silent,
        say=lambda text: None,
        jobs=1,
        on=on,
        trials=3,
        exchange_every=64,
        space=str(folder / "space.toml"),
        finalists=1,
        fresh_seeds=0,
        population_based=True,
    )


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory, no_page: None) -> Found:
    return trained(tmp_path_factory.mktemp("here"), on="local")


def same(one: Found, other: Found) -> bool:
    """Whether two populations exchanged and ended alike."""
    return all(one[0][name] == other[0][name] for name in ("exchanges", "trials", "env_steps"))


def test_its_exchanges_and_members_are_those_of_this_machine(here, tmp_path: Path) -> None:
    found = trained(tmp_path)
    assert found[0]["exchanges"] and same(found, here)
    whole = run_directory.rows(here[1] / "population" / "run")
    for number in range(3):
        own = run_directory.rows(found[1] / f"population/units/member-{number}/run")
        expected = [row for row in whole if row["arm"] == f"member-{number}"]
        names = ("iteration", "return_mean", "learning_rate", "kl", "episode_returns")
        assert [[row.get(n) for n in names] for row in own] == [
            [row.get(n) for n in names] for row in expected
        ]
    assert same(trained(tmp_path), here)  # complete: nothing is done


@pytest.mark.parametrize("when", ["training", "logged", "changed"])
def test_a_killed_one_ends_as_one_that_nobody_killed(
    when: str, here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed while a member trains in the second stretch; before and after what a kill can cut."""
    target, name = {
        "training": (unit_process, "train"),
        "logged": (population.Population, "_save"),
        "changed": (population.run_directory, "write_config"),
    }[when]
    real, calls = getattr(target, name), []

    def killed(*given: Any, **named: Any) -> Any:
        calls.append(1)
        if when == "training" and len(calls) in (5, 6):
            raise SaunaError("killed")
        if when == "logged" or (when == "changed" and _is_exchange(given)):
            raise Interrupted(2, "stopped")
        return real(*given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(target, name, killed)
        with pytest.raises((SaunaError, Interrupted)):
            trained(tmp_path)
    assert same(trained(tmp_path), here)


def _is_exchange(given: tuple[Any, ...]) -> bool:
    """Whether it is the config of a member that copied: of another rate than at its start."""
    path, stored = given
    before = run_directory.read_config(path) if (path / "config.json").is_file() else stored
    return path.parent.parent.name == "units" and stored["arms"] != before["arms"]


def test_a_member_that_fails_ends_it_and_is_named(tmp_path: Path, monkeypatch) -> None:
    real = unit_process.train

    def train(settings: dict[str, Any], *more: Any) -> None:
        if "member-1" in settings["out"]:
            raise SaunaError("its node was lost")
        real(settings, *more)

    with monkeypatch.context() as patched:
        patched.setattr(unit_process, "train", train)
        with pytest.raises(SaunaError, match="member-1: its node was lost"):
            trained(tmp_path)
    assert trained(tmp_path)[0]["trials"][1]["state"] == "complete"  # it is tried again


def test_what_was_copied_and_lost_is_said(tmp_path: Path) -> None:
    found, folder = trained(tmp_path, keep_checkpoints=9)
    one = found["exchanges"][0]
    run = folder / f"population/units/member-{one['member']}/run"
    (run / "summary.json").unlink()
    for name in ray_files.checkpoints(run.parent):
        if int(name) >= one["iteration"]:
            (run / "checkpoints" / name / "manifest.json").write_text("damaged")
    with pytest.raises(SaunaError, match=f"member-{one['member']} has lost its checkpoint"):
        trained(tmp_path, keep_checkpoints=9)


def test_it_goes_on_only_where_it_was_begun(here, tmp_path: Path) -> None:
    trained(tmp_path, processes=1)  # as one on this machine has, in the same folder
    with pytest.raises(BadInput, match="begun on a cluster; give --on ray"):
        trained(tmp_path, on="local")
    with pytest.raises(BadInput, match="begun on this machine; leave out --on ray"):
        trained(here[1].parent, processes=1)


# ------------------------------------------------------------------ on Ray


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    with on_ray(tmp_path, monkeypatch) as place:
        yield place


@pytest.mark.slow
@needs_ray
def test_stopped_and_continued_on_ray_it_ends_as_on_this_machine(place: Place, monkeypatch) -> None:
    monkeypatch.delenv("RAY_AUTH_TOKEN_PATH")
    (place.path / "space.toml").write_text(SPACE)
    flags = small_flags(steps=12_800, rollout_steps=64, preset="discrete")  # 200 iterations
    tune = ["tune", "small_envs:MatchingAction", *flags, "--space=../space.toml"]
    tune += ["--population-based", "--trials=3", "--exchange-every=3200"]
    tune += ["--finalists=1", "--fresh-seeds=0"]
    place.finish(place.start(*tune, folder="here"))
    remote = [*tune, "--on=ray", "--processes=2"]
    started = place.start(*remote, folder="ray")
    until(lambda: list((place.path / "ray").glob("runs/*/population/exchanges.jsonl")))
    started.send_signal(signal.SIGINT)
    assert place.finish(started, 130).strip().endswith("--on ray")
    until(lambda: not place.processes(), 60)
    place.finish(place.start(*remote, folder="ray"))
    found, expected = (results(place.path / folder) for folder in ("ray", "here"))
    for name in ("exchanges", "trials", "best"):
        assert found[name] == expected[name]
    assert len({one["iteration"] for one in found["exchanges"]}) > 1


def results(folder: Path) -> dict[str, Any]:
    (path,) = folder.glob("runs/tune_*/results.json")
    return run_directory.read_config_file(path)
