"""What a study's results support, in numbers and in words that claim no more."""

from __future__ import annotations

import copy
import json
import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from sauna.experiments import statistics as s
from sauna.experiments.report.figures import plots_of
from sauna.experiments.study.report import make_page
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.text import lines
from sauna.system.errors import BadInput

STEPS = [1000, 2000, 3000]
LOW = [1300.0, 1310.0, 1325.0, 1290.0, 1301.0, 1333.0]
HIGH = [1800.0, 1810.0, 1825.0, 1790.0, 1801.0, 1833.0]
ALIKE = [1302.0, 1311.0, 1322.0, 1288.0, 1304.0, 1330.0]
ROW = {
    "task",
    "label",
    "baseline",
    "seeds",
    "failed",
    "running",
    "final_iqm",
    "auc_iqm",
    "final_mean",
    "final_std",
    "keep_rate",
    "sampler",
    "sample_rate",
    "env_steps",
    "fewest_episodes",
    "kept_steps",
    "samples_backward",
    "improvement",
}


def member(seed: int, final: float | None, **changes: Any) -> dict[str, Any]:
    keep_rate = changes.get("keep_rate", 1.0)
    half = None if final is None else final / 2
    found = {
        "seed": seed,
        "status": "complete",
        "error": None,
        "final_return": final,
        "auc": half,
        "env_steps": 3000,
        "kept_steps": int(3000 * keep_rate),
        "keep_rate": keep_rate,
        "episodes": 9,
        "explained_variance": 0.5,
        "curve": {
            "env_steps": list(STEPS),
            "return_mean": [None, half, final],
            "keep_rate": [keep_rate] * 3,
            "vex_mean": [None] * 3,
            "vex_spread": [None] * 3,
            "vex_median": [None] * 3,
            "explained_variance": [0.1, 0.9, 1.0],
            "entropy": [1, 1, 1],
        },
    }
    return {**found, **changes}


def cell(
    label: str, finals: list[Any], task: str = "Cheetah", arm: str = "", **changes: Any
) -> dict[str, Any]:
    members = [member(seed, final, **changes) for seed, final in enumerate(finals)]
    return {
        "task": task,
        "label": label,
        "arm": arm or label,
        "preset": "mujoco",
        "config": {},
        "command": "",
        "members": members,
    }


def results(*cells: dict[str, Any]) -> dict[str, Any]:
    about = {"name": "", "command": "", "metric": "", "settings": {}, "versions": {}, "machine": {}}
    return {"format": 1, "baseline": "ppo", "git": None, **about, "cells": list(cells)}


def verdict(*cells: dict[str, Any]) -> dict[str, str]:
    return summarize(results(*cells))["verdicts"][0]


def test_better_worse_and_no_evidence() -> None:
    better = verdict(cell("ppo", LOW), cell("sauna", HIGH, keep_rate=0.7))
    assert better["kind"] == "better"
    assert better["text"] == (
        "sauna: better than ppo on Cheetah (probability of improvement 1.00 [0.67, 1.00], "
        "exact p = 0.002, 6 against 6 seeds)."
    )
    worse = verdict(cell("ppo", HIGH), cell("sauna", LOW, keep_rate=0.7))
    assert (worse["kind"], worse["text"][:29]) == ("worse", "sauna: worse than ppo on Chee")
    alike = verdict(cell("ppo", LOW), cell("sauna", ALIKE, keep_rate=0.7))
    assert alike["kind"] == "no evidence"
    assert alike["text"].startswith("sauna: not decided against ppo on Cheetah (p")
    assert alike["needed"] == "more than 1000" and worse["needed"] is better["needed"] is None


def test_seeds_that_would_decide_are_said_once() -> None:
    summary = summarize(results(cell("ppo", LOW), cell("sauna", ALIKE), cell("espo", ALIKE)))
    said = [line for line in lines(summary) if "would decide" in line]
    assert len(said) == 1 and "sauna against ppo more than 1000, espo against ppo" in said[0]
    decided = summarize(results(cell("ppo", LOW), cell("sauna", HIGH)))
    assert not [line for line in lines(decided) if "would decide" in line]


