"""The page of the study of selection rules: rule x task, the pilots, every arm of every task."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from studies import folded, load, markdown, page

from sauna.config.presets import RANDOM_CONTROL
from sauna.experiments.report.numbers import digits_of_tasks, interval, number
from sauna.experiments.statistics import QUANTILES
from sauna.experiments.study.spec import load_spec
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.tables import unversioned

PILOTS = ("selection-pilot-hopper", "selection-pilot-breakout")
SCREENS = tuple(
    f"selection-screen-{name}" for name in ("mujoco", "minatar", "cartpole", "lunarlander")
)
SELECTION = (*PILOTS, *SCREENS)
# Quantities of a curve that are committed, and points of it: there are many arms.
CURVES = ("return_mean", "samples_backward", "learner_cpu_seconds")
POINTS = 20
SAME = 0.1  # of the baseline's mean: differences up to this count as none
COMPUTE = "samples_backward"


def selection_page() -> str | None:
    """Writes the page; None if nothing has been trained yet."""
    found = {name: results for name in SELECTION if (results := load(name))}
    if not found:
        return None
    screens = [results for name, results in found.items() if name in SCREENS]
    pilots = [results for name, results in found.items() if name in PILOTS]
    return page("selection", screen=_screen(screens), pilots=_pilots(pilots))


def _screen(studies: Sequence[Mapping[str, Any]]) -> str:
    if not studies:
        return "The screen has not been trained yet."
    summaries = [(results, summarize(results)) for results in studies]
    cells = {
        (label, task): cell.shown
        for results, summary in summaries
        for (label, task), cell in words_of(results, summary).items()
    }
    tasks = list(dict.fromkeys(task for _, task in cells))
    labels = list(dict.fromkeys(label for label, _ in cells))
    head = ["Rule", *(f"[{_short(task)}](#{_anchor(task)})" for task in tasks)]
    rows = [[f"`{label}`", *(cells.get((label, task), "-") for task in tasks)] for label in labels]
    rules = [row for row in rows if not row[0].endswith(f"{RANDOM_CONTROL}`")]
    controls = [row for row in rows if row[0].endswith(f"{RANDOM_CONTROL}`")]
    parts = [
        "## The screen: rule by task",
        "Five seeds. A cell shows the word at equal env steps and the probability of improvement "
        "over `ppo`, then the learner compute that the arm takes to reach PPO's final return.",
        markdown([head, *rules]),
        folded("The matched random controls", markdown([head, *controls])),
        *(_task(task, r, s) for r, s in summaries for task in s["curves"]),
    ]
    return "\n\n".join(parts)


class Cell(NamedTuple):
    """A rule on a task: the word at equal env steps, and all that the table shows."""

    word: str
    shown: str


def words_of(results: Mapping[str, Any], summary: Mapping[str, Any]) -> dict[tuple[str, str], Cell]:
    """Says for each arm and task whether it beats the baseline, at equal steps and compute.

    Arms of which no seed has ended are left out.
    """
    base = results["baseline"]
    ratios = {(v["label"], v["task"]): v["ratios"].get(COMPUTE) for v in summary["equal_compute"]}
    scores = {
        (cell["label"], cell["task"]): np.array(
            [m["final_return"] for m in cell["members"] if m["status"] == "complete"], float
        )
        for cell in results["cells"]
    }
    found = {}
    for row in summary["table"]:
        key = row["label"], row["task"]
        if row["label"] == base or not row["seeds"] or row["improvement"] is None:
            continue
        word = word_of(row["improvement"], scores[key], scores[base, row["task"]])
        shown = f"{_coloured(word)} {row['improvement'][0]:.2f}<br>{_ratio(ratios.get(key))}"
        found[key] = Cell(word, shown)
    return found


def screen_answer() -> str | None:
    """Says in a sentence what the screen has found so far; None if nothing is trained."""
    words: dict[str, dict[str, str]] = {}
    for name in SCREENS:
        if results := load(name):
            for (label, task), cell in words_of(results, summarize(results)).items():
                if not label.endswith(RANDOM_CONTROL):
                    words.setdefault(label, {})[task] = cell.word
    if not words:
        return None
    planned = [task for name in SCREENS for task in load_spec(name).tasks]
    tasks = [task for task in planned if any(task in found for found in words.values())]
    whole = [task for task in tasks if all(task in found for found in words.values())]
    better = [f"`{label}`" for label, found in words.items() if "better" in found.values()]
    worse = [label for label, found in words.items() if "worse" in found.values()]
    part = f" and a part of {len(tasks) - len(whole)} more" if len(tasks) > len(whole) else ""
    gains = f"better on a task: {', '.join(better)}" if better else "no rule beats `ppo`"
    return (
        f"**not decided** after 5 seeds on {len(whole)} of {len(planned)} tasks{part}. By the "
        f"intervals {gains}, and {len(worse)} of {len(words)} scored worse on a task"
    )


def word_of(improvement: Sequence[float | None], own: np.ndarray, base: np.ndarray) -> str:
    """Chooses better, worse, same or not decided; see the page's notes.

    Args:
      improvement: the probability of improvement and its interval.
      own, base: final returns of the arm and of the baseline, `[n]` each.
    """
    _, low, high = improvement
    if low is None or high is None:
        return "not decided"
    if low > 0.5:
        return "better"
    if high < 0.5:
        return "worse"
    if min(len(own), len(base)) < 2:
        return "not decided"
    limits = difference_interval(own, base)
    return "same" if max(map(abs, limits)) <= SAME * abs(base.mean()) else "not decided"


def difference_interval(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Computes Welch's 95% interval of the difference of two means."""
    if np.ptp(x) == np.ptp(y) == 0:
        return (float(x.mean() - y.mean()),) * 2
    with warnings.catch_warnings(action="ignore"):  # SciPy's, of seeds that hardly differ
        result = scipy.stats.ttest_ind(x, y, equal_var=False)
    limits = result.confidence_interval(QUANTILES[1] - QUANTILES[0])
    return float(limits.low), float(limits.high)


