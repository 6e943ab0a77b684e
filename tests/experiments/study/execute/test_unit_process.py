"""A unit that is trained on another machine: what its run says of the one that keeps it."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from faults.canned import ENV, SAVED, SETTINGS, played_back, record
from sauna.config.trust import seal
from sauna.experiments.measure.streams import load_snapshot
from sauna.experiments.study.execute.unit_process import LineDisplay, train
from sauna.system import run_directory
from sauna.system.checkpoint import numbered
from sauna.system.errors import BadInput


@pytest.mark.parametrize("resumed", [False, True])
def test_a_run_of_a_node_is_the_users_at_home(
    resumed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node's user has another key; at home the run is measured all the same."""
    overrides: dict[str, Any] = {"env": ENV, **SETTINGS, **SAVED, "out": str(tmp_path / "run")}
    recorded = {"out": "runs/at_home", "git": "abc", "seal": seal(overrides)}
    run = tmp_path / "run"
    with monkeypatch.context() as node, played_back(record()):
        node.setenv("SAUNA_KEY_FILE", str(tmp_path / "key_of_the_node"))
        for again in (False, True)[: 1 + resumed]:
            if again:
                (run / "summary.json").unlink()
            elsewhere = {"recorded": dict(recorded), "folder": str(tmp_path)}
            train(dict(overrides), elsewhere, LineDisplay(io.StringIO()))
    stored = run_directory.read_config(run)
    assert stored["config"]["out"] == "runs/at_home" and stored["git"] == "abc"
    newest = int(numbered(run / "checkpoints")[-1].name)
    assert load_snapshot(run, "ppo/0", newest).env_steps == 192
    with monkeypatch.context() as node:  # with the node's own seal, as a control
        node.setenv("SAUNA_KEY_FILE", str(tmp_path / "key_of_the_node"))
        theirs = seal(overrides)
    (run / "config.json").write_text(json.dumps({**stored, "seal": theirs}))
    with pytest.raises(BadInput, match="not known to be yours"):
        load_snapshot(run, "ppo/0", newest)