def test_a_final_return_of_few_episodes_is_named() -> None:
    def said(*of_sauna: int) -> list[str]:
        both = cell("ppo", LOW), cell("sauna", HIGH)
        for member in both[0]["members"] + both[1]["members"]:
            member["episodes"] = 100
        for member, number in zip(both[1]["members"], of_sauna, strict=False):
            member["episodes"] = number
        return [line for line in lines(summarize(results(*both))) if "episodes" in line]

    (note,) = said(300, 7, 40)
    assert "fewer than 100 episodes (sauna 7): its final return is the mean of all" in note
    assert said(100, 300) == []


def test_what_a_sampler_leaves_out_is_shown() -> None:
    top = cell("top-advantage", HIGH, sample_rate=0.5)
    top["config"] = {"sampler": "top-advantage"}
    for of_seed in top["members"]:
        of_seed["curve"]["sample_rate"] = [0.5] * 3
    plain = results(cell("ppo", LOW, sample_rate=1.0))
    sampled = results(cell("ppo", LOW, sample_rate=1.0), top)
    head, ppo, rule = lines(summarize(sampled))[:3]
    assert "keep rate  samples used" in head and "1.000      0.500" in rule
    assert "1.000      1.000" in ppo
    assert "samples used" not in lines(summarize(plain))[0]
    page = make_page(sampled, summarize(sampled))
    assert page.count("Samples used</th>") == 3 and "0.500" in page  # also of the seeds
    assert make_page(plain, summarize(plain)).count("Samples used</th>") == 1
    drawn = _drawn(sampled)
    assert drawn["keep_rate"] == ["ppo", "top-advantage"]
    assert drawn["samples_used"] == ["top-advantage"]


def test_seeds_that_were_stopped_early_are_counted() -> None:
    stopped = cell("sauna", HIGH)
    for of_seed in stopped["members"][:2]:
        of_seed["stopped_early"] = "stop_at"
    found = results(cell("ppo", LOW), stopped)
    summary = summarize(found)
    _, ppo, sauna = lines(summary)[:3]
    assert "6 (2 stopped early)" in sauna and "stopped early" not in ppo
    page = make_page(found, summary)
    assert page.count("2 stopped early") == page.count("stopped early") == 1


def _drawn(found: dict[str, Any]) -> dict[str, list[str]]:
    """The labels in the first panel of each figure."""
    plots = plots_of(found, summarize(found))
    return {plot.name: [line.label for line in plot.panels[0].lines] for plot in plots}


def test_a_head_that_is_not_trained_is_not_drawn() -> None:
    ppo, head = cell("ppo", LOW), cell("vex-head", HIGH)
    for one, weight in ((ppo, 0.0), (head, 0.5)):
        one["config"] = {"vex_coef": weight}
        for of_seed in one["members"]:
            of_seed["curve"]["vex_mean"] = [0.1, 0.2, 0.3]
    found = results(ppo, head)
    assert _drawn(found)["vex"] == ["vex-head"]


def test_no_difference_at_all_names_no_number_of_seeds() -> None:
    text = verdict(cell("ppo", LOW), cell("sauna", LOW, keep_rate=0.7))["text"]
    assert "probability of improvement 0.50 [0.21, 0.79]" in text and "needed" not in text


def test_too_few_seeds_says_how_many() -> None:
    found = verdict(cell("ppo", LOW[:3]), cell("sauna", HIGH[:3], keep_rate=0.7))
    assert found["kind"] == "underpowered"
    assert found["text"] == (
        "sauna: too few seeds to decide against ppo on Cheetah: 3 and 3 seeds have ended; at "
        "least 4 of each are needed."
    )
    one = verdict(cell("ppo", LOW), cell("sauna", HIGH[:1], keep_rate=0.7))["text"]
    assert "1 and 6 seeds have ended; at least 4 of each are needed." in one


