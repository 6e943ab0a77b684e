"""Exports of every kind of policy act as the policy does where no trainer is installed."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import exports
import pytest
from play_exports import OURS

from sauna.experiments.share.same import TOLERANCE


def test_the_stored_table_has_every_kind() -> None:
    """If this fails, run `python results/exports.py` and `python results/make.py`."""
    stored = json.loads(exports.FILE.read_text())
    assert list(stored["kinds"]) == list(exports.kinds()) and stored["trainers"] == []
    assert all(max(row["numpy"], row["onnx"]) <= TOLERANCE for row in stored["kinds"].values())


@pytest.mark.slow
def test_every_kind_acts_the_same_without_the_trainer(tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="needs `pip install 'sauna-rl[onnx]'`")
    try:
        python = exports.environment(tmp_path / "environment")
    except subprocess.CalledProcessError as error:
        pytest.skip(f"the packages cannot be installed here: {error}")
    found = exports.compared(tmp_path / "exports", python)
    assert found["trainers"] == [] and "jax" in OURS
    for kind in exports.kinds():
        row = found["kinds"][kind]
        assert row["observations"] >= 50 and row["actions"] > 1, kind
        assert max(row["numpy"], row["onnx"]) <= TOLERANCE, kind
