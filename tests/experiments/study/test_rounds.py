"""A sequential study: what is trained when, that it goes on where it was left, and its ranking."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import sauna, small_flags
from helpers import SMALL, environment
from sauna.api import compare
from sauna.config.arms import RULE_HELP
from sauna.config.presets import COMPARED
from sauna.experiments.sequential import DESIGN, capped, replay, tournament
from sauna.experiments.study.command import (
    chosen_arms,
    compare_command,
    comparison,
    write,
)
from sauna.experiments.study.rounds import first_look, next_round, round_units, stopped
from sauna.experiments.study.spec import Spec, read_spec
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.text import lines
from sauna.experiments.study.units import Unit, digest_of, study_identity
from sauna.system.errors import BadInput

# Returns by seed: the winner always wins, the loser always loses, and the twin is never decided.
RETURNS = {"ppo": 0.0, "gigaflow": 100.0, "gigaflow+random": -0.5, "spo": -100.0, "espo": 0.5}


def spec_of(*rules: str, **settings: Any) -> Spec:
    arms, is_tournament = chosen_arms(("all",) if not rules else COMPARED, rules, True, settings)
    return comparison("A-v0", arms, settings, is_tournament)


QUICK = {key: value for key, value in SMALL.items() if key not in ("seeds", "steps")}


def returns(label: str, seed: int) -> float:
    spread = (seed * 7) % 16 + 0.25 * (label == "espo")
    return RETURNS[label] + spread


def train(unit: Unit, folder: Path) -> None:
    """Writes what a run of the unit would leave."""
    run = unit.run(folder)
    run.mkdir(parents=True)
    rows, timings = [], []
    for iteration in range(3):
        names = [f"{unit.label}/{seed}" for seed in unit.seeds]
        timings.append({"iteration": iteration, "update_cpu_seconds": dict.fromkeys(names, 2.0)})
        for seed, name in zip(unit.seeds, names, strict=True):
            final = returns(unit.label, seed) + 200.0
            rows.append(
                {
                    "member": name,
                    "arm": unit.label,
                    "seed": seed,
                    "iteration": iteration,
                    "env_steps": 100 * (iteration + 1),
                    "kept_steps": 100 * (iteration + 1),
                    "return_mean": final * (iteration + 1) / 3,
                    "samples_backward": 50.0 if "gigaflow" in unit.label else 100.0,
                }
            )
    for name, found in (("metrics", rows), ("timing", timings)):
        (run / f"{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in found))
    (run / "summary.json").write_text(json.dumps({"complete": True}))


def fail(unit: Unit, folder: Path) -> None:
    (folder / unit.name).mkdir(parents=True)
    (folder / unit.name / "failed.json").write_text(json.dumps({"error": "NaN"}))


def play(spec: Spec, folder: Path) -> list[set[str]]:
    """Trains look by look; the labels of each look."""
    looks = []
    while (found := next_round(spec, 3, folder)).waiting is not None:
        looks.append({arm.label for arm in found.waiting.arms})
        for unit in round_units(found):
            if not unit.is_complete(folder):
                train(unit, folder)
    return looks


def seeds_of(folder: Path, label: str) -> set[int]:
    stored = [json.loads(line) for p in folder.rglob("metrics.jsonl") for line in p.open()]
    return {row["seed"] for row in stored if row["member"].rpartition("/")[0] == label}


def test_seeds_are_added_only_where_something_is_open(tmp_path: Path) -> None:
    spec = spec_of("gigaflow", "spo", "espo")
    looks = play(spec, tmp_path)
    assert looks[0] == set(RETURNS)
    assert looks[1] == set(RETURNS) - {"spo"}  # it stopped with 3 seeds
    # Of three arms none can be better with 6 seeds: 3 * 2 / 924 is above that look's 0.005.
    assert looks[2] == looks[1]
    assert looks[3] == {"ppo", "espo"}  # gigaflow was better with 10, and its control stops with it
    assert len(seeds_of(tmp_path, "spo")) == 3
    assert len(seeds_of(tmp_path, "gigaflow")) == len(seeds_of(tmp_path, "gigaflow+random")) == 10
    # The oracle: the whole design on scores that are all there.
    draw = {a: np.array([returns(a, s) for s in range(16)]) for a in RETURNS if "+" not in a}
    standings = next_round(spec, 3, tmp_path).replays["A-v0"].standings
    assert standings == tournament(draw, "ppo")
    assert len(seeds_of(tmp_path, "ppo")) == max(s.seeds for s in standings.values())


def test_a_study_goes_on_where_it_was_left(tmp_path: Path) -> None:
    spec = spec_of("gigaflow", "spo")
    first = next_round(spec, 3, tmp_path)
    train(first.units[0], tmp_path)
    again = next_round(spec, 3, tmp_path)
    assert again.look == first.look == 0 and again.units == first.units
    play(spec, tmp_path)
    runs = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert play(spec, tmp_path) == []
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == runs


def test_fewer_seeds_at_first_and_more_later_share_their_runs(tmp_path: Path) -> None:
    play(spec_of("espo", seeds=6), tmp_path)
    before = set(tmp_path.iterdir())
    assert len(seeds_of(tmp_path, "espo")) == 6
    play(spec_of("espo"), tmp_path)
    assert before < set(tmp_path.iterdir()) and len(seeds_of(tmp_path, "espo")) > 6


def test_a_unit_never_reaches_beyond_a_look(tmp_path: Path) -> None:
    spec = spec_of("espo")
    play(spec, tmp_path)
    ends = {unit.seeds[-1] + 1 for unit in next_round(spec, 3, tmp_path).units}
    assert {look.seeds for look in DESIGN} & set(range(11)) <= ends


def test_a_failed_seed_is_the_worst_outcome(tmp_path: Path) -> None:
    spec = spec_of("gigaflow")
    for unit in next_round(spec, 1, tmp_path).units:
        (fail if unit.label == "gigaflow" else train)(unit, tmp_path)
    found = next_round(spec, 1, tmp_path)
    assert found.replays["A-v0"].standings["gigaflow"].probability == 0.0
    assert found.waiting is None


def test_what_the_looks_have_stopped_is_said_once(tmp_path: Path) -> None:
    spec = spec_of("gigaflow", "spo")
    before = next_round(spec, 3, tmp_path)
    for unit in before.units:
        train(unit, tmp_path)
    after = next_round(spec, 3, tmp_path)
    (text,) = stopped(before.replays, after.replays)
    assert text.startswith("spo on A-v0: stopped with 3 seeds: probability of improvement 0.00")
    assert list(stopped(after.replays, after.replays)) == []


def test_the_summary_ranks_the_arms_and_says_who_stopped_why(tmp_path: Path) -> None:
    spec = spec_of("spo", "gigaflow", "espo")
    folder, place = tmp_path / "units", tmp_path / spec.name
    place.mkdir()
    play(spec, folder)
    summary = write(spec, next_round(spec, 3, folder).units, folder, place, "sauna compare")
    rows = summary["ranking"]
    assert [(r["rank"], r["label"], r["verdict"]) for r in rows] == [
        (1, "gigaflow", "better"),
        (2, "espo", "not decided"),
        (3, "spo", "not decided"),
    ]
    assert rows[0]["seeds"] == 10 and rows[0]["control"]["verdict"] == "better"
    assert rows[2]["seeds"] == 3 and "below 0.25" in rows[2]["reason"]
    assert summary == summarize(json.loads((place / "results.json").read_text()))
    assert [v["against"] for v in summary["filtering"]] == ["gigaflow+random"]
    text = "\n".join(lines(summary))
    assert "stopped when, why" in text and "at most 5%" in text
    page = (place / "report.html").read_text()
    assert '<section id="ranking">' in page and "Learning curves by samples learned from" in page


def test_a_stopped_tournament_says_what_is_open(tmp_path: Path) -> None:
    spec = spec_of("gigaflow", "spo")
    folder, place = tmp_path / "units", tmp_path / spec.name
    place.mkdir()
    for unit in next_round(spec, 3, folder).units[:2]:  # of ppo and gigaflow, not of its control
        train(unit, folder)
    summary = write(spec, next_round(spec, 3, folder).units, folder, place, "sauna compare")
    assert {(row["seeds"], row["verdict"]) for row in summary["ranking"]} == {(0, "open")}
    assert "its first seeds have not ended" in "\n".join(lines(summary))
    assert "still open: gigaflow and spo" in (place / "report.html").read_text().lower()


def test_compute_is_carried_from_the_runs_to_the_verdict(tmp_path: Path) -> None:
    """Gigaflow takes half of ppo's samples in each iteration and ends 100 above it: at 300 and
    its first third of 207.5 is passed on the way."""
    spec = spec_of("gigaflow", seeds=3)
    folder, place = tmp_path / "units", tmp_path / spec.name
    place.mkdir()
    play(spec, folder)
    summary = write(spec, next_round(spec, 3, folder).units, folder, place, "sauna compare")
    row = {row["label"]: row for row in summary["table"]}
    assert row["gigaflow"]["samples_backward"] == 150.0
    assert row["ppo"]["samples_backward"] == 300.0
    cells = json.loads((place / "results.json").read_text())["cells"]
    member = {cell["label"]: cell["members"][0] for cell in cells}["ppo"]
    assert (member["samples_backward"], member["learner_cpu_seconds"]) == (300.0, 6.0)
    assert member["curve"]["samples_backward"] == [100.0, 200.0, 300.0]
    assert member["curve"]["learner_cpu_seconds"] == [2.0, 4.0, 6.0]
    found = {v["label"]: v for v in summary["equal_compute"]}
    # Both means rise in a straight line: from a third to all of 207 (ppo) and of 307 (gigaflow).
    mean = 200 + np.mean([(seed * 7) % 16 for seed in range(3)])
    at = 150 * mean / (mean + 100)
    ratio = found["gigaflow"]["ratios"]["samples_backward"][0]
    assert ratio == pytest.approx(at / 300, rel=1e-4)
    assert f"in samples {ratio:.2f}" in found["gigaflow"]["text"]
    assert set(summary["by_compute"]["A-v0"]) == {"samples_backward", "learner_cpu_seconds"}


def test_results_without_compute_still_load(tmp_path: Path) -> None:
    spec = spec_of("gigaflow", seeds=3)
    folder, place = tmp_path / "units", tmp_path / spec.name
    place.mkdir()
    play(spec, folder)
    write(spec, next_round(spec, 3, folder).units, folder, place, "sauna compare")
    results = json.loads((place / "results.json").read_text())
    for cell in results["cells"]:
        for member in cell["members"]:
            for name in ("samples_backward", "learner_cpu_seconds"):
                del member[name], member["curve"][name]
    summary = summarize(results)
    assert summary["equal_compute"] == [] and summary["by_compute"] == {"A-v0": {}}


def test_the_last_look_spends_what_is_left_of_the_level() -> None:
    assert [look.seeds for look in capped(8)] == [3, 6, 8]
    assert sum(look.level for look in capped(8)) == pytest.approx(0.05)
    assert capped(16) == DESIGN and len(capped(2)) == 1
    with pytest.raises(ValueError, match="at most 16 seeds, not 17"):
        capped(17)


def test_a_control_stops_with_its_rule_and_takes_nothing_from_the_rules() -> None:
    """With or without a control, the rule's own p value is the same."""
    scores = {"ppo": np.arange(6.0), "a": np.arange(6.0) + 100, "a+random": np.arange(6.0)}
    design = capped(6)
    found = replay(scores, "ppo", design, {"a": "a+random"})
    alone = replay({k: scores[k] for k in ("ppo", "a")}, "ppo", design)
    assert found.standings == alone.standings and list(found.standings) == ["a"]
    assert found.beside_control["a"].verdict == "better" and alone.beside_control == {}
    waiting = replay({**scores, "a+random": np.arange(2.0)}, "ppo", design, {"a": "a+random"})
    assert waiting.look == 0 and waiting.running == ["a"]