def _coloured(word: str) -> str:
    return f'<span class="{word.replace(" ", "-")}">{word}</span>'


def _ratio(ratio: Sequence[float | None] | None) -> str:
    if ratio is None:
        return "-"
    value, low, high = ratio
    if value is None:
        return "not reached"
    ends = "" if low is None else f" [{low:.2f}, {'-' if high is None else f'{high:.2f}'}]"
    return f"x {value:.2f}{ends}"


def _task(task: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Every arm of a task, folded, below a heading that the table links to."""
    text = [f"`{results['command']}`, preset `{_preset(results, task)}`.", arms(task, summary)]
    beside = [v["text"] for v in summary["filtering"] if v["task"] == task]
    if beside:
        text += ["Rules against their matched random controls:"]
        text += ["\n".join(f"- {sentence}" for sentence in beside)]
    return f"### {_short(task)}\n\n{folded('All arms', chr(10).join(_spaced(text)))}"


def _spaced(parts: Sequence[str]) -> list[str]:
    return [line for part in parts for line in (part, "")][:-1]


def arms(task: str, summary: Mapping[str, Any]) -> str:
    """Tabulates every arm of one task: returns, what it learned from, failed seeds."""
    digits = digits_of_tasks(summary["table"])[task]
    full = next(
        (
            r["samples_backward"]
            for r in summary["table"]
            if (r["task"], r["label"]) == (task, "ppo")
        ),
        None,
    )
    head = [
        "Arm",
        "Seeds",
        "Failed",
        "Final return, mean ± std",
        "AUC, IQM",
        "Samples learned from",
    ]
    rows = [[*head, "Probability of improvement [95%]"]]
    for row in summary["table"]:
        if row["task"] != task or not (row["seeds"] or row["failed"]):
            continue
        mean, std, learned = row["final_mean"], row["final_std"], row["samples_backward"]
        improvement = row["improvement"]
        rows.append(
            [
                f"`{row['label']}`",
                str(row["seeds"]),
                str(row["failed"]),
                "-" if mean is None else f"{number(mean, digits)} ± {number(std or 0.0, digits)}",
                "-" if row["auc_iqm"][0] is None else number(row["auc_iqm"][0], digits),
                f"{learned / full:.2f} of PPO's" if learned and full else "-",
                "-" if not improvement or improvement[0] is None else interval(improvement, 2),
            ]
        )
    return markdown(rows)


def _pilots(studies: Sequence[Mapping[str, Any]]) -> str:
    if not studies:
        return ""
    parts = [
        "## The pilot: does every rule train?",
        "Three seeds and a fraction of the usual env steps. The pilot decides nothing. It shows "
        "that no rule gives a number that is not finite.",
    ]
    for results in studies:
        summary = summarize(results)
        members = [m for cell in results["cells"] for m in cell["members"]]
        failed = sum(m["status"] == "failed" for m in members)
        for task in summary["curves"]:
            steps = int(float(load_spec(results["name"]).text["steps"]))
            parts += [
                f"### {_short(task)}, pilot",
                f"`{results['command']}`: {steps:,} env steps, preset `{_preset(results, task)}`, "
                f"{len(members)} trainings ended, {failed} failed.",
                arms(task, summary),
            ]
    return "\n\n".join(parts)


def _preset(results: Mapping[str, Any], task: str) -> str:
    return str(next(cell["preset"] for cell in results["cells"] if cell["task"] == task))


def _short(task: str) -> str:
    return unversioned(task).removeprefix("gymnax/").removesuffix("-MinAtar")


def _anchor(task: str) -> str:
    return _short(task).lower()
