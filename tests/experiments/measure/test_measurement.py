"""A measurement is one record: the package's, under old names too, and a user's own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from command_line import sauna
from sauna.experiments.measure import Measurement
from sauna.experiments.measure.coverage_report import text_table
from sauna.experiments.measure.measurement import BUILT_IN, FORMER_NAMES, find_measurement
from sauna.experiments.measure.noise_report import over_members
from sauna.experiments.study.spec import load_spec, read_spec
from sauna.experiments.study.units import study_identity
from sauna.system.errors import BadInput

RESULTS = Path(__file__).parents[3] / "results"
OWN = """
from sauna.experiments.measure import Measurement
from sauna.experiments.report.figures import Section

def compute(snapshot, scale, file):
    return {"norm": float((snapshot.params ** 2).sum()), "scale": scale is not None}

def report(measured, folder):
    points = [p for c in measured["cells"] for m in c["members"] for p in m["points"]]
    return Section("How large are the parameters?", [f"{len(points)} norms, all positive."])

NORM = Measurement("norm", "own_norm:compute", report, points=(0.5, 1.0))
NOTHING = 3
"""
STUDY = """
measure = "own_norm:NORM"
tasks = ["InvertedPendulum-v5"]
seeds = 1
steps = 1024
rollout_steps = 256
hidden = [8]
checkpoint_every = 1
keep_checkpoints = 10
[[arms]]
label = "ppo"
"""


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_record_has_its_name_and_rising_points(name: str) -> None:
    found = find_measurement(name)
    assert found.name == name and isinstance(found, Measurement)
    assert list(found.points) == sorted(found.points) and found.points[-1] == 1.0
    assert found.report({"cells": []}, None).title.endswith("?")


@pytest.mark.parametrize("former, name", FORMER_NAMES.items())
def test_studies_with_a_former_name_are_the_same_studies(former: str, name: str) -> None:
    spec = next(s for s in map(load_spec, ("threshold-sweep", "fig5")) if s.measure == name)
    old = read_spec({**spec.text, "measure": former})
    assert old.measure == name and study_identity(old) == study_identity(spec)


def test_a_study_with_a_former_name_goes_on_in_its_folder(tmp_path: Path) -> None:
    old, new = load_spec("dial"), load_spec("threshold-sweep")
    assert old.name == "dial" and study_identity(old) == study_identity(new)
    coverage = find_measurement("coverage")
    assert coverage.folder(tmp_path) == tmp_path / "coverage"
    (tmp_path / "dial").mkdir()
    assert coverage.folder(tmp_path) == tmp_path / "dial"


def test_stored_results_with_former_words_are_read() -> None:
    """The files of 0.1.0 say `coin` and `stills`."""
    noise, sweep, posture = (
        json.loads((RESULTS / f"{name}.json").read_text()) for name in ("noise", "dial", "fig5")
    )
    cell = noise["cells"][0]
    stored = cell["members"][0]["points"][0]["rules"]["standardized"]["groups"]["coin"]["snr"][0]
    assert stored > 0
    assert over_members(cell, "groups", "control", "snr").value is not None
    assert find_measurement("noise").report(noise, None).plots
    assert len(text_table(sweep)) == 1 + len(sweep["cells"])
    answers = find_measurement("posture").report(posture, None).answers
    assert answers[0].startswith("ppo: on its feet in ")


@pytest.mark.parametrize(
    "name, message",
    [
        ("own_norm:NONE", "has no 'NONE'"),
        ("own_norm:NOTHING", "is no sauna.experiments.measure.Measurement"),
        ("no_such_module_here:X", "cannot import"),
        (3, "measure must be one of"),
    ],
)
def test_what_is_no_measurement_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, message: str
) -> None:
    (tmp_path / "own_norm.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(BadInput, match=message):
        find_measurement(name)


def test_a_record_loads_no_jax() -> None:
    """The processes that train a study and write its report read it."""
    code = (
        "import sys; from sauna.experiments.measure.measurement import *; "
        "[find_measurement(name) for name in BUILT_IN]; sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.slow
def test_a_study_takes_a_measurement_of_the_users_own(tmp_path: Path) -> None:
    (tmp_path / "own_norm.py").write_text(OWN)
    (tmp_path / "mine.toml").write_text(STUDY)
    done = sauna("study", "mine.toml", "--processes", "1", "--trust", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    place = tmp_path / "runs" / "mine"
    assert "measuring norm: 1 members" in done.stdout
    assert "2 norms, all positive." in done.stdout
    stored = [json.loads(file.read_text()) for file in sorted((place / "norm").glob("*.json"))]
    assert [one["env_steps"] for one in stored] == [512, 1024]
    assert all(one["norm"] > 0 and not one["scale"] for one in stored)
    page = (place / "report.html").read_text()
    assert "<title>How large are the parameters?</title>" in page