def test_above_the_share_of_failed_seeds_nothing_is_better() -> None:
    worst = np.full(2, -np.inf)
    scores = {"ppo": np.concatenate([worst, np.arange(4.0)]), "a": np.arange(6.0) + 100}
    found = replay(scores, "ppo", capped(6)).standings["a"]
    assert found.verdict == "not decided" and "33% of the seeds of one side failed" in found.reason


@pytest.mark.parametrize(
    "change, message",
    [
        ({"design": "adaptive"}, "design must be fixed or sequential"),
        ({"seeds": 17}, "seeds: a tournament takes at most 16 seeds"),
        ({"arms": [{"label": "ppo"}, {"label": "spo", "seeds": 3}]}, "the same seeds and baseline"),
        ({"measure": "noise"}, "measure needs a fixed design"),
    ],
)
def test_mistakes_in_a_sequential_study_are_named(change: dict[str, Any], message: str) -> None:
    arms = [{"label": "ppo"}, {"label": "spo"}]
    with pytest.raises(BadInput, match=message):
        read_spec({"tasks": ["A-v0"], "seeds": 6, "arms": arms, "design": "sequential", **change})


def test_a_tournament_and_a_fixed_design_of_the_same_arms_are_two_studies() -> None:
    fixed = comparison("A-v0", ("ppo", "spo"), {"seeds": 16})
    looks = comparison("A-v0", ("ppo", "spo"), {}, sequential=True)
    assert digest_of(study_identity(fixed)) != digest_of(study_identity(looks))
    assert first_look(fixed) == fixed and first_look(looks).arms[0].seeds == (0, 1, 2)


