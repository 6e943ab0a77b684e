"""The tables of a tuning, as texts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sauna.experiments.report.numbers import digits_of, number
from sauna.experiments.tune.space import shown

STATES = ("complete", "pruned", "running", "waiting", "fail")


def trial_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """Lists the head of the table of trials and its rows: the best first, what failed last."""
    names = list(found["tune"]["values"])
    digits = digits_of(trial["return"] for trial in found["trials"])
    kind = "member" if found["tune"]["exchange_every"] else "trial"
    rows = [[kind, "state", "return", "env steps", *names]]
    for trial in sorted(found["trials"], key=_rank):
        values = (shown(trial["searched"].get(name, "-")) for name in names)
        state = "failed" if trial["state"] == "fail" else trial["state"]
        state += f": {trial['error']}" if "error" in trial else ""
        score = number(trial["return"], digits)
        rows.append([str(trial["number"]), state, score, f"{trial['env_steps']:,}", *values])
    return rows


def _rank(trial: Mapping[str, Any]) -> tuple[int, float, int]:
    value = trial["return"]
    return STATES.index(trial["state"]), -(value or 0.0), trial["number"]


def seeds_rows(found: Mapping[str, Any], name: str) -> list[list[str]]:
    """Lists the head and the rows of a table of further seeds; nothing if there are none.

    Args:
      name: `finalists` or `fresh`.
    """
    rows = found[name].get("table", [])
    digits = digits_of(row["final_mean"] for row in rows)
    texts = [
        [
            row["label"],
            f"{row['seeds']}" + (f" ({row['failed']} failed)" if row["failed"] else ""),
            f"{number(row['final_mean'], digits)} +- {number(row['final_std'], digits)}",
            number(row["env_steps"], 0),
        ]
        for row in rows
    ]
    head = [f"{name}: settings", "seeds", "final return, mean +- std", "env steps"]
    return [head, *texts] if rows else []


def exchange_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """Lists the head of the table of exchanges and its rows; nothing if there are none."""
    names = list(found["tune"]["values"])
    if not found["exchanges"]:
        return []
    digits = digits_of(one["source_score"] for one in found["exchanges"])
    rows = [["env steps", "member", "return", "copied", "its return", *names]]
    for one in found["exchanges"]:
        changes = (f"{shown(one['copied'][n])} -> {shown(one['settings'][n])}" for n in names)
        scores = number(one["score"], digits), number(one["source_score"], digits)
        who = str(one["member"]), scores[0], str(one["source"]), scores[1]
        rows.append([f"{one['env_steps']:,}", *who, *changes])
    return rows
