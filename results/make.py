"""Makes everything under `results/` and the tables and figures that are made of it.

    python results/make.py             docs and figures from the result files
    python results/make.py --collect   takes what the studies in runs/ have found so far, first
    python results/make.py --train     trains first (many hours), continuing where it stopped

The runs stay in `runs/`, which is not in the repository; what is committed is each member's final
numbers and a thinned curve.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from claims import HEADER, claims_rows, told

from sauna.experiments.measure import coverage_report, noise_report, posture_report
from sauna.experiments.report.figures import draw_plots, write_figures
from sauna.experiments.report.numbers import digits_of, digits_of_tasks, interval, number
from sauna.experiments.report.page import rounded
from sauna.experiments.study.report import UNFOLDED
from sauna.experiments.study.results import gather
from sauna.experiments.study.spec import load_spec
from sauna.experiments.study.summary import ABLATION, summarize
from sauna.experiments.study.tables import PAPER, unversioned
from sauna.experiments.study.units import units_of

ROOT = Path(__file__).parent.parent
STUDIES = ("fig3", "cheetah30", "release", "a2c", "minatar", "pong")
CLAIMED = ("fig3", "cheetah30", "release", "minatar")  # what the claims are held against
MEASURED = {
    "noise": noise_report,
    "dial": coverage_report,
    "fig5": posture_report,
}  # what `docs/why.md` tells
STILLS = ROOT / "docs" / "why" / "figures" / "stills.png"
CURVES_OF_RETURNS = "learning_curves"  # the figure's name
CURVES = ("return_mean", "keep_rate", "vex_mean", "explained_variance")
POINTS = 30  # of each curve that are committed
SHOWN = ("ppo", "vex-head", "random-drop", "sauna 0.8")  # in the README's figure

# PPO's published means for 10^6 steps, for orientation. Other versions of the tasks and other
# metrics: the paper's Table 1 and baselines on v2 tasks, CleanRL on v4 tasks.
PUBLISHED = {
    "HalfCheetah-v5": ("2277", "1669", "1443"),
    "Hopper-v5": ("2106", "2316", "2383"),
    "InvertedDoublePendulum-v5": ("6100", "7103", "-"),
    "InvertedPendulum-v5": ("532", "809", "963"),
    "Reacher-v5": ("-7.5", "-6.7", "-"),
    "Swimmer-v5": ("99.5", "111", "-"),
}


def train(name: str) -> None:
    """Trains and measures what is missing; what fails is told, and stands in the results.

    Raises:
      SystemExit: it was interrupted.
    """
    command = [sys.executable, "-m", "sauna", "study", name, "--out", "runs"]
    code = subprocess.run(command).returncode
    if code in (130, 143) or code < 0:
        sys.exit(code)
    if code:
        print(f"{name}: exit code {code}", flush=True)


def collect(name: str) -> None:
    """`results/NAME.json` from what `runs/` holds of the study: finished members, thinned curves.

    The study may still be running, or have been interrupted.
    """
    stored = ROOT / "runs" / name / "study.json"
    if not stored.exists():
        return
    spec, size = load_spec(name), json.loads(stored.read_text())["seeds_per_unit"]
    folder = ROOT / "runs" / "units"
    results = gather(spec, units_of(spec, size), folder, f"sauna study {name}")
    results["cells"] = [cell for cell in map(_thinned, results["cells"]) if cell["members"]]
    if not results["cells"]:
        return
    for cell in results["cells"]:
        del cell["config"]  # the command says what differs from the preset
    text = json.dumps(results, separators=(",", ":"))
    (ROOT / "results" / f"{name}.json").write_text(text.replace('{"task"', '\n{"task"') + "\n")


def _thinned(cell: dict[str, Any]) -> dict[str, Any]:
    members = [m for m in cell["members"] if m["status"] in ("complete", "failed")]
    for member in members:
        curve, number = member["curve"], len(member["curve"]["env_steps"])
        chosen = (
            np.unique(np.linspace(0, number - 1, POINTS).astype(int)).tolist() if number else []
        )
        member["curve"] = {key: [curve[key][i] for i in chosen] for key in ("env_steps", *CURVES)}
    return {**cell, "members": members}


def collect_measured(name: str) -> None:
    """`results/NAME.json`: what a study has measured of its members so far, to five digits."""
    place = ROOT / "runs" / name
    path = place / f"{load_spec(name).measure}.json"
    if path.exists():
        found = {**json.loads(path.read_text()), "command": f"sauna study {name}"}
        text = json.dumps(rounded(found), separators=(",", ":"))
        text = text.replace('{"task"', '\n{"task"') + "\n"
        (ROOT / "results" / f"{name}.json").write_text(text)
    if (place / "figures" / "frames.png").exists():
        STILLS.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(place / "figures" / "frames.png", STILLS)


def load(name: str) -> dict[str, Any] | None:
    path = ROOT / "results" / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def ppo_table(results: dict[str, Any]) -> str:
    """PPO's final training returns as a Markdown table."""
    lines = [
        "| task | PPO here, mean +- std | seeds, lowest to highest | paper (v2) | baselines (v2) | CleanRL (v4) |",  # noqa: E501
        "|---|---|---|---|---|---|",
    ]
    for cell in results["cells"]:
        if cell["label"] in ("ppo", "ppo, limits end") and cell["members"]:
            complete = [m for m in cell["members"] if m["status"] == "complete"]
            final = sorted(m["final_return"] for m in complete if m["final_return"] is not None)
            if not final:
                continue
            mean, std = float(np.mean(final)), float(np.std(final, ddof=1))
            digits = digits_of([mean])
            seeds = ", ".join(number(x, digits) for x in final)
            told_mean = f"{number(mean, digits)} +- {number(std, digits)}"
            task = cell["task"] + (", time limits end" if cell["label"] != "ppo" else "")
            published = " | ".join(PUBLISHED[cell["task"]])
            lines.append(f"| {task} | {told_mean} | {seeds} | {published} |")
    return "\n".join(lines)