def test_nothing_to_compare_with() -> None:
    for cells in [[cell("sauna", HIGH)], [cell("ppo", []), cell("sauna", HIGH)]]:
        summary = summarize(results(*cells))
        assert summary["verdicts"][0]["kind"] == "underpowered"
        assert "6 and 0 seeds have ended; at least 4 of each" in summary["verdicts"][0]["text"]
        assert summary["table"][-1]["improvement"] == [None, None, None]
    assert summarize(results(cell("ppo", LOW)))["verdicts"] == []
    assert summarize(results())["table"] == []


@pytest.mark.parametrize(
    ("arm", "keep_rate", "said"),
    [
        ("sauna", 1.0, "It dropped none of its steps, so no difference can be credited"),
        ("sauna", 0.9957, "It dropped 0.43% of its steps, so no difference can be credited"),
        ("random-drop", 0.99, "It dropped 1% of its steps"),
        ("sauna", 0.98, ""),
        ("vex-head", 1.0, ""),
        ("ppo", 1.0, ""),
    ],
)
def test_no_credit_where_nothing_was_filtered(arm: str, keep_rate: float, said: str) -> None:
    arms = cell("ppo", LOW), cell("x 0.1", HIGH, arm=arm, keep_rate=keep_rate)
    text = verdict(*arms)["text"]
    assert said in text
    assert ("credited" in text) == bool(said)


def test_more_env_steps_are_mentioned() -> None:
    text = verdict(cell("ppo", LOW), cell("sauna", HIGH, keep_rate=0.5, env_steps=6000))["text"]
    assert "It took 2.00 times the env steps of ppo." in text
    text = verdict(cell("ppo", LOW), cell("sauna", HIGH, keep_rate=0.5, env_steps=3010))["text"]
    assert "env steps" not in text


def test_a_mean_that_goes_the_other_way_is_mentioned() -> None:
    arms = cell("ppo", [*LOW, 99999.0]), cell("sauna", HIGH, keep_rate=0.5)
    found = verdict(*arms)
    assert found["kind"] == "better"
    assert "Its mean final return is lower all the same." in found["text"]


def test_members_that_still_train_never_count() -> None:
    arm = cell("sauna", HIGH, keep_rate=0.7)
    for seed, status in enumerate(["running", "waiting"], start=6):
        extra = member(seed, 9e9, status=status)
        extra["curve"]["env_steps"] = [1, 2, 3]
        arm["members"].append(extra)
    with_them = summarize(results(cell("ppo", LOW), arm))
    without = summarize(results(cell("ppo", LOW), cell("sauna", HIGH, keep_rate=0.7)))
    row = with_them["table"][1]
    assert (row["seeds"], row["failed"], row["running"]) == (6, 0, 1)
    assert {**row, "running": 0} == without["table"][1]
    assert with_them["curves"] == without["curves"]
    assert with_them["profiles"] == without["profiles"]
    text = with_them["verdicts"][0]["text"]
    assert text.startswith(without["verdicts"][0]["text"])
    assert "Not finished yet: 2 of sauna;" in text


def failing(values: list[float], failed: int) -> dict[str, Any]:
    """An arm of complete members and, behind them, of failed ones with a return of no meaning."""
    arm = cell("sauna", values, keep_rate=0.7)
    arm["members"] += [member(len(values) + i, 9e9, status="failed") for i in range(failed)]
    return arm


