"""Results of other code are not taken for this code's."""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path

import pytest

import sauna
from helpers import SMALL, TESTS
from sauna.config.code import changed_code
from sauna.config.code import code_of as all_code_of
from sauna.system import run_directory
from sauna.system.errors import BadInput


def code_of(settings: dict) -> dict[str, str]:
    """Without the package's own sources, which every run names."""
    found = all_code_of(settings)
    del found["sauna"]
    return found


ENVIRONMENT = """
from small_envs import Scripted
from rewards_of_mine import SCALE

class Mine(Scripted):
    def reward(self, action):
        return SCALE * super().reward(action)
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of modules; `of_mine` imports `rewards_of_mine`."""
    (tmp_path / "of_mine.py").write_text(ENVIRONMENT)
    (tmp_path / "rewards_of_mine.py").write_text("SCALE = 1.0\n")
    (tmp_path / "bystander_of_mine.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    paths = os.pathsep.join([str(tmp_path), TESTS, *filter(None, [os.environ.get("PYTHONPATH")])])
    monkeypatch.setenv("PYTHONPATH", paths)
    importlib.import_module("of_mine")
    yield tmp_path
    for name in ("of_mine", "rewards_of_mine"):
        sys.modules.pop(name, None)


def test_a_digest_covers_what_a_module_imports_and_no_more(mine: Path) -> None:
    config = {"env": "of_mine:Mine", "network": "mlp"}
    before = code_of(config)
    assert {"of_mine", "rewards_of_mine", "small_envs"} <= set(before)
    assert not {"numpy", "gymnasium", "bystander_of_mine", "sauna"} & set(before)
    assert code_of(config) == before and changed_code(before, before) == ""
    (mine / "bystander_of_mine.py").write_text("x = 1\n")
    assert code_of(config) == before
    (mine / "rewards_of_mine.py").write_text("SCALE = 2.0\n")
    assert changed_code(before, code_of(config)) == "module rewards_of_mine changed"
    assert changed_code({"a": "1"}, {"b": "2"}) == "module a is gone, module b is new"


def test_packages_count_by_their_version(mine: Path) -> None:
    assert code_of({"env": "Hopper-v5"}) == {}  # Gymnasium's version is checked as before
    installed = code_of({"env": "Hopper-v5", "network": "flax.linen:Dense"})
    assert set(installed) == {"flax.linen", "package flax"}
    assert set(code_of({"env": "ALE/Pong-v5"})) == {"package ale-py"}
    assert changed_code({"package x": "1"}, {"package x": "2"}) == "package x 1 -> 2"


def test_a_registered_id_stands_for_its_class(mine: Path) -> None:
    import gymnasium

    gymnasium.register("OfMine-v0", entry_point="of_mine:Mine")
    try:
        assert "rewards_of_mine" in code_of({"env": "OfMine-v0"})
    finally:
        del gymnasium.registry["OfMine-v0"]


def test_a_run_goes_on_with_other_code_only_if_that_is_accepted(mine: Path, tmp_path) -> None:
    run = tmp_path / "run"
    sauna.train("of_mine:Mine", out=run, quiet=True, checkpoint_every=2, **SMALL)
    before = run_directory.read_config(run)["code"]
    newest = sorted((run / "checkpoints").iterdir())[-1]
    assert json.loads((newest / "manifest.json").read_text())["code"] == before
    (run / "summary.json").unlink()
    (mine / "rewards_of_mine.py").write_text("SCALE = 3.0\n")
    with pytest.raises(BadInput, match="other code: module rewards_of_mine changed"):
        sauna.resume(run, quiet=True)
    sauna.resume(run, quiet=True, accept_changed_code=True)
    stored = run_directory.read_config(run)
    assert stored["code_before"] == [before] and stored["code"] != before
    (run / "summary.json").unlink()
    sauna.resume(run, quiet=True)  # it is today's now


def test_a_comparison_takes_no_numbers_of_other_code(mine: Path, tmp_path: Path) -> None:
    settings = {**SMALL, "arms": ["ppo"], "out": tmp_path / "runs", "quiet": True, "seeds": 2}
    first = sauna.compare("of_mine:Mine", **settings)
    assert first["table"][0]["seeds"] == 2
    (mine / "of_mine.py").write_text(ENVIRONMENT + "\n# other\n")
    with pytest.raises(BadInput, match="other code: module of_mine changed; --accept-changed"):
        sauna.compare("of_mine:Mine", **settings)
    again = sauna.compare("of_mine:Mine", accept_changed_code=True, **settings)
    assert again["table"] == first["table"]
    sauna.compare("of_mine:Mine", **settings)