def test_arms_and_rules_on_the_command_line() -> None:
    arms, is_tournament = chosen_arms(("all",), (), True, {})
    assert is_tournament and arms[0] == "ppo" and {"gigaflow", "gigaflow+random", "spo"} < {*arms}
    assert chosen_arms(COMPARED, ("spo",), True, {}) == (("ppo", "spo"), True)
    assert chosen_arms(("ppo", "pods"), (), True, {}) == (("ppo", "pods", "pods+random"), False)
    assert chosen_arms(("ppo", "pods"), (), False, {}) == (("ppo", "pods"), False)
    with pytest.raises(BadInput, match="give --rules or --arms, not both"):
        chosen_arms(("ppo", "pods"), ("spo",), True, {})
    command = compare_command("A-v0", COMPARED, {}, "runs", ("spo", "espo"), False)
    assert command == "sauna compare A-v0 --rules spo,espo --no-controls"


@pytest.mark.slow
def test_a_tournament_is_trained_and_run_again_trains_nothing(tmp_path: Path) -> None:
    settings = {"seeds": 4, "steps": 128, **QUICK}
    out, rules = tmp_path / "runs", ("gigaflow",)
    summary = compare("CartPole-v1", rules=rules, out=out, quiet=True, **settings)
    assert [row["label"] for row in summary["table"]] == ["ppo", "gigaflow", "gigaflow+random"]
    (row,) = summary["ranking"]
    assert row["verdict"] in ("not decided", "better", "worse")
    assert {row["seeds"] for row in summary["table"]} == {row["seeds"]} <= {3, 4}
    before = {path: path.stat().st_mtime_ns for path in (out / "units").rglob("metrics.jsonl")}
    assert compare("CartPole-v1", rules=rules, out=out, quiet=True, **settings) == summary
    assert before == {p: p.stat().st_mtime_ns for p in (out / "units").rglob("metrics.jsonl")}


