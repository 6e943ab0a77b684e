"""The threshold sweep: coverage where it is known, verdicts, and a study from its file."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import environment
from sauna.experiments.measure.coverage import particle_entropy
from sauna.experiments.measure.coverage_report import (
    correlation,
    marks,
    report,
    text_table,
    verdicts,
)
from sauna.experiments.measure.measurement import ALONG
from sauna.experiments.study.measuring import Item, gather_measured, items_of, scale_of
from sauna.experiments.study.results import gather
from sauna.experiments.study.spec import load_spec, read_spec
from sauna.experiments.study.units import units_of
from sauna.system.errors import BadInput


def test_coverage_is_the_entropy_of_what_is_known() -> None:
    random = np.random.default_rng(0)
    normal = random.normal(size=(3000, 3)) * [1.0, 2.0, 0.5]
    assert abs(particle_entropy(normal) - 1.5 * math.log(2 * math.pi * math.e)) < 0.1
    uniform = random.uniform(size=(3000, 2)) * [4.0, 2.0]
    assert abs(particle_entropy(uniform) - math.log(8.0)) < 0.1
    twice = particle_entropy(2 * normal) - particle_entropy(normal)
    assert twice == pytest.approx(3 * math.log(2))
    assert math.isfinite(particle_entropy(np.zeros((50, 2))))  # all in one place


def cell(label: str, values: list[float], **settings: Any) -> dict[str, Any]:
    """Members whose entropy and coverage are `values`, and their returns the negative."""
    config = {"threshold": 0.3, "threshold_schedule": "constant", "keep_rate_target": 0.0}
    own = {"task": "A-v0", "label": label, "arm": "sauna", "rates_of": None, "seeds": len(values)}
    own |= {key: settings.pop(key) for key in list(settings) if key in own}
    members = [
        {
            "seed": seed,
            "keep_rate": 0.5,
            "final_return": -x,
            "entropy": x,
            "threshold": 0.9,
            "points": [{"point": 1.0, "coverage": x}],
        }
        for seed, x in enumerate(values)
    ]
    return {**own, "config": {**config, **settings}, "members": members}


def study(*cells: dict[str, Any]) -> dict[str, Any]:
    return {"cells": list(cells)}


RISING = [cell(str(t), [t, t + 0.1, t - 0.1], threshold=t) for t in (0.0, 0.5, 1.0)]


def test_a_trade_is_found_where_there_is_one_and_only_there() -> None:
    assert "moves exploration against return" in verdicts(study(*RISING))[0]
    assert "entropy rises (rank correlation 0.9" in verdicts(study(*RISING))[0]
    random = np.random.default_rng(0)
    found = 0
    for _ in range(20):
        flat = [cell(str(t), random.normal(size=4).tolist(), threshold=t) for t in (0, 0.5, 1)]
        found += "no evidence that the threshold moves exploration" not in verdicts(study(*flat))[0]
    assert found <= 2
    assert "no answer yet" in verdicts(study(*RISING[:2]))[0]


@pytest.mark.parametrize(
    "settings",
    [{"arm": "random-drop", "rates_of": "0.5"}, {"arm": "sauna+random", "threshold": 0.5}],
)
def test_an_arm_is_compared_with_its_random_control_pair_by_pair(settings: dict[str, Any]) -> None:
    """Entropy and coverage of the controls lie 0.2 below, seed by seed; or not at all."""
    for gaps, said in (
        (
            [0.2, 0.2, 0.2],
            "differ in entropy and coverage and return (threshold minus control: "
            "entropy 0.20 [0.20, 0.20], coverage 0.20 [0.20, 0.20], return -0.20 [-0.20, -0.20]; "
            "3 pairs).",
        ),
        ([0.2, -0.3, 0.1], "show no difference (threshold minus control: entropy 0.0"),
    ):
        values = [x - gap for x, gap in zip([0.5, 0.6, 0.4], gaps, strict=True)]
        control = cell("control", values, **settings)
        found = verdicts(study(*RISING, control))
        assert len(found) == 2 and said in found[1], found[1]
        assert found[1].startswith("A-v0: threshold 0.5 and its matched random control ")
    few = cell("control", [0.1], **settings)
    assert "have too few pairs yet" in verdicts(study(*RISING, few))[1]
    assert "; 9 members." in verdicts(study(*RISING))[0]
    part = [*RISING[:2], {**RISING[2], "seeds": 4}]
    assert "; 9 members of 10 so far." in verdicts(study(*part))[0]
    untrained = cell("1.5", [], threshold=1.5) | {"seeds": 3}
    assert "; 9 members of 12 so far." in verdicts(study(*RISING, untrained))[0]
    assert text_table(study(*RISING, untrained))[-1][2] == "0 of 3"


def test_an_arms_numbers_are_of_the_same_members() -> None:
    """One that is trained and not measured yet counts in none of them."""
    part = cell("x", [0.1, 0.2, 9.0], threshold=0.2)
    part["members"][2]["points"] = []
    (mark,) = marks(study(part), "A-v0")
    assert {len(values) for values in mark.members.values()} == {2}


def test_the_p_value_is_that_of_all_deals() -> None:
    few = [cell(str(t), [float(t)], threshold=t) for t in (0.0, 1.0, 2.0, 3.0)]
    rho, p, number = correlation(marks(study(*few), "A-v0"), "entropy") or (0, 0, 0)
    assert (rho, number) == (pytest.approx(1.0), 4)
    assert p == pytest.approx(2 / math.factorial(4), abs=0.01)


def test_every_arm_stands_at_its_threshold() -> None:
    others = [
        cell("0 to 1", [0.5], threshold=1.0, threshold_schedule="rising"),
        cell("keeps half", [0.7], keep_rate_target=0.5),
        cell("control", [0.1], arm="random-drop", rates_of="0.5"),
        cell("moved control", [0.1], arm="random-drop", rates_of="0 to 1"),
        cell("control of 1", [0.1], arm="sauna+random", threshold=1.0),
        cell("control of half", [0.1], arm="sauna+random", keep_rate_target=0.5),
    ]
    found = {mark.label: mark for mark in marks(study(*RISING, *others), "A-v0")}
    assert {label: mark.threshold for label, mark in found.items()} == {
        "0.0": 0.0,
        "0.5": 0.5,
        "1.0": 1.0,
        "0 to 1": 0.9,
        "keeps half": 0.9,
        "control": 0.5,
        "moved control": 0.9,
        "control of 1": 1.0,
        "control of half": 0.9,
    }
    followed = [found[x].drops_like for x in ("control", "control of 1", "control of half")]
    assert followed == ["0.5", "1.0", "keeps half"]
    assert [found[x].kind for x in ("0 to 1", "keeps half")] == ["scheduled", "target keep rate"]
    page = report(study(*RISING, *others))
    assert [plot.name for plot in page.plots] == [
        "sweep_keep_rate",
        "sweep_entropy",
        "sweep_coverage",
        "sweep_final_return",
    ]
    assert len(page.plots[1].panels[0].lines) == 4
    assert len(text_table(study(*RISING, *others))) == 10


def test_what_is_the_same_for_all_follows_nothing() -> None:
    """And does not keep the other two from being found."""
    same = [cell(str(t), [t] * 4, threshold=t) for t in (0.0, 0.5, 1.0)]
    for one in same:
        for member in one["members"]:
            member["final_return"] = 1000.0
    found = verdicts(study(*same))[0]
    assert "moves exploration, with no evidence that return follows" in found


def test_the_scale_is_the_baselines_first_seed_or_none() -> None:
    spec = read_spec({"tasks": ["A-v0"], "seeds": [4, 2], "arms": [{"label": "sauna"}]})

    def item(seed: int) -> Item:
        return Item("A-v0", "sauna", "sauna", seed, Path("run"), [0.5, 1.0], [3, 7], [])

    assert scale_of(spec, [item(2), item(4)], "A-v0") == {
        "run": "run",
        "member": "sauna/4",
        "iteration": 7,
    }
    assert scale_of(spec, [item(2)], "A-v0") is None


def test_the_scale_needs_a_normaliser() -> None:
    spec = {
        "tasks": ["A-v0"],
        "arms": [{"label": "sauna"}],
        "measure": "coverage",
        "checkpoint_every": 10,
        "keep_checkpoints": 1000,
    }
    assert read_spec(spec).measure == "coverage"
    with pytest.raises(BadInput, match="normalize_observations: coverage"):
        read_spec({**spec, "normalize_observations": False})
    with pytest.raises(BadInput, match="needs 'sauna' on B-v0, too"):
        own = {"label": "x", "arm": "sauna", "tasks": ["B-v0"], "baseline": "x2"}
        other = {"label": "x2", "arm": "sauna", "tasks": ["B-v0"], "baseline": "x"}
        read_spec({**spec, "arms": [{"label": "sauna"}, own, other]})
    with pytest.raises(BadInput, match="not of random-drop"):
        read_spec(
            {**spec, "arms": [{"label": "sauna"}, {"label": "random-drop", "drop_rate": 0.1}]}
        )
    with pytest.raises(BadInput, match="not of ppo"):
        read_spec({**spec, "arms": [{"label": "sauna"}, {"label": "ppo"}]})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["noise", "threshold-sweep"])
def test_a_small_study_measures_once_and_shows_it(name: str, tmp_path: Path) -> None:
    """The built-in study, on a small task; run again it measures nothing again."""
    measure = str(load_spec(name).measure)
    text = {**load_spec(name).text, "name": "small", "tasks": ["InvertedPendulum-v5"]}
    if measure == "coverage":  # an arm of every kind
        kinds = ("0", "0.8", "1.5", "0 to 1", "keeps 1 in 2", "coin like 0.8")
        text["arms"] = [arm for arm in text["arms"] if arm["label"] in kinds]
    text |= {
        "seeds": 1,
        "steps": 8192,
        "rollout_steps": 512,
        "minibatches": 16,
        "hidden": [8, 8],
        "epochs": 2,
        "checkpoint_every": 1,
    }
    lines = []
    for key, value in text.items():
        if key != "arms":
            lines.append(f"{key} = {json.dumps(value)}")
    for arm in text["arms"]:
        lines += ["[[arms]]", *(f"{key} = {json.dumps(value)}" for key, value in arm.items())]
    (tmp_path / "small.toml").write_text("\n".join(lines))
    command = [sys.executable, "-m", "sauna", "study", "small.toml"]

    def run() -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment(), capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "measuring" in run()
    place = tmp_path / "runs" / "small"
    files = {path: path.stat().st_mtime_ns for path in (place / measure).glob("*.json")}
    assert "measuring" not in run()
    assert files == {path: path.stat().st_mtime_ns for path in files}
    measured = json.loads((place / f"{measure}.json").read_text())
    members = [member for cell in measured["cells"] for member in cell["members"]]
    number = [len(member["points"]) for member in members]  # a checkpoint serves one point only
    assert len(members) == len(text["arms"]) and sum(number) == len(files)
    assert set(number) <= {len(ALONG) - 1, len(ALONG)} and len(ALONG) in number
    page = (place / "report.html").read_text()
    assert (
        'id="measured"' in page and f'id="{"sweep" if measure == "coverage" else measure}_' in page
    )
    if measure == "coverage":
        targets = [c for c in measured["cells"] if c["config"]["keep_rate_target"]]
        for c in targets:
            for member in c["members"]:
                assert abs(member["keep_rate"] - c["config"]["keep_rate_target"]) < 0.05
    next(
        iter(files)
    ).unlink()  # as if interrupted there: the member's other points alone say nothing
    spec = load_spec(str(tmp_path / "small.toml"))
    units = units_of(spec, json.loads((place / "study.json").read_text())["seeds_per_unit"])
    folder = place.parent / "units"
    part = gather_measured(spec, units, folder, place, gather(spec, units, folder, "study"))
    left = [len(member["points"]) for cell in part["cells"] for member in cell["members"]]
    assert sum(map(bool, left)) == len(number) - 1
    assert "1 members" in run()
    items = items_of(spec, units, folder, place)
    assert all(item.is_done for item in items)
    changed = [(items[-1], 1)]  # another checkpoint of the same number is measured again
    if measure == "coverage":  # and with the one whose normaliser is the scale, everything is
        changed.append((items[0], len(items)))
    for item, lacking in changed:
        manifest = item.run / "checkpoints" / f"{item.iterations[-1]:08d}" / "manifest.json"
        manifest.write_text(manifest.read_text() + "\n")
        again = items_of(spec, units, folder, place)
        assert sum(not item.is_done for item in again) == lacking