def test_a_failed_seed_is_the_worst_outcome_of_the_test() -> None:
    """As if it had ended below every other seed; numbers of the complete ones stay theirs."""
    with_it = summarize(results(cell("ppo", LOW), failing(HIGH, 2)))
    lowest = summarize(results(cell("ppo", LOW), cell("sauna", [*HIGH, -9e9, -9e9], keep_rate=0.7)))
    found, expected = with_it["verdicts"][0], lowest["verdicts"][0]
    assert found["chance"] == expected["chance"] == 6 / 8
    assert found["text"].startswith(expected["text"]) and "8 against 6 seeds" in found["text"]
    assert found["text"].endswith("Failed seeds count as the worst outcome: 2 of sauna.")
    without = summarize(results(cell("ppo", LOW), failing(HIGH, 0)))
    assert with_it["table"][1]["final_iqm"] == without["table"][1]["final_iqm"]
    assert with_it["table"][1]["failed"] == 2
    assert with_it["curves"] == without["curves"]
    assert with_it["profiles"]["Cheetah"]["sauna"]["share"][0] == 6 / 8
    json.dumps(with_it, allow_nan=False)


@pytest.mark.parametrize("failed, kind", [(2, "better"), (3, "too many failed")])
def test_above_a_quarter_of_failed_seeds_there_is_no_verdict(failed: int, kind: str) -> None:
    """Of 11 seeds that end far above the baseline where they end at all."""
    high = [2000.0 + i for i in range(11 - failed)]
    found = verdict(cell("ppo", [1000.0 + i for i in range(11)]), failing(high, failed))
    assert found["kind"] == kind
    said = "too many seeds failed (3 of 11 of sauna; at most 25% may fail)"
    assert (said in found["text"]) == (failed == 3)


def test_a_baseline_that_failed_gives_no_verdict_either() -> None:
    base = {**failing(LOW, 3), "label": "ppo", "arm": "ppo"}
    assert verdict(base, cell("sauna", HIGH, keep_rate=0.7))["kind"] == "too many failed"


def test_results_of_before_hold_the_auc_as_area() -> None:
    new = results(cell("ppo", LOW), cell("sauna", HIGH))
    old = copy.deepcopy(new)
    for one in (m for c in old["cells"] for m in c["members"]):
        one["area"] = one.pop("auc")
    assert summarize(old) == summarize(new)
    assert summarize(new)["table"][0]["auc_iqm"][0] is not None


def test_complete_seeds_without_a_return_are_left_out_and_said_so() -> None:
    arm = cell("sauna", [*HIGH, None, float("nan")], keep_rate=0.7)
    summary = summarize(results(cell("ppo", LOW), arm))
    assert summary["table"][1]["seeds"] == 8
    text = summary["verdicts"][0]["text"]
    assert "6 against 6 seeds" in text
    assert "Complete seeds without a final return are left out: 2 of sauna." in text
    json.dumps(summary, allow_nan=False)


def test_several_arms_are_corrected_together() -> None:
    x = [1302.0, 1326.0, 1335.0, 1336.0, 1337.0, 1338.0]
    alone = verdict(cell("ppo", LOW), cell("a", x, arm="sauna", keep_rate=0.7))
    assert alone["kind"] == "better" and "Holm" not in alone["text"]
    both = verdict(
        cell("ppo", LOW),
        cell("a", x, arm="sauna", keep_rate=0.7),
        cell("b", ALIKE, arm="sauna", keep_rate=0.7),
    )
    assert both["kind"] == "no evidence"
    assert "after Holm's correction for 2 arms" in both["text"]
    assert "The interval leaves out 0.5, but the test, which decides, does not." in both["text"]