@pytest.mark.slow
def test_a_tournament_of_all_rules_goes_on_after_a_signal_to_the_same_result(
    tmp_path: Path,
) -> None:
    """Of three seeds each; the signal comes once the first unit is complete."""
    flags = ["--arms", "all", "--processes=2", *small_flags(seeds=3)]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    command = ["compare", "small_envs:Scripted", *flags, "--out"]
    done = sauna(*command, str(whole))
    assert done.returncode == 0, done.stderr
    started = subprocess.Popen(
        [sys.executable, "-m", "sauna", *command, str(cut)],
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 300
    while not list((cut / "units").glob("*/summary.json")):
        assert started.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    started.send_signal(signal.SIGTERM)
    assert started.wait(120) == 143
    expected, before = rows_of(whole), rows_of(cut)
    assert 0 < sum(before.get(name) == rows for name, rows in expected.items()) < len(expected)
    done = sauna(*command, str(cut))
    assert done.returncode == 0, done.stderr
    assert rows_of(cut) == expected and len(expected) >= len(RULE_HELP) + 1
    one, other = (
        json.loads(next(out.glob("compare_*/summary.json")).read_text()) for out in (whole, cut)
    )
    for part in ("ranking", "table", "verdicts"):
        assert one[part] == other[part], part


def rows_of(out: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted((out / "units").rglob("metrics.jsonl"))
    }
