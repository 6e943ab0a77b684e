"""What a sequential study supports: a ranking, and when and why each arm stopped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sauna.experiments.sequential import Look, Replay, Standing, replay
from sauna.experiments.statistics import improvement_estimate

KINDS = {"not decided": "no evidence"}  # of a standing, as verdicts call it
ABOUT = (
    "Every arm starts with few seeds and gets more only while it is open. The chance of any false "
    "better or worse in the whole ranking is at most 5%, over all arms and all looks together. The "
    "comparisons with controls are a second family of the same kind. Each interval holds for its "
    "arm alone and is not corrected for the looks."
)


def scores_of(members: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Returns final returns in the order of the seeds, up to the first that has not ended.

    A failed seed, and one without a return, is -inf.
    """
    found: list[float] = []
    for member in members:
        if member["status"] not in ("complete", "failed"):
            break
        value = member.get("final_return") if member["status"] == "complete" else None
        found.append(-np.inf if value is None else float(value))
    return np.array(found)


def rank(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Ranks the arms of each task by their probability of improvement over the baseline.

    Args:
      results: of a study with `tournament`.

    Returns:
      a row for each arm: `improvement` with its interval, `seeds`, `verdict`, `reason`, `p`, and
      `control`, what was found beside its control.
    """
    stored, baseline = results["tournament"], results["baseline"]
    looks = tuple(Look(**look) for look in stored["looks"])
    rows = []
    for task in dict.fromkeys(cell["task"] for cell in results["cells"]):
        cells = [cell for cell in results["cells"] if cell["task"] == task]
        scores = {cell["label"]: scores_of(cell["members"]) for cell in cells}
        controls = {a: c for a, c in stored["controls"].items() if {a, c} <= scores.keys()}
        found = replay(scores, baseline, looks, controls)
        arms = [label for label in scores if label != baseline and label not in controls.values()]
        own = [_row(label, task, baseline, scores, controls, found) for label in arms]
        own.sort(key=lambda row: -1.0 if row["chance"] is None else row["chance"], reverse=True)
        rows += [{"rank": number, **row} for number, row in enumerate(own, 1)]
    return rows


def _row(
    label: str,
    task: str,
    baseline: str,
    scores: Mapping[str, np.ndarray],
    controls: Mapping[str, str],
    found: Replay,
) -> dict[str, Any]:
    standing = found.standings.get(label, Standing("open", "", np.nan, 1.0, 0))
    seeds = standing.seeds
    beside = found.beside_control.get(label)
    row = {
        "task": task,
        "label": label,
        "against": baseline,
        "seeds": seeds,
        "verdict": standing.verdict,
        "reason": standing.reason or f"not decided yet: {_more(seeds)}",
        "p": standing.p,
        "improvement": _improvement(scores[label][:seeds], scores[baseline][:seeds]),
        "chance": standing.probability if seeds else None,
        "control": None,
    }
    if beside is not None:
        control = controls[label]
        row["control"] = {
            "against": control,
            "verdict": beside.verdict,
            "p": beside.p,
            "improvement": _improvement(scores[label][:seeds], scores[control][:seeds]),
        }
    return row


def _more(seeds: int) -> str:
    return f"open after {seeds} seeds" if seeds else "its first seeds have not ended"


def _improvement(x: np.ndarray, y: np.ndarray) -> list[float | None]:
    return list(improvement_estimate(x, y)) if min(len(x), len(y)) else [None, None, None]


def verdicts(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Writes each arm's verdict against the baseline."""
    return [
        _verdict(row, row["label"], row["against"], row["verdict"], row["reason"], row["chance"])
        for row in rows
    ]


def control_verdicts(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Writes each arm's verdict against its matched random control, at the look where it
    stopped."""
    found = []
    for row in rows:
        if beside := row["control"]:
            chance, low, high = beside["improvement"]
            reason = f"{beside['verdict']} with {row['seeds']} seeds"
            if None not in (chance, low, high):
                reason += f" (probability of improvement {chance:.2f} [{low:.2f}, {high:.2f}])"
            against, verdict = beside["against"], beside["verdict"]
            found.append(_verdict(row, row["label"], against, verdict, reason, chance))
    return found


def _verdict(
    row: Mapping[str, Any],
    label: str,
    against: str,
    verdict: str,
    reason: str,
    chance: float | None,
) -> dict[str, Any]:
    return {
        "task": row["task"],
        "label": label,
        "against": against,
        "kind": KINDS.get(verdict, verdict),
        "chance": chance,
        "text": f"{label} against {against} on {row['task']}: {reason}.",
    }
