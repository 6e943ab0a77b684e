"""The report of a study: one HTML page that needs no network, no script and no other file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sauna.config.controls import rule_of
from sauna.experiments.report.figures import (
    NOTHING,
    Panel,
    Plot,
    Section,
    about_evaluations,
    compute_plots,
    looks_of,
    panel_svg,
    plots_of,
    write_figures,
)
from sauna.experiments.report.page import render
from sauna.experiments.report.readout import read_out
from sauna.experiments.report.style import Look, short
from sauna.experiments.study import tables
from sauna.experiments.study.equal_compute import ABOUT as EQUAL_COMPUTE
from sauna.experiments.study.evaluations import has_evaluations
from sauna.experiments.study.ranking import ABOUT as RANKING
from sauna.experiments.study.verdicts import seeds_needed
from sauna.system.safe_write import replace_file
from sauna.training.display import counted

# A shape beside the colour of each kind of verdict.
MARKS = {
    "better": "\N{BLACK UP-POINTING TRIANGLE}",
    "worse": "\N{BLACK DOWN-POINTING TRIANGLE}",
    "no evidence": "\N{WHITE CIRCLE}",
    "underpowered": "\N{HORIZONTAL ELLIPSIS}",
    "too many failed": "\N{MULTIPLICATION SIGN}",
    "open": "\N{HORIZONTAL ELLIPSIS}",
}
ANSWERS = {
    "better": "better",
    "worse": "worse",
    "no evidence": "not decided",
    "underpowered": "too few seeds to decide",
    "too many failed": "too many seeds failed to decide",
    "open": "still open",
}
# How a kind of verdict is called: the words of docs/concepts/statistics.md.
WORDS = {
    **{kind: kind for kind in MARKS},
    "no evidence": "not decided",
    "underpowered": "too few seeds",
}
UNFOLDED = 5  # verdicts that are shown with all their words


def write_report(
    results: dict[str, Any], summary: dict[str, Any], folder: Path, section: Section = NOTHING
) -> Path:
    """Writes `folder/report.html` and `folder/figures/`; the same bytes for the same input.

    Args:
      results: what `results.json` holds.
      summary: what `summary.json` holds.
      folder: made where it is missing.
      section: what a measurement adds.

    Returns:
      The page.
    """
    write_figures(results, summary, folder, section)
    path = folder / "report.html"
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(path, make_page(results, summary, section).encode())
    return path


def make_page(
    results: Mapping[str, Any], summary: Mapping[str, Any], section: Section = NOTHING
) -> str:
    """Renders the page as text."""
    looks = {**looks_of(results), **section.looks}
    plots = [*section.plots, *plots_of(results, summary)]
    drawn = {line.label for plot in plots for panel in plot.panels for line in panel.lines}
    return render(
        "report",
        title=question(results, section),
        answer=answer(summary, section),
        name=results["name"],
        scope=scope(results),
        unfinished=_counts(results)["running"] + _counts(results)["waiting"],
        section=section,
        summary=summary,
        ablation=summary.get("about_filtering", ""),
        ranking=tables.ranking(summary),
        ranking_about=RANKING,
        seeds_needed=seeds_needed([*summary["verdicts"], *summary["filtering"]]),
        few_episodes=tables.few_episodes(summary["table"]),
        equal_compute_about=EQUAL_COMPUTE,
        by_compute=[(plot, _panels(plot, looks)) for plot in compute_plots(summary)],
        marks=MARKS,
        words=WORDS,
        unfolded=UNFOLDED,
        totals=totals,
        pairs=pairs,
        columns=tables.main_columns(
            results["baseline"],
            tables.has_samplers(summary["table"]),
            has_evaluations(summary["table"]),
        ),
        groups=tables.main_groups(summary, looks),
        metric=results["metric"],
        evaluation=about_evaluations(results),
        baseline=results["baseline"],
        looks={label: look for label, look in looks.items() if label in drawn},
        figures=[(plot, _panels(plot, looks)) for plot in plots],
        paper=tables.paper(results, summary),
        failures=tables.failures(results["cells"]),
        settings=tables.settings(results),
        command=results["command"],
    )


def question(results: Mapping[str, Any], section: Section = NOTHING) -> str:
    """Returns the page's title: the study's own question, its measurement's, or what it
    compares."""
    if own := results["settings"].get("question"):
        return str(own)
    if section.title:
        return section.title
    baseline = results["baseline"]
    tasks = list(dict.fromkeys(cell["task"] for cell in results["cells"]))
    named = {cell["arm"] for cell in results["cells"]}
    rules = [cell for cell in results["cells"] if rule_of(cell["arm"]) not in named]
    arms = list(dict.fromkeys(cell["label"] for cell in rules))
    others = [label for label in arms if label != baseline]
    where = tasks[0] if len(tasks) == 1 else f"{len(tasks)} tasks"
    if not others:
        return f"How well does {baseline} do on {where}?"
    if len(others) > 3:
        bases = {cell.get("baseline") for cell in results["cells"]} - {None, baseline}
        than = "the arm it is compared with" if bases else baseline
        return f"Which of {len(others)} arms is better than {than} on {where}?"
    verb = "Is" if len(others) == 1 else "Are"
    return f"{verb} {_listed(others)} better than {baseline} on {where}?"


def answer(summary: Mapping[str, Any], section: Section = NOTHING) -> str:
    """Returns the page's first sentence: what the verdicts come to."""
    if section.title and (section.answer or section.answers):
        return section.answer or section.answers[0]
    found = summary["verdicts"]
    if not found:
        return "Nothing is compared: there is no arm beside the baseline."
    usual = Counter(verdict["against"] for verdict in found).most_common(1)[0][0]
    many = len({verdict["task"] for verdict in found}) > 1
    said = []
    for kind, words in ANSWERS.items():
        names = [_named(v, usual, many) for v in found if v["kind"] == kind]
        if kind not in ("better", "worse") and len(names) > 3:
            names = [f"{len(names)} of {len(found)} comparisons"]
        if names:
            said.append(f"{words}: {_listed(names)}")
    text = "; ".join(said) + "."
    return text[0].upper() + text[1:]