@pytest.mark.parametrize(
    "arm, more", [("random-drop", {"rates_of": "sauna"}), ("sauna+random", {})]
)
def test_a_filter_is_compared_with_its_head_only_ablation_and_its_random_control(arm, more) -> None:
    """All three beat the baseline; what the head does without it is no merit of the filter."""
    control = {**cell("control", ALIKE, arm=arm, keep_rate=0.7), **more}
    other = {
        **cell("other control", LOW, arm="random-drop", keep_rate=0.7),
        "rates_of": "elsewhere",
    }
    arms = [
        cell("ppo", [0.0] * 6),
        cell("vex-head", LOW),
        other,
        control,
        cell("sauna", HIGH, keep_rate=0.7),
    ]
    found = summarize(results(*arms))
    assert [v["kind"] for v in found["verdicts"]] == ["better"] * 4
    found_of = {v["against"]: v for v in found["filtering"]}
    assert set(found_of) == {"vex-head", "control"}
    assert "head-only" in found["about_filtering"] and "control" in found["about_filtering"]
    without_head = summarize(results(*arms[:1], *arms[2:]))["about_filtering"]
    assert "head" not in without_head and "control" in without_head
    assert summarize(results(*arms[:1]))["about_filtering"] == ""
    assert [(v["label"], v["kind"]) for v in found_of.values()] == [("sauna", "better")] * 2
    assert "sauna: better than control on Cheetah" in found_of["control"]["text"]
    assert (
        "exact p = 0.004 after Holm's correction for 2 comparisons" in found_of["control"]["text"]
    )
    arms[-1] = cell("sauna", ALIKE, keep_rate=0.7)
    found = summarize(results(*arms))
    assert found["verdicts"][-1]["kind"] == "better"
    assert {v["kind"] for v in found["filtering"]} == {"no evidence"}
    assert summarize(results(*arms[:2]))["filtering"] == []
    paper = cell("sauna-paper", HIGH, keep_rate=0.7)  # its head learns another target
    assert summarize(results(*arms[:2], paper))["filtering"] == []
    own = [
        {**arms[1], "config": {"gamma": 0.9, "threshold": 0.3}},
        {**cell("sauna", HIGH, keep_rate=0.7), "config": {"gamma": 0.9, "threshold": 0.8}},
    ]
    assert len(summarize(results(arms[0], *own))["filtering"]) == 1
    own[1]["config"]["gamma"] = 0.99
    assert summarize(results(arms[0], *own))["filtering"] == []
    ruled = {**cell("sauna", HIGH, keep_rate=0.7), "baseline": "ppo, other rules"}
    assert summarize(results(*arms[:2], ruled))["filtering"] == []  # another head, of other rules


@pytest.mark.parametrize("stored", ["config", "command"])
def test_a_control_is_that_of_the_arm_with_its_settings(stored: str) -> None:
    """Of two thresholds with one control each; the control of 0.3 is of neither."""

    def arm(label: str, name: str, threshold: float) -> dict[str, Any]:
        config = {"threshold": threshold, "gamma": 0.9, "filter": "sauna", "arm": [name]}
        config["control"] = "random" if "+" in name else "none"
        command = f"sauna train X --threshold {threshold} --arm {name} --seeds 0,1"
        own = {"config": config} if stored == "config" else {"command": command}
        return {**cell(label, HIGH, arm=name, keep_rate=0.7), **own}

    arms = [arm(f"{value}", "sauna", value) for value in (0.8, 1.0)]
    controls = [arm(f"{value} random", "sauna+random", value) for value in (1.0, 0.8, 0.3)]
    head = {**cell("vex-head", LOW), "config": {"gamma": 0.9} if stored == "config" else {}}
    found = summarize(results(cell("ppo", LOW), *controls, *arms))["filtering"]
    assert [(v["label"], v["against"]) for v in found] == [
        ("0.8", "0.8 random"),
        ("1.0", "1.0 random"),
    ]
    found = summarize(results(cell("ppo", LOW), head, *controls))["filtering"]
    assert found == []  # a control is not credited with a rule


def test_a_baseline_that_filtered_nothing_is_named() -> None:
    stored = {**results(cell("sauna", LOW, keep_rate=1.0), cell("ppo", HIGH)), "baseline": "sauna"}
    text = summarize(stored)["verdicts"][0]["text"]
    assert "sauna dropped none of its steps, so no difference can be credited" in text
    filtered = cell("more", HIGH, arm="sauna", keep_rate=0.6)
    stored = {**results(cell("none", LOW, arm="sauna"), filtered), "baseline": "none"}
    assert "credited" not in summarize(stored)["verdicts"][0]["text"]  # it is the filter, or may be


