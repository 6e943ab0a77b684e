"""A run opened in another folder says where its modules were."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from helpers import SMALL
from sauna.config.imported_from import KEY, folders_of
from sauna.config.plugins import import_module
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.training import run as runs
from sauna.training.display import PlainDisplay

MODULE = "from small_envs import Scripted as Mine\n"


def test_a_run_opened_elsewhere_names_the_folder_and_does_not_import_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, elsewhere = tmp_path / "home", tmp_path / "elsewhere"
    home.mkdir(), elsewhere.mkdir()
    (home / "a_place_of_mine.py").write_text(MODULE)
    monkeypatch.chdir(home)
    monkeypatch.setattr(sys, "path", [*sys.path])
    settings = {**SMALL, "env": "a_place_of_mine:Mine", "arm": "ppo", "out": str(tmp_path / "run")}
    runs.start(settings, PlainDisplay()).lock.close()
    stored = run_directory.read_config(tmp_path / "run")
    assert stored[KEY] == {"a_place_of_mine": str(home)}

    monkeypatch.chdir(elsewhere)
    sys.path.remove(str(home))
    monkeypatch.delitem(sys.modules, "a_place_of_mine")
    with pytest.raises(BadInput) as caught:
        runs.reopen(tmp_path / "run", {}, PlainDisplay())
    said = str(caught.value)
    assert f"the run imported it from {home}: run there, or set PYTHONPATH={home}" in said
    assert f"it is not in {elsewhere}" in said
    assert "a_place_of_mine" not in sys.modules


def test_packages_have_their_folder_above_and_installed_ones_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a_package_of_mine" / "part").mkdir(parents=True)
    for folder in ("", "part"):
        (tmp_path / "a_package_of_mine" / folder / "__init__.py").write_text("")
    (tmp_path / "a_package_of_mine" / "part" / "deep.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("a_package_of_mine.part.deep", "a_package_of_mine.part", "gymnasium.envs"):
        __import__(name)
        monkeypatch.setitem(sys.modules, name, sys.modules[name])
        found = folders_of({"config": {"env": f"{name}:Mine"}})
        own = {name: str(tmp_path)} if "mine" in name else {}
        assert found == own


def test_a_module_that_lacks_another_is_no_missing_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("needs_another.py").write_text("import no_such_module_at_all\n")
    with pytest.raises(BadInput, match=r"'needs_another': ModuleNotFoundError: .*at_all"):
        import_module("env", "needs_another", "needs_another:Mine")
    with pytest.raises(BadInput, match="did you mean 'needs_another'"):
        import_module("env", "needs_an_other", "needs_an_other:Mine")
