"""The paper's claims about scores, and what the members trained here say of each.

A claim is a family of tests: one arm against another on every task of a study, corrected together.
This is stricter than the verdicts of one task, which are corrected for the arms only. A statement
about all tasks together rests on an interval alone, and says so.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from sauna.experiments.report.numbers import interval
from sauna.experiments.statistics import Estimate, compare, improvement_over_tasks
from sauna.experiments.study.summary import MORE_STEPS, UNFILTERED, random_controls
from sauna.experiments.study.tables import PAPER, unversioned

CONTROL = "matched random control"  # stands for the label that it has in a study
VARIANTS = ("sauna", "sauna 0.8", "sauna-paper")
REFERENCES = ("sauna-reference", "sauna-reference, kept steps")


class Claim(NamedTuple):
    """`pairs` of arms of which the first should score higher."""

    text: str
    pairs: tuple[tuple[str, str], ...]
    score: str = "final_return"


_AGAINST_PPO = (
    *((label, "ppo") for label in VARIANTS),
    *((label, "ppo, limits end") for label in REFERENCES),
)
CLAIMS = (
    Claim("SAUNA scores higher than PPO on every task (Table 1, Fig. 2)", _AGAINST_PPO),
    Claim("SAUNA learns sooner: it has a higher AUC (Fig. 2)", _AGAINST_PPO, "auc"),
    Claim(
        "Dropping steps causes the gain, not the head trained beside it (section 4.2, Fig. 3)",
        (("sauna", "vex-head"), ("sauna 0.8", "vex-head")),  # the paper's head has another target
    ),
    Claim(
        "The head helps even if nothing is dropped (asked in section 4.2)", (("vex-head", "ppo"),)
    ),
    Claim(
        "The filter chooses better than a matched random control (not in the paper)",
        (("sauna 0.8", CONTROL),),
    ),
)
HEADER = [
    "claim",
    "arm",
    "against",
    "tasks",
    "probability of improvement over the tasks [95%]",
    "keep rate",
    "so",
]


def claims_rows(results: Mapping[str, Any]) -> list[list[str]]:
    """What the results of a study (format 1) say of each claim, as rows under `HEADER`.

    A pair of arms is judged on the tasks where no seed of either is still to be trained.
    """
    rows = []
    studied = len({cell["task"] for cell in results["cells"]})
    for claim in CLAIMS:
        for label, baseline in (_named(results, *pair) for pair in claim.pairs):
            cells = list(_ended(results, label, baseline))
            pairs = {
                own["task"]: (_outcomes(own, claim.score), _outcomes(base, claim.score))
                for own, base in cells
            }
            keep_rates = [float(_scores(own, "keep_rate").mean()) for own, _ in cells]
            if pairs:
                row = [
                    claim.text,
                    label,
                    baseline,
                    *_judged(pairs, keep_rates, label != "vex-head"),
                ]
                row[-1] += _circumstances(cells, claim.score)
                if len(pairs) < studied:
                    row[-1] += f" ({len(pairs)} of {studied} tasks so far)"
                rows.append(row)
    return rows


def _circumstances(cells: list[tuple[dict[str, Any], dict[str, Any]]], score: str) -> str:
    """What else a difference may come from: failed seeds, and more env steps (of which
    an AUC counts the budget's alone)."""
    said = ""
    failed = sum(
        m["status"] == "failed" for pair in cells for cell in pair for m in cell["members"]
    )
    if failed:
        said += f"; {failed} failed seeds count as the worst outcome"
    ratios = [
        _scores(own, "env_steps").mean() / _scores(base, "env_steps").mean() for own, base in cells
    ]
    if score == "final_return" and max(ratios) > 1 + MORE_STEPS:
        said += f"; it took up to {max(ratios):.2f} times the env steps"
    return said


class Count(NamedTuple):
    """On how many tasks of a study an arm is better or worse than its baseline."""

    better: int
    worse: int
    tasks: int
    unfiltered: bool  # the arm filters, and drops at most 1% of its steps on every task


def count(results: Mapping[str, Any], claim: int, label: str) -> Count | None:
    """Counts what the study decides about `CLAIMS[claim]` for one arm; None if it has no such arm.

    The tests are those of `claims_rows`.
    """
    (pair,) = [_named(results, *pair) for pair in CLAIMS[claim].pairs if pair[0] == label]
    cells, score = list(_ended(results, *pair)), CLAIMS[claim].score
    if not cells:
        return None
    found = compare(
        {own["task"]: (_scores(own, score), _scores(base, score)) for own, base in cells}
    )
    kinds = [one.kind for one in found.values()]
    rates = [float(_scores(own, "keep_rate").mean()) for own, _ in cells]
    unfiltered = label != "vex-head" and min(rates) >= UNFILTERED
    return Count(kinds.count("better"), kinds.count("worse"), len(kinds), unfiltered)


def short_answer(counts: Mapping[str, Count]) -> str:
    """A few words over several studies, `name -> Count`: `no: worse on 1 of 6 MuJoCo tasks`."""
    better, worse = (_on(counts, kind) for kind in ("better", "worse"))
    if better and worse:
        answer = f"mixed: better on {better}; worse on {worse}"
    elif worse:
        answer = f"no: worse on {worse}"
    elif better:
        answer = f"yes on {better}; not decided elsewhere"
    else:
        answer = "not decided"
    word, colon, rest = answer.partition(":")
    answer = f"**{word}**{colon}{rest}"
    if all(count.unfiltered for count in counts.values()):
        answer += "; it drops at most 1% of its steps"
    return answer


def _on(counts: Mapping[str, Count], kind: str) -> str:
    return ", ".join(
        f"{getattr(count, kind)} of {count.tasks} {name}" if count.tasks > 1 else name
        for name, count in counts.items()
        if getattr(count, kind)
    )


def sentences(rows: list[list[str]]) -> list[str]:
    """A sentence for each claim, from its rows; an arm beside another than the first says which."""
    sentences = []
    for text, of_claim in itertools.groupby(rows, key=lambda row: row[0]):
        arms: dict[tuple[str, str], list[str]] = {}
        usual = next(claim.pairs[0][1] for claim in CLAIMS if claim.text == text)
        for row in of_claim:
            beside = "" if usual in (row[2], CONTROL) else f" (against `{row[2]}`)"
            arms.setdefault((beside, row[-1]), []).append(row[1])
        found = (
            f"{', '.join(f'`{label}`' for label in labels)}{beside}: {so}"
            for (beside, so), labels in arms.items()
        )
        sentences.append(f"**{text}.** {'. '.join(found)}.")
    return sentences


def _named(results: Mapping[str, Any], label: str, baseline: str) -> tuple[str, str]:
    """A pair of arms by their labels: of several controls the one that has more tasks finished."""
    found = random_controls(results, label) if baseline == CONTROL else [baseline]
    return label, max(found, key=lambda one: len(list(_ended(results, label, one))), default="")


def _ended(
    results: Mapping[str, Any], label: str, baseline: str
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """The cells of both arms on each task where every seed is complete or failed."""
    cells = {(cell["task"], cell["label"]): cell for cell in results["cells"]}
    seeds = results["settings"]["seeds"]
    for task in dict.fromkeys(task for task, _ in cells):
        pair = [cells.get((task, name), {"members": []}) for name in (label, baseline)]
        if all(len(cell["members"]) == seeds for cell in pair):
            yield pair[0], pair[1]


def _outcomes(cell: Mapping[str, Any], name: str) -> np.ndarray:
    """The scores that a test takes: a failed seed has the worst outcome."""
    failed = sum(m["status"] == "failed" for m in cell["members"])
    return np.concatenate([_scores(cell, name), np.full(failed, -np.inf)])


def _scores(cell: Mapping[str, Any], name: str) -> np.ndarray:
    former = {"auc": "area"}.get(name, name)  # in results of 0.1.0
    found = [
        m[name] if name in m else m[former] for m in cell["members"] if m["status"] == "complete"
    ]
    return np.array([x for x in found if x is not None], float)


def _judged(
    pairs: Mapping[str, tuple[np.ndarray, np.ndarray]], keep_rates: list[float], filters: bool
) -> list[str]:
    """`filters`: whether the arm drops steps at all, so that it could get credit for it."""
    found = compare(pairs)
    better, worse = (
        [unversioned(task) for task, c in found.items() if c.kind == kind]
        for kind in ("better", "worse")
    )
    inactive = [
        unversioned(task)
        for task, rate in zip(found, keep_rates, strict=True)
        if filters and rate >= UNFILTERED
    ]
    (over, *others) = (c.improvement for c in found.values())
    if others:
        over = improvement_over_tasks(list(pairs.values()))
    so = _conclusion(better, worse, len(pairs))
    if others:
        so += _over(over)
    if len(inactive) == len(found):
        so += "; it drops at most 1% of its steps"
    elif won := [task for task in better if task in inactive]:
        so += f"; it drops at most 1% of its steps on {', '.join(won)}"
    low, high = f"{min(keep_rates):.3f}", f"{max(keep_rates):.3f}"
    kept = low if low == high else f"{low} to {high}"
    return [str(len(pairs)), interval(over, 2), kept, so]


def _conclusion(better: list[str], worse: list[str], tasks: int) -> str:
    if worse:
        said = f"does not hold: worse on {', '.join(worse)}"
        return f"{said}, better on {', '.join(better)}" if better else said
    if len(better) == tasks == len(PAPER):
        return "holds"
    rest = f", not decided on the other {tasks - len(better)}" if len(better) < tasks else ""
    return f"better on {', '.join(better)}{rest}" if better else "not decided"


def _over(over: Estimate) -> str:
    """Said of the tasks together only where the interval leaves out one half."""
    if over.low is not None and over.low > 0.5:
        return "; better over the tasks by the interval"
    if over.high is not None and over.high < 0.5:
        return "; worse over the tasks by the interval"
    return ""
