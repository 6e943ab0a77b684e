"""The report of a study: one HTML page that needs no network and no other file.

Everything a reader must not miss (verdict, table, errors, settings) is plain HTML, and the figures
are pictures; `page/report.js` puts figures that answer to pointer and keyboard in their place.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

from sauna.experiments.report.figures import (
    NOTHING,
    Extra,
    Panel,
    Plot,
    looks_of,
    plots_of,
    write_figures,
)
from sauna.experiments.report.page import filled, rounded
from sauna.experiments.report.style import Look, short
from sauna.experiments.study import tables
from sauna.experiments.study.summary import FILTERING
from sauna.system.safe_write import replace_file

# A shape beside the colour of each kind of verdict.
MARKS = {
    "better": "\N{BLACK UP-POINTING TRIANGLE}",
    "worse": "\N{BLACK DOWN-POINTING TRIANGLE}",
    "no evidence": "\N{WHITE CIRCLE}",
    "too few": "\N{HORIZONTAL ELLIPSIS}",
}
UNFOLDED = 5  # verdicts that are shown with all their words


def write_report(
    results: dict[str, Any], summary: dict[str, Any], folder: Path, extra: Extra = NOTHING
) -> Path:
    """Writes `folder/report.html` and `folder/figures/`; the same bytes for the same input.

    Args:
      results: what `results.json` holds.
      summary: what `summary.json` holds.
      folder: made where it is missing.
      extra: what a measurement adds.

    Returns:
      The page.
    """
    pictures = write_figures(results, summary, folder, extra)
    path = folder / "report.html"
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(path, make_page(results, summary, pictures, extra).encode())
    return path


def make_page(
    results: Mapping[str, Any],
    summary: Mapping[str, Any],
    pictures: Mapping[str, Path],
    extra: Extra = NOTHING,
) -> str:
    """The page as text; `pictures` are the SVG files that it shows where no script runs."""
    looks = {**looks_of(results), **extra.looks}
    plots = [*extra.plots, *plots_of(results, summary)]
    return filled(
        "report",
        page_data(looks, plots),
        line_colours(looks),
        title=escape(results["name"]),
        scope=scope(results),
        extra=f'<section id="measured"><h2>{extra.title}</h2>{extra.html}</section>'
        if extra.title
        else "",
        verdicts=verdicts(summary),
        filtering=filtering(summary),
        table=tables.main_table(results, summary),
        over_tasks=tables.over_tasks(results, summary),
        metric=escape(results["metric"]),
        baseline=escape(results["baseline"]),
        figures="".join(figure(plot, pictures[plot.name]) for plot in plots)
        or "<p>There is nothing to draw yet.</p>",
        layout="one-task" if len(summary["curves"]) == 1 else "",
        paper=tables.paper(results, summary),
        failures=tables.failures(results["cells"]),
        settings=tables.settings(results),
        command=escape(results["command"]),
    )


def scope(results: Mapping[str, Any]) -> str:
    """How much was trained, and what is missing."""
    cells = results["cells"]
    counts = Counter(member["status"] for cell in cells for member in cell["members"])
    parts = [
        _plural(len({cell["task"] for cell in cells}), "task"),
        _plural(len({cell["label"] for cell in cells}), "arm"),
        _plural(counts.total(), "training"),
    ]
    if unfinished := counts["running"] + counts["waiting"]:
        parts.append(f"<strong>{unfinished} not finished yet</strong>")
    if counts["failed"]:
        parts.append(f'<a href="#failed"><strong>{counts["failed"]} failed</strong></a>')
    return f" {tables.DOT} ".join(parts)


def _plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def verdicts(summary: Mapping[str, Any]) -> str:
    """Each arm against its baseline."""
    found = summary["verdicts"]
    if not found:
        return "<p>Nothing is compared: there is no arm beside the baseline.</p>"
    return _shown(found, "Verdicts by arm and task")


def filtering(summary: Mapping[str, Any]) -> str:
    """The verdicts on the filter alone, if an arm stands beside one that says so."""
    found = summary["filtering"]
    if not found:
        return ""
    return (
        f"<h3>Is it the filter?</h3><p>{FILTERING}</p>"
        f"{_shown(found, 'Verdicts on the filter by arm and task')}"
    )


def _shown(found: Sequence[Mapping[str, Any]], name: str) -> str:
    """Each verdict, its kind in words and shape; many as a table of arms by tasks, what they rest
    on folded away."""
    if len(found) <= UNFOLDED:
        return _sentences(found)
    return f"{_counted(found)}{_grid(found, name)}{_folds(found)}"


def _counted(found: Sequence[Mapping[str, Any]]) -> str:
    return f"<p>{_plural(len(found), 'comparison')}: {_totals(found)}.</p>"


def _folds(found: Sequence[Mapping[str, Any]]) -> str:
    """What each verdict rests on, folded away task by task."""
    folds = ""
    for task in dict.fromkeys(verdict["task"] for verdict in found):
        of_task = [verdict for verdict in found if verdict["task"] == task]
        name = f"{escape(task)}: {_totals(of_task)}"
        folds += f"<details><summary>{name}</summary>{_sentences(of_task)}</details>\n"
    return folds


def _totals(found: Sequence[Mapping[str, Any]]) -> str:
    counts = Counter(verdict["kind"] for verdict in found)
    return ", ".join(f"{count} {escape(kind)}" for kind, count in counts.items())


def _sentences(found: Sequence[Mapping[str, Any]]) -> str:
    items = "".join(
        f'<li class="{_class(v)}"><span class="kind"><span aria-hidden="true">{MARKS[v["kind"]]}'
        f"</span> {escape(v['kind'])}</span> <b>{escape(v['label'])}</b> against "
        f"{escape(v['against'])} on {escape(v['task'])}"
        f"<p>{escape(v['text'])}</p></li>\n"
        for v in found
    )
    return f'<ul class="verdicts">{items}</ul>'


def _class(verdict: Mapping[str, Any]) -> str:
    return str(verdict["kind"]).replace(" ", "-")


def _grid(verdicts: Sequence[Mapping[str, Any]], name: str) -> str:
    """Pairs of arms by tasks: the kind of each verdict and the chance to be better."""
    found = {(v["label"], v["against"], v["task"]): v for v in verdicts}
    tasks = list(dict.fromkeys(v["task"] for v in verdicts))
    rows = []
    for label, against in dict.fromkeys((v["label"], v["against"]) for v in verdicts):
        cells = [
            f'<span class="{_class(v)}"><span role="img" aria-label="{v["kind"]}">'
            f"{MARKS[v['kind']]}</span> {tables.number(v['chance'], 2)}</span>"
            if (v := found.get((label, against, task)))
            else ""
            for task in tasks
        ]
        rows.append(
            (f'{escape(label)} <span class="interval">than {escape(against)}</span>', cells)
        )
    marks = ", ".join(f"{mark} {kind}" for kind, mark in MARKS.items())
    return (
        tables.table(("Better", *map(escape, tasks)), rows, name=name)
        + f'<p class="notes">{marks}. The number is the chance that a seed of the arm ends above '
        "one of the arm it is compared with; 0.5 is no difference.</p>"
    )


def figure(plot: Plot, picture: Path) -> str:
    """A figure as a picture, which the script replaces."""
    data = base64.b64encode(picture.read_bytes()).decode()
    text = escape(" ".join(panel_text(plot, panel) for panel in plot.panels))
    return (
        f'<figure id="{plot.name}"><h3>{plot.title}</h3><figcaption>{plot.caption}</figcaption>'
        f'<img alt="{text}" src="data:image/svg+xml;base64,{data}"></figure>\n'
    )


def panel_text(plot: Plot, panel: Panel) -> str:
    """What a panel shows, in words: the last value of each line (the middle one of a profile)."""
    values = []
    for line in panel.lines:
        points = [(x, y) for x, y in zip(line.x, line.y, strict=True) if None not in (x, y)]
        x, y = points[len(points) // 2 if plot.name == "profiles" else -1]
        values.append(f"{line.label} {y:.4g} at {short(x or 0)}")
    said = "; ".join(values) or "no data"
    return f"{plot.title} of {panel.task}, {plot.y_label} by {plot.x_label}: {said}."


def line_colours(looks: Mapping[str, Look]) -> str:
    """The labels' colours as variables, for light and for dark pages."""
    light = "".join(f"--line{i}:{look.colour};" for i, look in enumerate(looks.values()))
    dark = "".join(f"--line{i}:{look.colour_on_dark};" for i, look in enumerate(looks.values()))
    return f":root{{{light}}}\n@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}\n"


def page_data(looks: Mapping[str, Look], plots: Sequence[Plot]) -> dict[str, Any]:
    """What the script draws."""
    labels = [
        {"label": label, "dash": " ".join(f"{d:g}" for d in look.dash), "marker": look.marker}
        for label, look in looks.items()
    ]
    drawn = [asdict(plot) for plot in plots]
    for plot, values in zip(plots, drawn, strict=True):
        for panel, shown in zip(plot.panels, values["panels"], strict=True):
            shown["text"] = panel_text(plot, panel)
    return {"labels": labels, "plots": rounded(drawn)}
