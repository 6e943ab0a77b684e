"""Processes that are started before there is work for them, and modules that are imported later."""

from __future__ import annotations

import gc
import sys
from pathlib import Path

import pytest

from sauna.system.imports import put_off, uncollected
from sauna.system.spawn import Spawned, spawn, spawned_ahead

WAITS = "import os, sys\nos.read(int(sys.argv[1]), 1)\n"  # until its parent closes the pipe
GIVEN = {"GIVEN": "x"}


def end(spawned: Spawned) -> None:
    spawned.process.kill()
    spawned.process.wait()


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "waits.py").write_text(WAITS)
    monkeypatch.chdir(tmp_path)
    return "waits"


def started_ahead(module: str) -> Spawned:
    from sauna.system import spawn as ours

    return ours._ahead[module][1]


def test_a_process_that_was_started_ahead_is_taken_once(
    module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with spawned_ahead(module, GIVEN):
        ahead = started_ahead(module)
        monkeypatch.setenv("OF_A_LIBRARY", "which the child imports as well")
        taken, another = spawn(module, GIVEN), spawn(module, GIVEN)
    assert taken == ahead and another.process.pid != ahead.process.pid
    assert taken.process.poll() is None, "it outlives the block"
    end(taken)
    end(another)


@pytest.mark.parametrize("changed", ["given", "variable", "path", "folder"])
def test_a_process_that_would_be_another_now_is_not_taken(
    module: str, changed: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("A_VARIABLE", "before")
    with spawned_ahead(module, GIVEN):
        ahead = started_ahead(module)
        if changed == "variable":
            monkeypatch.setenv("A_VARIABLE", "after")
        if changed == "path":
            monkeypatch.setattr(sys, "path", [str(tmp_path / "more"), *sys.path])
        if changed == "folder":
            (tmp_path / "other").mkdir()
            monkeypatch.chdir(tmp_path / "other")
        other = spawn(module, {"GIVEN": "y"} if changed == "given" else GIVEN)
        assert ahead.process.returncode is not None, "nobody would ever end it"
    assert other.process.pid != ahead.process.pid
    end(other)


def test_a_process_that_nobody_takes_ends_with_the_block(module: str) -> None:
    with pytest.raises(KeyError), spawned_ahead(module, GIVEN):
        ahead = started_ahead(module)
        raise KeyError
    assert ahead.process.returncode is not None


def test_a_module_that_is_put_off_is_imported_at_its_first_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "drawing").mkdir()
    (tmp_path / "drawing" / "__init__.py").write_text("red = 1\n")
    (tmp_path / "drawing" / "lines.py").write_text("width = 2\n")
    (tmp_path / "draws.py").write_text("import drawing.lines as lines\nfrom drawing import lines\n")
    monkeypatch.syspath_prepend(tmp_path)
    with put_off("drawing", "drawing.lines"):
        import draws  # type: ignore[import-not-found]
    assert not {"drawing", "drawing.lines"} & {*sys.modules}
    assert draws.lines.width == 2
    import drawing  # type: ignore[import-not-found]

    assert drawing.red == 1 and drawing.lines.__file__.endswith("lines.py")
    with put_off("drawing", "drawing.lines"):
        assert sys.modules["drawing"] is drawing, "it is imported already"
    for name in ("draws", "drawing", "drawing.lines"):
        monkeypatch.delitem(sys.modules, name)


def test_garbage_is_collected_again_after_a_block_of_imports_if_it_was_before() -> None:
    for collects in (True, False):
        (gc.enable if collects else gc.disable)()
        try:
            with pytest.raises(KeyError), uncollected():
                assert not gc.isenabled()
                raise KeyError
            assert gc.isenabled() == collects
        finally:
            gc.enable()
