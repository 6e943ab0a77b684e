"""Where a run is written: two runs never meet, and what continues one can be typed."""

from __future__ import annotations

import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sauna.system import run_directory
from sauna.system.errors import BadInput


def test_runs_of_one_second_never_share_a_directory(tmp_path: Path, monkeypatch) -> None:
    """Twenty at once, at a moment that stands still."""
    monkeypatch.chdir(tmp_path)

    class Still(run_directory.datetime.datetime):
        @classmethod
        def now(cls, tz: object = None) -> Still:
            return cls(2026, 1, 2, 3, 4, 5)

    monkeypatch.setattr(run_directory.datetime, "datetime", Still)
    with ThreadPoolExecutor(20) as pool:
        made = pool.map(
            lambda _: run_directory.create_default("Hopper-v5", ("ppo",), (7,)), "x" * 20
        )
        paths = list(made)
    assert len(set(paths)) == 20 and all(path.is_dir() for path in paths)
    assert Path("runs/Hopper-v5_ppo_seed7_20260102-030405") in paths


@pytest.mark.parametrize(
    "seeds, name",
    [((7,), "seed7"), ((0, 1, 2), "seeds0-2"), ((3, 4), "seeds3-4"), ((4, 9), "2seeds")],
)
def test_arms_and_seeds_are_in_the_name(seeds: tuple, name: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = run_directory.create_default("my_envs:Arm/x", ("ppo", "sauna"), seeds)
    assert path.parent == Path("runs")
    assert path.name.startswith(f"my_envs-Arm-x_ppo+sauna_{name}_")


def test_where_no_folder_can_be_made_it_is_bad_input(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").write_text("a file")
    with pytest.raises(BadInput, match="out: cannot make runs"):
        run_directory.create_default("x", ("ppo",), (0,))
    with pytest.raises(BadInput, match="out: cannot make runs"):
        run_directory.create(Path("runs/here"))


def test_the_command_that_continues_a_run_is_quoted_for_a_shell(tmp_path: Path) -> None:
    run = tmp_path / "it's a run; $HOME"
    run.mkdir()
    (run / "config.json").write_text("{}")
    with pytest.raises(BadInput) as refused:
        run_directory.create(run)
    command = str(refused.value).split("`")[1]
    assert shlex.split(command) == ["sauna", "resume", str(run)]


@pytest.mark.parametrize("made", [True, False])
def test_a_run_without_a_row_leaves_nothing_behind(made: bool, tmp_path: Path) -> None:
    """Also what its trackers wrote before a worker found the settings unusable."""
    run = tmp_path / "run"
    for folder in ("initial", "tensorboard"):
        (run / folder).mkdir(parents=True)
        (run / folder / "file").write_text("x")
    for name in ("config.json", ".lock", "tracking.json", "metrics.csv"):
        (run / name).write_text("{}")
    (tmp_path / "mine").mkdir()
    (run / "link").symlink_to(tmp_path / "mine")
    run_directory.discard(run, made)
    assert run.exists() != made and (tmp_path / "mine").is_dir()
    assert not made or list(tmp_path.iterdir()) == [tmp_path / "mine"]
    assert made or list(run.iterdir()) == []


def test_a_run_with_rows_is_kept(tmp_path: Path) -> None:
    for name in ("config.json", "metrics.jsonl"):
        (tmp_path / name).write_text("")
    run_directory.discard(tmp_path, made=True)
    assert len(list(tmp_path.iterdir())) == 2