def _named(verdict: Mapping[str, Any], usual: str, many: bool) -> str:
    """The arm of a verdict; what it is compared with if that is not usual, its task if of many."""
    than = "" if verdict["against"] == usual else f" (than {verdict['against']})"
    return f"{verdict['label']}{than}" + (f" on {verdict['task']}" if many else "")


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def scope(results: Mapping[str, Any]) -> list[str]:
    """Returns how much was trained."""
    cells = results["cells"]
    return [
        counted(len({cell["task"] for cell in cells}), "task"),
        counted(len({cell["label"] for cell in cells}), "arm"),
        counted(_counts(results).total(), "training"),
    ]


def _counts(results: Mapping[str, Any]) -> Counter[str]:
    return Counter(member["status"] for cell in results["cells"] for member in cell["members"])


def totals(found: Sequence[Mapping[str, Any]]) -> str:
    """Returns `2 better, 3 not decided`."""
    counts = Counter(WORDS[verdict["kind"]] for verdict in found)
    return ", ".join(f"{count} {kind}" for kind, count in counts.items())


def pairs(found: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, dict[str, Any]]]:
    """Returns each pair of arms that is compared, and its verdicts by task."""
    return [
        (
            label,
            against,
            {v["task"]: v for v in found if (v["label"], v["against"]) == (label, against)},
        )
        for label, against in dict.fromkeys((v["label"], v["against"]) for v in found)
    ]


def _panels(plot: Plot, looks: Mapping[str, Look]) -> list[dict[str, Any]]:
    return [_panel(plot, panel, looks) for panel in plot.panels]


def _panel(plot: Plot, panel: Panel, looks: Mapping[str, Look]) -> dict[str, Any]:
    """What the page shows of one panel."""
    return {
        "task": panel.task,
        "svg": panel_svg(plot, panel, looks) if panel.lines else None,
        "text": panel_text(plot, panel),
        "readout": read_out(plot, panel),
    }


def panel_text(plot: Plot, panel: Panel) -> str:
    """Returns what a panel shows, in words: the last value of each line (the middle one of a
    profile)."""
    values = []
    for line in panel.lines:
        points = [(x, y) for x, y in zip(line.x, line.y, strict=True) if None not in (x, y)]
        x, y = points[len(points) // 2 if plot.name == "profiles" else -1]
        values.append(f"{line.label} {y:.4g} at {short(x or 0)}")
    said = "; ".join(values) or "no data"
    return f"{plot.title} of {panel.task}, {plot.y_label} by {plot.x_label}: {said}."