def arms_table(name: str, results: dict[str, Any], summary: dict[str, Any]) -> str:
    """Every arm of a study as a Markdown table, the paper's numbers beside it."""
    wanted = {
        (task, arm.label): len(arm.seeds) for arm in load_spec(name).arms for task in arm.tasks
    }
    digits_of_task = digits_of_tasks(summary["table"])
    is_ppo = results["settings"].get("algorithm", "ppo") == "ppo"
    lines = [
        "| task | arm | seeds | final return, IQM [95%] | mean +- std | keep rate | against | P(improvement) [95%] | paper |",  # noqa: E501
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in summary["table"]:
        seeds = f"{row['seeds']} of {wanted[row['task'], row['label']]}"
        failed = f", {row['failed']} failed" if row["failed"] else ""
        digits = digits_of_task[row["task"]]
        std = number(row["final_std"], digits)
        lines.append(
            f"| {row['task']} | {row['label']} | {seeds}{failed} | "
            f"{interval(row['final_iqm'], digits)} | "
            f"{number(row['final_mean'], digits)} +- {std} | "
            f"{number(row['keep_rate'], 3)} | {row['baseline'] or '-'} | "
            f"{interval(row['improvement'], 2)} | "
            f"{_paper(row['task'], row['label']) if is_ppo else '-'} |"
        )
    return "\n".join(lines)


def _paper(task: str, label: str) -> str:
    """The paper's Table 1, beside its PPO and beside the variants of its method."""
    known = PAPER.get(unversioned(task), {})
    column = "PPO" if label.startswith("ppo") else "SAUNA" if label.startswith("sauna") else ""
    return f"{known[column][0]} +- {known[column][1]}" if column in known else "-"


def document() -> str:
    """`docs/results.md`, all of it from the result files."""
    covered = json.loads((ROOT / "results" / "intervals.json").read_text())["iqm_of_normals"]["6"]
    parts = [
        "# What was found",
        "Made by `python results/make.py` from the files in `results/`; trained by "
        "`python results/make.py --train`. Training return (sampled actions), mean of the last "
        "100 episodes; 10^6 env steps unless an arm says otherwise (minatar: 3 x 10^6). The "
        "paper's numbers are of version 2 of the tasks and of kept steps: compare arms within a "
        "column, not across.",
        "A verdict needs an exact Mann-Whitney test, corrected by Holm's method for the arms that "
        "share a baseline on a task, and an interval of P(better) that leaves out one half. It is "
        "not corrected for the number of tasks. The interval of an IQM is a percentile bootstrap, "
        f"which is too narrow with six seeds: it holds the truth {covered:.0%} of the time rather "
        "than 95% (normal scores, `python results/intervals.py`). The area under the curve is that "
        "of the budget's env steps, also where an arm takes more of them.",
        _revisions(),
        *_claims(),
    ]
    for name in STUDIES:
        results = load(name)
        if results is None:
            parts.append(f"## {name}\n\nNot trained yet: `sauna study {name}`.")
            continue
        summary = summarize(results)
        parts += [f"## {name}", f"`{results['command']}`", arms_table(name, results, summary)]
        parts.append(_missing(name, results))
        parts.append(shown_figures(name))
        parts.append(_verdicts(summary["verdicts"]))
        if summary["filtering"]:
            parts += [
                f"Ablation of the selection rule. {ABLATION}",
                _verdicts(summary["filtering"]),
            ]
        parts.append(_same_runs(results))
    return "\n\n".join(part for part in parts if part) + "\n"


def _verdicts(found: list[dict[str, Any]]) -> str:
    """Each verdict as a sentence; of many, only the decided ones are open."""
    if len(found) <= UNFOLDED:
        return _listed(verdict["text"] for verdict in found)
    decided = [verdict["text"] for verdict in found if verdict["kind"] in ("better", "worse")]
    others = [verdict["text"] for verdict in found if verdict["text"] not in decided]
    if not decided:
        return f"None of {len(found)} comparisons is decided.\n\n{_folded('All of them', others)}"
    return (
        f"Of {len(found)} comparisons, {len(decided)} are decided.\n\n{_listed(decided)}\n\n"
        f"{_folded(f'The other {len(others)}', others)}"
    )


def _same_runs(results: dict[str, Any]) -> str:
    """Arms whose runs of every seed agree wherever both have a point: evidence that counts once."""
    said = []
    for task in dict.fromkeys(cell["task"] for cell in results["cells"]):
        cells = [cell for cell in results["cells"] if cell["task"] == task]
        said += [
            f"On {task} `{a['label']}` and `{b['label']}` are the same runs up to where each "
            f"stops: what both are said to show was seen once."
            for a, b in itertools.combinations(cells, 2)
            if _agree(a, b)
        ]
    return _listed(said)


def _agree(a: dict[str, Any], b: dict[str, Any]) -> bool:
    curves = [
        {
            m["seed"]: dict(zip(m["curve"]["env_steps"], m["curve"]["return_mean"], strict=True))
            for m in cell["members"]
        }
        for cell in (a, b)
    ]
    if not curves[0] or set(curves[0]) != set(curves[1]):
        return False
    for seed, one in curves[0].items():
        other = curves[1][seed]
        both = [step for step in set(one) & set(other) if one[step] is not None]
        if len(both) < 3 or any(one[step] != other[step] for step in both):
            return False
    return True


def _folded(name: str, sentences: Iterable[str]) -> str:
    return f"<details><summary>{name}</summary>\n\n{_listed(sentences)}\n\n</details>"


def _revisions() -> str:
    """Whether runs of several revisions of the package can be compared."""
    path = ROOT / "results" / "revisions.json"
    if not path.exists():
        return ""
    stored = json.loads(path.read_text())
    runs = stored["runs"]
    equal = sum(len(run["equal"]) for run in runs)
    return (
        "The runs were trained by several revisions of the package, while it was made. Of every "
        "study, arm and revision two runs (not of random controls, which need whole runs) were "
        f"begun again by revision {stored['now']}: up to the second point of the curves, "
        f"{equal} of {sum(len(run['env_steps']) for run in runs)} came out with the same numbers "
        f"(`{stored['command']}`)."
    )


def _claims() -> list[str]:
    parts = [
        "## The paper's claims",
        "Each line is a family of exact tests, one per task, corrected by Holm's method for its "
        "tasks and not for the number of lines; a pair of arms is judged on the tasks where both "
        "are trained to the end. *By the interval* is said of the tasks together, where the 95% "
        "interval of P(better) leaves out one half: no test, and corrected for nothing. What the "
        "paper says of noise (abstract c), of exploration (abstract d) and of HalfCheetah's gait "
        "(section 4.4) is held against measurements in [why.md](why.md). MinAtar's games are not "
        "among the paper's tasks.",
    ]
    for name in CLAIMED:
        rows = claims_rows(results) if (results := load(name)) else []
        if rows:
            again = [False, *(row[0] == other[0] for row, other in itertools.pairwise(rows))]
            shown = [["", *row[1:]] if same else row for row, same in zip(rows, again, strict=True)]
            parts += [f"### {name}", _listed(told(rows)), _markdown([HEADER, *shown])]
    return parts


def _missing(name: str, results: dict[str, Any]) -> str:
    """What of a study is not trained yet."""
    done = {
        (c["task"], c["label"]): sum(m["status"] == "complete" for m in c["members"])
        for c in results["cells"]
    }
    missing = []
    for arm in load_spec(name).arms:
        tasks = [t for t in arm.tasks if done.get((t, arm.label), 0) < len(arm.seeds)]
        if tasks:
            every = len(tasks) == len(arm.tasks) > 1
            missing.append(f"{arm.label} ({'every task' if every else ', '.join(tasks)})")
    return f"Not trained to the end yet: {'; '.join(missing)}." if missing else ""


def why() -> str:
    """`docs/why.md`, all of it from the result files; its figures are drawn on the way."""
    parts = [
        "# Why it works, or does not",
        "Made by `python results/make.py`, as "
        "[results.md](results.md) is. What is measured, and how, is told in "
        "[studies.md](studies.md#measurements).",
    ]
    for name, study in MEASURED.items():
        parts.append(f"## {study.TITLE}")
        measured = load(name)
        if measured is None or not measured["cells"]:
            parts.append(f"Not measured yet: `sauna study {name}`.")
            continue
        extra = study.report(measured)
        drawn = draw_plots(extra.plots, extra.looks, ROOT / "docs" / "why")
        parts.append(f"`{measured['command']}`")
        parts.append(_listed(extra.answers))
        if study is posture_report and STILLS.exists() and posture_report.shown_pair(measured):
            parts.append(f"![Stills of one pair](why/figures/{STILLS.name})")
            parts.append(
                f"{posture_report.chosen(measured)} Of each its clearest episode in that posture."
            )
        parts += [f"![{p.title}](why/figures/{p.name}.png)\n\n{p.caption}" for p in extra.plots]
        parts.append(_markdown(study.text_table(measured)))
        parts.append(study.ABOUT)
        for path in drawn.values():
            path.unlink()  # the picture is enough here
    return "\n\n".join(parts) + "\n"


def _listed(sentences: Iterable[str]) -> str:
    return "\n".join(f"- {text}" for text in sentences)


def _markdown(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def insert(path: Path, name: str, text: str) -> None:
    """Puts `text` between the markers `NAME` of a Markdown file."""
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    whole = path.read_text()
    head, rest = whole.split(begin)
    path.write_text(f"{head}{begin}\n{text}\n{end}{rest.split(end)[1]}")


def figures(name: str, results: dict[str, Any]) -> None:
    """The figures of a study's report, as SVG: a picture that git stores in little room."""
    place = ROOT / "docs" / name
    shutil.rmtree(place, ignore_errors=True)
    write_figures(results, summarize(results), place)
    for path in (place / "figures").glob("*.png"):
        path.unlink()


def shown_figures(name: str) -> str:
    """The learning curves, and links to the report's other figures."""
    found = sorted((ROOT / "docs" / name / "figures").glob("*.svg"))
    others = [
        f"[{path.stem.replace('_', ' ')}]({name}/figures/{path.name})"
        for path in found
        if path.stem != CURVES_OF_RETURNS
    ]
    return (
        f"![Learning curves]({name}/figures/{CURVES_OF_RETURNS}.svg)\n\n"
        f"More figures: {', '.join(others)}."
    )


def readmes_picture(results: dict[str, Any]) -> None:
    """fig3's learning curves of the arms that decide."""
    shown = {**results, "cells": [cell for cell in results["cells"] if cell["label"] in SHOWN]}
    with tempfile.TemporaryDirectory() as folder:
        write_figures(shown, summarize(shown), Path(folder))
        picture = Path(folder) / "figures" / f"{CURVES_OF_RETURNS}.png"
        shutil.copy(picture, ROOT / "docs" / picture.name)


def pong(results: dict[str, Any]) -> str:
    """How the one seed of `pong` went, and its curve."""
    member = results["cells"][0]["members"][0]
    steps, score = (member["curve"][key] for key in ("env_steps", "return_mean"))
    told = [(n, x) for n, x in zip(steps, score, strict=True) if x is not None]
    if member["status"] != "complete" or not told:
        return f"The run failed (`{results['command']}`)."
    (early, low), (late, high) = told[0], told[-1]
    text = (
        f"PPO, one seed (`{results['command']}`): the mean training score of the last 100 games is "
        f"{low:.1f} after {early:,} env steps and {high:.1f} after {late:,}."
    )
    return f"{text}\n\n![Pong, one seed](pong/figures/learning_curves.svg)"


def main() -> None:
    os.chdir(ROOT)
    for name in STUDIES:
        if "--train" in sys.argv:
            train(name)
        if "--train" in sys.argv or "--collect" in sys.argv:
            collect(name)
    for name in MEASURED:
        if "--train" in sys.argv:
            train(name)
        if "--train" in sys.argv or "--collect" in sys.argv:
            collect_measured(name)
    found = {name: results for name in STUDIES if (results := load(name))}
    for name, results in found.items():
        figures(name, results)
    (ROOT / "docs" / "why.md").write_text(why())
    (ROOT / "docs" / "results.md").write_text(document())
    if "fig3" in found:
        readmes_picture(found["fig3"])
        insert(ROOT / "README.md", "ppo", ppo_table(found["fig3"]))
    for name in ("fig3", "cheetah30", "minatar"):
        if results := load(name):
            insert(ROOT / "README.md", f"{name} claims", _listed(told(claims_rows(results))))
    if "pong" in found:
        insert(ROOT / "docs" / "atari.md", "pong", pong(found["pong"]))


if __name__ == "__main__":
    main()
