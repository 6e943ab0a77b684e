"""The figures of a study: what each one shows, and its PNG and SVG files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sauna.experiments.compute import AXES
from sauna.experiments.report import style

Numbers = list[float | None]
COLUMNS = 3  # panels side by side
PANEL = (4.6, 2.9)  # inches of a panel on a page
WRAP = 38  # characters of a name in one line


@dataclass(frozen=True)
class Line:
    """One label in one panel; `seeds` are the `(seed, x, y)` it was computed from."""

    label: str
    x: Numbers
    y: Numbers
    low: Numbers
    high: Numbers
    seeds: list[tuple[int, Numbers, Numbers]]


@dataclass(frozen=True)
class Panel:
    task: str
    lines: list[Line]


@dataclass(frozen=True)
class Plot:
    """One figure: a panel for each task. The y axis never leaves `limits`, where they are given."""

    name: str
    title: str
    caption: str
    x_label: str
    y_label: str
    limits: tuple[float, float] | None
    panels: list[Panel]


class SectionImage(NamedTuple):
    """An image of a section; without `png` its caption says why there is none."""

    png: bytes | None
    alt: str
    caption: str


class Section(NamedTuple):
    """What a measurement adds to the page of a study. All texts are plain, no HTML.

    Attributes:
      title: the question.
      answers: sentences, each true of itself.
      about: how it was measured.
      table: the head and the rows; the first column names a row.
      table_name: for readers who hear the page.
      plots, looks: figures, and how their lines look.
      image: a picture.
      answer: one sentence; by default the first of `answers`.
    """

    title: str = ""
    answers: Sequence[str] = ()
    about: str = ""
    table: Sequence[Sequence[str]] = ()
    table_name: str = ""
    plots: Sequence[Plot] = ()
    looks: Mapping[str, style.Look] = MappingProxyType({})
    image: SectionImage | None = None
    answer: str = ""


NOTHING = Section()

TRAINING_RETURN = "Training return, mean of the last 100 episodes."

# name of the file, key in the curves, title, caption, y axis, its limits
_CURVES: tuple[tuple[str, str, str, str, str, tuple[float, float] | None], ...] = (
    (
        "learning_curves",
        "return_mean",
        "Learning curves",
        TRAINING_RETURN + " Line: mean of the seeds. Band: its 95% interval by Student's t, which "
        "is not the table's: that is a bootstrap of the IQM, narrower with few seeds. Of fewer "
        "than three seeds each seed is drawn instead.",
        "return",
        None,
    ),
    (
        "keep_rate",
        "keep_rate",
        "Keep rate",
        "Share of the env steps that entered the rollout; 1 if no filter drops any.",
        "kept",
        (0.0, 1.0),
    ),
    (
        "samples_used",
        "sample_rate",
        "Samples used",
        "Share of the rollout's samples that the policy learned from in an epoch, if an arm has a "
        "sampler.",
        "used",
        (0.0, 1.0),
    ),
    (
        "vex",
        "vex_mean",
        "Vex",
        "What the Vex head predicts, mean over all env steps. The axis is cut at -1.",
        "Vex",
        (-1.0, 1.0),
    ),
    (
        "explained_variance",
        "explained_variance",
        "Explained variance",
        "Share of the returns' variance that the value function explains, over the env steps of "
        "the rollout, which a filter chooses. The axis is cut at -1.",
        "explained variance",
        (-1.0, 1.0),
    ),
)


def plots_of(results: Mapping[str, Any], summary: Mapping[str, Any]) -> list[Plot]:
    """Returns every figure that has something to show."""
    plots = [
        Plot(
            name,
            title,
            caption.replace(TRAINING_RETURN, results.get("curve", TRAINING_RETURN)),
            "env steps",
            y_label,
            limits,
            _curve_panels(results, summary, metric),
        )
        for name, metric, title, caption, y_label, limits in _CURVES
    ]
    plots[1:1] = _evaluation_plots(results, summary)  # beside the learning curves
    caption = (
        "Share of the seeds whose final return is at least x; band: 95% interval, which has "
        "no width where all seeds or none reach x, and is no certainty there."
    )
    plots.append(
        Plot(
            "profiles",
            "Performance profiles",
            caption,
            "final return",
            "share of seeds",
            (0.0, 1.0),
            _profile_panels(summary),
        )
    )
    return [plot for plot in plots if any(panel.lines for panel in plot.panels)]


def about_evaluations(results: Mapping[str, Any]) -> str:
    """Says how the evaluations of a study were played; empty if there are none."""
    how: dict[str, list[str]] = {}
    for cell in results["cells"]:
        if any("evaluations" in member for member in cell["members"]):
            config = cell.get("config") or {}
            labels = how.setdefault(_as_played(config), [])
            labels += [cell["label"]] if cell["label"] not in labels else []
    if not how:
        return ""
    said = [
        text + (f" ({', '.join(labels)})" if len(how) > 1 else "") for text, labels in how.items()
    ]
    return (
        f"mean return of {'; '.join(said)}, in environments of their own, while the members trained"
    )


def _as_played(config: Mapping[str, Any]) -> str:
    how = {True: "deterministic actions, the most likely ones", False: "sampled actions"}
    mode = how.get(config.get("eval_deterministic", ""), "actions of an unknown kind")
    return f"{config.get('eval_episodes', 'some')} episodes with {mode}"


def _evaluation_plots(results: Mapping[str, Any], summary: Mapping[str, Any]) -> list[Plot]:
    """The curves of the evaluations, of the arms all of whose complete seeds have some."""
    panels = [
        Panel(
            task,
            [
                Line(label, c["env_steps"], c["mean"], c["low"], c["high"], seeds)
                for label, c in of_label.items()
                if (seeds := _evaluated_seeds(results, task, label)) and _any(c["mean"])
            ],
        )
        for task, of_label in summary.get("evaluations", {}).items()
    ]
    about = about_evaluations(results)
    caption = f"{about[:1].upper()}{about[1:]}. Lines and bands are those of the learning curves."
    title = "Evaluations while training"
    return [Plot("evaluations", title, caption, "env steps", "return", None, panels)]


def _evaluated_seeds(
    results: Mapping[str, Any], task: str, label: str
) -> list[tuple[int, Numbers, Numbers]]:
    return [
        (member["seed"], found["env_steps"], found["return_mean"])
        for cell in results["cells"]
        if (cell["task"], cell["label"]) == (task, label)
        for member in cell["members"]
        if member["status"] == "complete" and (found := member.get("evaluations"))
    ]


def compute_plots(summary: Mapping[str, Any]) -> list[Plot]:
    """Returns the learning curves over compute, of what was recorded."""
    plots = []
    for axis, name in AXES.items():
        panels = [
            Panel(
                task,
                [
                    Line(label, c["x"], c["mean"], c["low"], c["high"], [])
                    for label, c in of_axis.get(axis, {}).items()
                    if _any(c["mean"])
                ],
            )
            for task, of_axis in summary.get("by_compute", {}).items()
        ]
        if any(panel.lines for panel in panels):
            caption = f"{TRAINING_RETURN} By {name}; a seed that has ended keeps its last return."
            title = f"Learning curves by {name}"
            plots.append(Plot(f"by_{axis}", title, caption, name, "return", None, panels))
    return plots


def looks_of(results: Mapping[str, Any]) -> dict[str, style.Look]:
    """Returns the look of each label of a study, in the order of its cells."""
    return style.looks({cell["label"]: cell["arm"] for cell in results["cells"]})


def _curve_panels(
    results: Mapping[str, Any], summary: Mapping[str, Any], metric: str
) -> list[Panel]:
    configs = {(cell["task"], cell["label"]): cell.get("config") or {} for cell in results["cells"]}
    panels = []
    for task, of_label in summary["curves"].items():
        lines = []
        for label, curves in of_label.items():
            curve = curves.get(metric)
            if curve and _any(curve["mean"]) and _means(metric, configs[task, label]):
                seeds = _seeds(results, task, label, metric)
                lines.append(
                    Line(
                        label,
                        curves["env_steps"],
                        curve["mean"],
                        curve["low"],
                        curve["high"],
                        seeds,
                    )
                )
        panels.append(Panel(task, lines))
    return panels


def _means(metric: str, config: Mapping[str, Any]) -> bool:
    """Whether a curve says something of an arm: of a head that is trained, of a sampler."""
    if metric == "vex_mean":
        return config.get("vex_coef", 1.0) != 0
    if metric == "sample_rate":
        return config.get("sampler", "none") != "none"
    return True


def _seeds(
    results: Mapping[str, Any], task: str, label: str, metric: str
) -> list[tuple[int, Numbers, Numbers]]:
    """The curves of the complete seeds."""
    return [
        (member["seed"], member["curve"]["env_steps"], member["curve"][metric])
        for cell in results["cells"]
        if (cell["task"], cell["label"]) == (task, label)
        for member in cell["members"]
        if member["status"] == "complete" and _any(member["curve"].get(metric, []))
    ]


def _profile_panels(summary: Mapping[str, Any]) -> list[Panel]:
    return [
        Panel(
            task,
            [
                Line(label, p["returns"], p["share"], p["low"], p["high"], [])
                for label, p in of_label.items()
                if _any(p["share"])
            ],
        )
        for task, of_label in summary["profiles"].items()
    ]


def _any(values: Iterable[float | None]) -> bool:
    return any(value is not None for value in values)


def write_figures(
    results: Mapping[str, Any], summary: Mapping[str, Any], folder: Path, extra: Section = NOTHING
) -> dict[str, Path]:
    """Writes `folder/figures/NAME.png` and `.svg`; the same bytes for the same input.

    Returns:
      The SVG file of each figure by its name.
    """
    plots = [*extra.plots, *plots_of(results, summary)]
    return draw_plots(plots, {**looks_of(results), **extra.looks}, folder)


def draw_plots(
    plots: Sequence[Plot], looks: Mapping[str, style.Look], folder: Path
) -> dict[str, Path]:
    """Writes both files of each plot under `folder/figures`; the SVG files by name."""
    written = {}
    for plot in plots:
        path = folder / "figures" / plot.name
        with style.applied():
            figure = _draw(plot, looks)
            style.save(figure, path.with_suffix(".png"))
            written[plot.name] = style.save(figure, path.with_suffix(".svg"))
    return written


def panel_svg(plot: Plot, panel: Panel, looks: Mapping[str, style.Look]) -> bytes:
    """Draws one panel without a legend, as SVG."""
    from matplotlib.figure import Figure

    with style.applied():
        figure = Figure(figsize=PANEL)  # fixed margins: a layout engine takes most of the time
        figure.subplots_adjust(left=0.15, right=0.97, bottom=0.17, top=0.97)
        axes = figure.subplots()
        _draw_panel(axes, plot, panel, looks)
        axes.set_title("")  # the page has it
        return style.as_svg(figure)


def _draw(plot: Plot, looks: Mapping[str, style.Look]) -> Any:
    from matplotlib.figure import Figure

    drawn = {line.label for panel in plot.panels for line in panel.lines}
    texts = {label: fill(label, WRAP) for label in looks if label in drawn}
    rows = -(-len(plot.panels) // COLUMNS)
    columns = -(-len(plot.panels) // rows)
    width = 3.6 * columns if columns > 1 else 5.4
    longest = max(len(line) for text in texts.values() for line in text.splitlines())
    legend_columns = max(1, int(width * 11 / (longest + 9)))
    legend_rows = -(-len(texts) // legend_columns)
    size = (width, 2.6 * rows + 0.2 * legend_rows + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    handles: dict[str, Any] = {}
    for axes, panel in zip(grid, plot.panels, strict=False):
        handles |= _draw_panel(axes, plot, panel, looks)
    for axes in grid[len(plot.panels) :]:
        axes.set_visible(False)
    figure.legend(
        [handles[label] for label in texts],
        [*texts.values()],
        handlelength=3.2,
        loc="outside lower center",
        ncols=legend_columns,
    )
    return figure


def _draw_panel(
    axes: Any, plot: Plot, panel: Panel, looks: Mapping[str, style.Look]
) -> dict[str, Any]:
    """Draws each line, its band or, of few seeds, these themselves; matplotlib's lines by label."""
    handles, shown = {}, []
    for line in panel.lines:
        x, y, low, high = (np.array(v, float) for v in (line.x, line.y, line.low, line.high))
        shown.append(y)
        if 1 < len(line.seeds) < style.MIN_BAND:
            low = high = np.full(len(x), np.nan)
            for _, seed_x, seed_y in line.seeds:
                values = np.array(seed_y, float)
                style.draw_seed(axes, looks[line.label], np.array(seed_x, float), values)
                shown.append(values)
        handles[line.label] = style.draw_line(axes, looks[line.label], x, y, low, high)
    style.fit_axes(axes, shown)
    _label_axes(axes, plot, panel)
    return handles


def _label_axes(axes: Any, plot: Plot, panel: Panel) -> None:
    axes.set_title(fill(panel.task, WRAP))
    axes.set_ylabel(plot.y_label)
    axes.set_xlabel(plot.x_label)
    if plot.x_label == "env steps":
        style.count_steps(axes)
    elif plot.x_label in AXES.values():
        axes.xaxis.set_major_formatter(style.short)
    if plot.limits:
        low, high = plot.limits
        margin = 0.02 * (high - low)
        shown = axes.get_ylim() if low < 0 else plot.limits
        axes.set_ylim(max(low, shown[0]) - margin, min(high, shown[1]) + margin)
