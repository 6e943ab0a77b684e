"""The first page of the results, and the table of claims that the README shows as well."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping
from typing import Any

from claims import HEADER, Count, claims_rows, count, sentences, short_answer
from measured_pages import noise_answer, posture_answer, sweep_answer
from selection_page import glance, screen_answer
from studies import (
    CLAIMED,
    FILES,
    MEASURED,
    ROOT,
    STUDIES,
    TITLES,
    command_of,
    folded,
    former_controls,
    listed,
    load,
    markdown,
    page,
    page_of,
)

from sauna.experiments.study.spec import load_spec

# The summary's rows: the claim in short, its number in `CLAIMS`, the arm that is judged.
_SHORT = ("sauna-paper", "sauna 0.8", "vex-head")  # judged in the README
_VARIANTS = ("sauna-paper", "sauna-reference", "sauna-reference, kept steps", "sauna", "sauna 0.8")
CLAIM_ROWS = (
    *(("SAUNA scores higher than PPO", 0, arm) for arm in _VARIANTS),
    *(("SAUNA learns sooner (AUC)", 1, arm) for arm in _VARIANTS),
    ("Dropping steps helps, beyond the head trained beside it", 2, "sauna"),
    ("Dropping steps helps, beyond the head trained beside it", 2, "sauna 0.8"),
    ("The head helps even if nothing is dropped", 3, "vex-head"),
    ("The filter chooses better than a matched random control", 4, "sauna 0.8"),
)


def findings(prefix: str, short: bool = False) -> str:
    """One table: what the paper says, a short answer, and the pages behind it.

    Args:
      prefix: path from the page that shows the table to `docs/results/`.
      short: leave out the variants that the README does not show.
    """
    rows, last = [["Claim", "Arm", "Answer", "Pages"]], ""
    for text, claim, label in CLAIM_ROWS:
        if short and label not in _SHORT:
            continue
        counts: dict[str, Count] = {}
        pages = []
        for name, tasks in CLAIMED.items():
            found = count(results, claim, label) if (results := load(name)) else None
            if found:
                counts[tasks] = found
                pages.append(_link(name, prefix))
        if counts:
            shown = "" if text == last else text
            rows.append([shown, f"`{label}`", short_answer(counts), ", ".join(pages)])
            last = text
    said: tuple[tuple[str, str, str, Callable[[Mapping[str, Any]], str]], ...] = (
        ("The dropped samples are noisier", "sauna", "noise", noise_answer),
        ("The threshold trades exploration for exploitation", "sauna", "dial", sweep_answer),
        ("HalfCheetah runs on its feet more often", "sauna 0.8", "fig5", posture_answer),
    )
    for text, arm, name, answer in said:
        if measured := load(name):
            rows.append([text, f"`{arm}`", answer(measured), _link(name, prefix)])
    if screened := screen_answer():
        link = f"[selection]({prefix}selection.md)"
        rows.append(["Another published rule of selection helps", "all rules", screened, link])
    return markdown(rows)


def _link(name: str, prefix: str) -> str:
    return f"[{FILES.get(name, name).replace('_', ' ')}]({prefix}{page_of(name)})"


def index(covered: float) -> str:
    """`docs/results/index.md`."""
    head = ["Study", "Tasks", "Seeds", "Env steps", "Command"]
    return page(
        "index",
        glance=glance(),
        findings=findings(""),
        studies=markdown([head, *map(_scope, _all())]),
        covered=f"{covered:.0%}",
        revisions=_revisions(),
        former=former_controls(
            (cell for name in CLAIMED for cell in (load(name) or {"cells": []})["cells"]), CLAIMED
        ),
        claims="\n\n".join(_claims()),
    )


def _all() -> list[str]:
    return [name for name in (*STUDIES, *MEASURED) if load(name)]


def _scope(name: str) -> list[str]:
    spec = load_spec(name)
    seeds = {len(arm.seeds) for arm in spec.arms}
    tasks = list(dict.fromkeys(task for arm in spec.arms for task in arm.tasks))
    steps = load(name)["cells"][0].get("steps") or load(name)["settings"]["steps"]
    return [
        f"[{TITLES[name]}]({page_of(name)})",
        tasks[0] if len(tasks) == 1 else str(len(tasks)),
        str(max(seeds)),
        f"{int(steps):,}",
        f"`{command_of(name)}`",
    ]


def _revisions() -> str:
    """Whether runs of several revisions of the package can be compared."""
    path = ROOT / "results" / "revisions.json"
    if not path.exists():
        return ""
    stored = json.loads(path.read_text())
    equal = sum(len(run["equal"]) for run in stored["runs"])
    number_of = sum(len(run["env_steps"]) for run in stored["runs"])
    return folded(
        "Several revisions of the package trained these runs",
        "Two runs of every study, arm and revision were begun again by revision "
        f"{stored['now']} (`{stored['command']}`). Up to the second point of the curves, {equal} "
        f"of {number_of} gave the same numbers. The random controls that repeated the drop "
        "rates of other runs were left out.",
    )


def _claims() -> list[str]:
    """Each study's verdicts on the claims, folded."""
    parts = []
    for name in CLAIMED:
        rows = claims_rows(results) if (results := load(name)) else []
        if rows:
            again = [False, *(row[0] == other[0] for row, other in itertools.pairwise(rows))]
            shown = [["", *row[1:]] if same else row for row, same in zip(rows, again, strict=True)]
            text = f"{listed(sentences(rows))}\n\n{markdown([HEADER, *shown])}"
            parts.append(folded(TITLES[name], text))
    return parts