def test_words_and_intervals_agree_on_random_studies() -> None:
    """No interval that holds 0.5, as printed, stands beside `better` or `worse`."""
    random = np.random.default_rng(0)
    kinds = set()
    for trial in range(120):
        n = random.integers(3, 9)
        cells = [
            cell(label, random.normal(shift, 1, n).tolist(), keep_rate=0.7)
            for label, shift in [("ppo", 0), ("sauna", random.normal(0, 2)), ("sauna-paper", 0)]
        ]
        for found in summarize(results(*cells[: 2 + trial % 2]))["verdicts"]:
            kinds.add(found["kind"])
            interval = re.search(r"\[([\d.]+), ([\d.]+)\], exact p (= ([\d.]+)|<)", found["text"])
            assert (interval is None) == (found["kind"] == "underpowered")
            if interval and found["kind"] != "no evidence":
                low, high, p = (float(interval[i] or 0) for i in (1, 2, 4))
                assert low > 0.5 if found["kind"] == "better" else high < 0.5
                assert p < 0.05
    assert kinds == {"better", "worse", "no evidence", "underpowered"}


def test_a_control_takes_nothing_from_the_rules_tests() -> None:
    """Negative control: a second rule does."""
    rules = [cell("ppo", LOW), cell("gigaflow", HIGH)]

    def said(*more: dict[str, Any]) -> str:
        return summarize(results(*rules, *more))["verdicts"][0]["text"]

    assert said() == said(cell("gigaflow+random", ALIKE))
    assert "Holm's correction for 2 arms" in said(cell("pods", ALIKE))


def test_table_by_hand() -> None:
    summary = summarize(results(cell("ppo", LOW), cell("sauna", HIGH, keep_rate=0.5)))
    ppo, sauna = summary["table"]
    assert set(ppo) == set(sauna) == ROW
    assert (ppo["improvement"], sauna["improvement"][0]) == (None, 1.0)
    assert sauna["final_iqm"][0] == np.mean(sorted(HIGH)[1:5])
    assert sauna["auc_iqm"][0] == sauna["final_iqm"][0] / 2
    assert sauna["final_mean"] == np.mean(HIGH)
    assert sauna["final_std"] == np.std(HIGH, ddof=1)
    assert (sauna["keep_rate"], sauna["env_steps"], sauna["kept_steps"]) == (0.5, 3000, 1500)


def test_one_seed_and_none_are_null_and_not_zero() -> None:
    one, none = summarize(results(cell("ppo", LOW[:1]), cell("sauna", [])))["table"]
    assert one["final_iqm"] == [1300.0, None, None]
    assert (one["final_mean"], one["final_std"]) == (1300.0, None)
    assert none["final_iqm"] == none["auc_iqm"] == [None, None, None]
    assert [none[k] for k in ("final_mean", "final_std", "keep_rate", "env_steps")] == [None] * 4


def test_over_tasks() -> None:
    two = [
        cell(label, finals, task, keep_rate=0.7)
        for task in ("Cheetah", "Walker")
        for label, finals in [("ppo", LOW), ("sauna", HIGH if task == "Walker" else ALIKE)]
    ]
    summary = summarize(results(*two))
    (row,) = summary["over_tasks"]
    pairs = [(np.array(ALIKE), np.array(LOW)), (np.array(HIGH), np.array(LOW))]
    expected = s.improvement_over_tasks(pairs)
    assert row == {"label": "sauna", "baseline": "ppo", "tasks": 2, "improvement": list(expected)}
    better = summary["verdicts"][1]
    assert better["kind"] == "better" and "not corrected for the 2 tasks." in better["text"]
    assert summarize(results(*two[:2]))["over_tasks"] == []
    assert summarize(results(*two[:3], cell("sauna", HIGH[:1], "Walker")))["over_tasks"] == []


