"""Seeds that collapse late, counted: hypothesis D of docs/results/selection-protocol.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scipy.stats import fisher_exact
from studies import listed, markdown

from sauna.experiments.statistics import ALPHA, holm

SHARE = 0.5  # of its best return, below which a seed has collapsed


def is_collapsed(member: Mapping[str, Any]) -> bool:
    """Whether a seed failed, or ends below half of the best return of its committed curve."""
    if member["status"] != "complete":
        return True
    known = [value for value in member["curve"]["return_mean"] if value is not None]
    return bool(member["final_return"] < SHARE * max([*known, member["final_return"]]))


def collapse_text(results: Mapping[str, Any]) -> str:
    """Counts the seeds that collapsed, arm by arm, each arm tested against the baseline."""
    found = {
        cell["label"]: [is_collapsed(member) for member in cell["members"]]
        for cell in results["cells"]
    }
    base = found.pop(results["baseline"])
    p_values = holm([_p_value(seeds, base) for seeds in found.values()])
    rows = [
        ["Arm", "Seeds that collapsed", "Exact p against the baseline, after Holm"],
        [f"`{results['baseline']}`", _count(base), "-"],
    ]
    for (label, seeds), p in zip(found.items(), p_values, strict=True):
        rows.append([f"`{label}`", _count(seeds), f"{p:.3f}"])
    return "\n\n".join(
        (
            "A seed has collapsed if its final return is below half of its best return, or if it "
            "failed.",
            markdown(rows),
            listed([_answer(base, found, p_values)]),
        )
    )


def _answer(base: list[bool], found: Mapping[str, list[bool]], p_values: list[float]) -> str:
    """Says whether the hypothesis holds: every arm has a lower share than the baseline."""
    lower = [_share(seeds) < _share(base) for seeds in found.values()]
    holds = "holds" if found and all(lower) else "does not hold"
    decided = sum(low and p < ALPHA for low, p in zip(lower, p_values, strict=True))
    return (
        f"Hypothesis D {holds} by its shares. The difference is decided for {decided} of "
        f"{len(found)} arms."
    )


def _p_value(seeds: list[bool], base: list[bool]) -> float:
    """Fisher's exact two-sided test of two shares."""
    table = [[sum(seeds), len(seeds) - sum(seeds)], [sum(base), len(base) - sum(base)]]
    return float(fisher_exact(table).pvalue)


def _share(seeds: list[bool]) -> float:
    return sum(seeds) / len(seeds)


def _count(seeds: list[bool]) -> str:
    return f"{sum(seeds)} of {len(seeds)}"
