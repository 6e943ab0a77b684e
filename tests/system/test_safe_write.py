"""Nothing is written through a link, and nothing waits for a FIFO."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

import sauna
from helpers import SMALL
from sauna.experiments.report import style
from sauna.system import checkpoint, logs, run_directory
from sauna.system.errors import SaunaError
from sauna.system.safe_read import Untrusted
from sauna.system.safe_write import (
    check_own,
    is_unfinished,
    open_grown,
    own_folder,
    replace_file,
    replacing,
)

PRECIOUS = b"somebody's thesis"


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    path = tmp_path / "precious"
    path.write_bytes(PRECIOUS)
    return path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "run"
    path.mkdir()
    return path


def test_a_link_is_replaced_and_not_followed(run: Path, precious: Path) -> None:
    page = run / "page.html"
    page.symlink_to(precious)
    replace_file(page, b"new")
    assert not page.is_symlink() and page.read_bytes() == b"new"
    os.link(precious, run / "hard.html")
    with replacing(run / "hard.html") as temporary:
        temporary.write_bytes(b"new")
    assert precious.read_bytes() == PRECIOUS
    assert sorted(path.name for path in run.iterdir()) == ["hard.html", "page.html"]


def test_temporary_names_cannot_be_guessed_and_are_not_taken_for_files(run: Path) -> None:
    names = []
    for _ in range(3):
        with replacing(run / "x.png") as temporary:
            names.append(temporary.name)
            assert temporary.suffix == ".png" and is_unfinished(temporary)
    assert len(set(names)) == 3 and all(len(name) > 16 for name in names)
    with pytest.raises(ValueError), replacing(run / "x.png") as temporary:
        raise ValueError
    assert not temporary.exists()


@pytest.mark.parametrize("plant", ["link", "hard link", "fifo", "folder"])
def test_what_grows_is_a_regular_file_of_one_name(run: Path, precious: Path, plant: str) -> None:
    path = run / "metrics.jsonl"
    _plant(plant, path, precious)
    with pytest.raises(Untrusted, match=r"metrics\.jsonl is "):
        open_grown(path)
    with pytest.raises(Untrusted):
        check_own(path)
    with pytest.raises(Untrusted):
        logs.cut_logs(run, {})
    assert precious.read_bytes() == PRECIOUS


def _plant(what: str, path: Path, precious: Path) -> None:
    plants: dict[str, Callable[[], object]] = {
        "link": lambda: path.symlink_to(precious),
        "hard link": lambda: os.link(precious, path),
        "fifo": lambda: os.mkfifo(path),
        "folder": path.mkdir,
    }
    plants[what]()


@pytest.mark.parametrize("plant", ["link", "hard link", "fifo"])
def test_a_lock_is_never_somebody_elses_file(run: Path, precious: Path, plant: str) -> None:
    _plant(plant, run / ".lock", precious)
    with pytest.raises(Untrusted):
        run_directory.lock(run)
    assert precious.read_bytes() == PRECIOUS


def test_folders_are_not_links(run: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("checkpoints", "figures"):
        (run / name).symlink_to(elsewhere)
        with pytest.raises(Untrusted, match="is a link"):
            own_folder(run / name)
    with pytest.raises(Untrusted):
        checkpoint.save_checkpoint(run / "checkpoints", 1, {}, {}, 1)
    with pytest.raises(Untrusted):
        style.save(None, run / "figures" / "a.png")
    assert list(elsewhere.iterdir()) == []


def test_a_planted_run_does_not_write_elsewhere(tmp_path: Path, precious: Path) -> None:
    """Of a whole training: its own folder may be a link, what is in it may not."""
    elsewhere, run = tmp_path / "elsewhere", tmp_path / "run"
    elsewhere.mkdir()
    run.symlink_to(elsewhere)
    settings = {**SMALL, "arm": "ppo", "checkpoint_every": 2, "quiet": True}
    sauna.train("small_envs:Scripted", out=run, **settings)
    assert (elsewhere / "summary.json").exists()
    (run / "summary.json").unlink()
    (run / "summary.json").symlink_to(precious)
    (run / "timing.jsonl").unlink()
    (run / "timing.jsonl").symlink_to(precious)
    with pytest.raises(SaunaError):
        sauna.resume(run, quiet=True)
    assert precious.read_bytes() == PRECIOUS


def test_folders_are_made_here_or_where_the_user_said() -> None:
    """Whatever else makes a folder could make it behind a link of somebody else's."""
    source = Path(sauna.__file__).parent
    makers = {p.relative_to(source).as_posix() for p in source.rglob("*.py") if _makes(p)}
    assert makers <= {
        "system/safe_write.py",
        "system/checkpoint.py",  # a temporary name that cannot be guessed
        "system/run_directory.py",  # --out
        "config/trust.py",  # the folder of this user's key
        "experiments/bench/peer_rltools.py",  # inside the peer's own environment
        "experiments/study/command.py",  # --out
        "experiments/study/existing.py",
        "experiments/study/report.py",
        "experiments/study/execute/ray_files.py",  # inside a unit that this study locked
        "experiments/tune/command.py",  # --out
        "experiments/share/export.py",  # --to
        "experiments/share/exchange.py",  # inside a new folder of a temporary name
        "system/hub.py",  # where the user said
        "training/data/minari_sets.py",  # --to minari:
    }


def _makes(path: Path) -> bool:
    return ".mkdir(" in path.read_text() or "makedirs(" in path.read_text()