def test_profiles_are_steps() -> None:
    arms = cell("ppo", [1.0, 3.0]), cell("sauna", [2.0, 2.0, 4.0]), cell("none", [])
    profiles = summarize(results(*arms))["profiles"]["Cheetah"]
    assert set(profiles) == {"ppo", "sauna"}
    np.testing.assert_allclose(profiles["sauna"]["returns"], [1, 1, 2, 2, 3, 3, 4, 4])
    third = 1 / 3
    np.testing.assert_allclose(profiles["sauna"]["share"], [1, 1, 1, third, third, third, third, 0])
    np.testing.assert_allclose(profiles["ppo"]["share"], [1, 0.5, 0.5, 0.5, 0.5, 0, 0, 0])
    assert (np.diff(profiles["ppo"]["returns"]) > 0).all()


def test_curves() -> None:
    summary = summarize(results(cell("ppo", [2.0, 4.0, 6.0])))
    curve = summary["curves"]["Cheetah"]["ppo"]
    assert curve["env_steps"] == STEPS
    shares = {"keep_rate", "sample_rate"}
    assert set(curve) == {"env_steps", "return_mean", "vex_mean", "explained_variance", *shares}
    assert curve["return_mean"]["mean"] == [None, 2.0, 4.0]
    assert curve["return_mean"]["low"][0] is None and curve["return_mean"]["low"][2] < 2
    assert curve["vex_mean"] == {end: [None] * 3 for end in ("mean", "low", "high")}
    assert max(curve["keep_rate"]["high"]) <= 1 and max(curve["explained_variance"]["high"]) <= 1


def test_curves_of_different_lengths_end_with_the_shortest() -> None:
    arm = cell("sauna", [2.0, 4.0])
    arm["members"][1]["curve"] = {
        "env_steps": [1500, 2500, 3500, 4500],
        "return_mean": [0.0, 1.0, 2.0, 3.0],
    }
    curve = summarize(results(arm))["curves"]["Cheetah"]["sauna"]
    assert (curve["env_steps"][0], curve["env_steps"][-1]) == (1500, 3000)
    mean = curve["return_mean"]["mean"]
    assert mean[0] is None and mean[-1] == (2.0 + 1.5) / 2
    assert curve["keep_rate"]["mean"] == [None] * len(mean)


def test_a_bound_narrows_only_an_interval_that_passes_it() -> None:
    arm = cell("sauna", [2.0, 4.0, 5.0])
    for one, keep_rate in zip(arm["members"], [0.9, 0.97, 1.0], strict=True):
        one["curve"]["keep_rate"] = [keep_rate] * 3
    curve = summarize(results(arm))["curves"]["Cheetah"]["sauna"]["keep_rate"]
    assert curve["high"] == [1.0] * 3 and 0.8 < curve["low"][0] < curve["mean"][0] < 1


def test_same_bytes_again_and_input_untouched() -> None:
    given = results(cell("ppo", LOW), cell("sauna", HIGH, keep_rate=0.5))
    before = copy.deepcopy(given)
    first = json.dumps(summarize(given), allow_nan=False)
    assert given == before
    assert json.dumps(summarize(json.loads(json.dumps(given))), allow_nan=False) == first


def test_an_arm_added_later_changes_no_interval() -> None:
    cells = [cell("ppo", LOW), cell("sauna", HIGH, keep_rate=0.5)]
    alone = summarize(results(*cells))
    more = summarize(results(*cells, cell("random-drop", ALIKE, keep_rate=0.5)))
    assert more["table"][:2] == alone["table"]


def test_another_format_is_refused() -> None:
    with pytest.raises(BadInput, match="format 2"):
        summarize({**results(), "format": 2})


def test_neither_module_loads_jax() -> None:
    code = "import sys, sauna.experiments.study.summary; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
