"""The measurement `posture`: does HalfCheetah run on its feet or slide on its back?

A seed is on its feet if its torso is upright in more than half of the states of the episodes that
its finished policy plays. Seeds are paired here, as in the paper's figure: both arms of a pair
begin with the same weights and the same resets, and part after the first update.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from sauna.config.settings import Config
from sauna.experiments.measure.measurement import Measurement
from sauna.experiments.report import style
from sauna.experiments.report.figures import Line, Panel, Plot, Section, SectionImage
from sauna.experiments.statistics import ALPHA, Estimate
from sauna.system.errors import BadInput

TITLE = "On its feet or on its back?"
ABOUT = (
    "Sampled actions, frozen normaliser, the policy at the end of training, the same episodes for "
    "every seed. A seed is on its feet if the cosine of the torso's pitch is positive in more than "
    "half of the states. In brackets: 95% (Wilson). Between: upright in 10% to 90% of the states."
)
BETWEEN = (0.1, 0.9)


class Posture(NamedTuple):
    """One measured member."""

    seed: int
    upright: float  # share of states
    return_: float  # mean over the episodes
    frames: list[int]  # env steps that a picture shows
    picture: str  # its file's name
    curve: Mapping[str, Any]  # the explained variance over training

    @property
    def on_feet(self) -> bool:
        return self.upright > 0.5


class Pair(NamedTuple):
    """An arm beside its baseline, over the seeds that are measured in both."""

    label: str
    baseline: str
    seeds: int
    gained: int  # on its feet in the arm, on its back in the baseline
    lost: int  # the other way round
    p: float  # exact McNemar test, two-sided


def postures(cell: Mapping[str, Any]) -> list[Posture]:
    """Returns the measured members of a cell."""
    return [
        Posture(
            member["seed"],
            point["upright"],
            float(np.mean([episode["return"] for episode in point["episodes"]])),
            point["frames"] if "frames" in point else point["stills"],  # the name in 0.1.0
            point.get("picture", ""),
            member["curve"],
        )
        for member in cell["members"]
        for point in member["points"]
    ]


def share(found: list[Posture]) -> Estimate:
    """Computes the share of seeds on their feet, with Wilson's interval."""
    if not found:
        return Estimate(None, None, None)
    feet = sum(one.on_feet for one in found)
    low, high = scipy.stats.binomtest(feet, len(found)).proportion_ci(1 - ALPHA, "wilson")
    return Estimate(feet / len(found), float(low), float(high))


def pairs(measured: Mapping[str, Any]) -> Iterator[Pair]:
    """Returns every arm that has a baseline among the cells of its task.

    Of the seeds whose posture differs between the arms, McNemar's test asks whether as many differ
    one way as the other: a binomial test with a chance of one half.
    """
    for cell in measured["cells"]:
        for other in measured["cells"]:
            if (other["label"], other["task"]) != (cell["baseline"], cell["task"]):
                continue
            base = {one.seed: one.on_feet for one in postures(other)}
            both = [(one.on_feet, base[one.seed]) for one in postures(cell) if one.seed in base]
            gained = sum(own and not beside for own, beside in both)
            lost = sum(beside and not own for own, beside in both)
            p = scipy.stats.binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
            yield Pair(cell["label"], other["label"], len(both), gained, lost, float(p))


def verdicts(measured: Mapping[str, Any]) -> list[str]:
    """Reports the shares and the comparisons in sentences that claim no more than their test."""
    said = []
    for cell in measured["cells"]:
        found = postures(cell)
        if found:
            of_all = "" if len(found) == cell["seeds"] else f", of {cell['seeds']} in all,"
            said.append(
                f"{cell['label']}: on its feet in {sum(one.on_feet for one in found)} of "
                f"{len(found)} seeds{of_all} ({shown(share(found))})."
            )
    if not said:
        return ["No seed is trained to its end and measured yet."]
    return [*said, *(_compared(pair) for pair in pairs(measured) if pair.seeds)]


def shown(estimate: Estimate) -> str:
    """Returns `25% [11%, 47%]`; `-` where there is none."""
    value, low, high = estimate
    return "-" if value is None else f"{value:.0%} [{low:.0%}, {high:.0%}]"


def _compared(pair: Pair) -> str:
    if pair.p >= ALPHA:
        kind = "not decided"
    else:
        kind = f"{'more' if pair.gained > pair.lost else 'fewer'} seeds on their feet"
    return (
        f"{pair.label} against {pair.baseline}, seed by seed: {kind} ({pair.seeds} pairs; only "
        f"{pair.label} on its feet in {pair.gained}, only {pair.baseline} in {pair.lost}; exact "
        f"McNemar p = {pair.p:.3g})."
    )


def report(measured: Mapping[str, Any], folder: Path | None = None) -> Section:
    """Reports on all results in a section of the study's page.

    Args:
      folder: the study's, where `figures/frames.png` is written if there are frames.
    """
    answers = verdicts(measured)
    return Section(
        TITLE,
        answers,
        ABOUT,
        text_table(measured),
        "Postures",
        plots(measured),
        style.looks({cell["label"]: cell["arm"] for cell in measured["cells"]}),
        _frames(measured, folder) if folder else None,
        answer=answers[-1],
    )


def check(configs: Sequence[Config]) -> None:
    """Refuses environments other than HalfCheetah.

    Raises:
      BadInput
    """
    for config in configs:
        if not config.env.startswith("HalfCheetah"):
            raise BadInput(f'study: measure = "posture" is of HalfCheetah, not of {config.env}')


def text_table(measured: Mapping[str, Any]) -> list[list[str]]:
    """Returns the head, and a row for each arm."""
    rows = [["Arm", "Seeds", "On its feet", "Between", "Return on its feet", "Return on its back"]]
    for cell in measured["cells"]:
        found = postures(cell)
        of_both = ([one.return_ for one in found if one.on_feet is feet] for feet in (True, False))
        means = [f"{np.mean(returns):,.0f}" if returns else "-" for returns in of_both]
        between = sum(BETWEEN[0] <= one.upright <= BETWEEN[1] for one in found)
        rows.append([cell["label"], str(len(found)), shown(share(found)), str(between), *means])
    return rows


def shown_pair(measured: Mapping[str, Any]) -> list[tuple[str, Posture]]:
    """Returns the two members whose frames are shown, the baseline's first.

    The first seed on its feet in the arm and on its back in the baseline; failing that, the first
    that is measured in both.
    """
    for cell in measured["cells"]:
        for other in measured["cells"]:
            if (other["label"], other["task"]) != (cell["baseline"], cell["task"]):
                continue
            base = {one.seed: one for one in postures(other)}
            both = [(base[own.seed], own) for own in postures(cell) if own.seed in base]
            both.sort(key=lambda two: two[0].on_feet or not two[1].on_feet)
            if both:
                return [(other["label"], both[0][0]), (cell["label"], both[0][1])]
    return []


def chosen(measured: Mapping[str, Any]) -> str:
    """Returns how the pair that is shown was chosen, and how usual it is."""
    pair = next(pair for pair in pairs(measured) if pair.seeds)
    return (
        f"Chosen for the contrast: the first seed of which only {pair.label} is on its feet "
        f"({pair.gained} of {pair.seeds}; only {pair.baseline} in {pair.lost})"
        f"{'' if pair.gained else ', failing that the first of all'}."
    )


def _frames(measured: Mapping[str, Any], folder: Path) -> SectionImage | None:
    """The frames of a pair in one picture, or why there are none."""
    pair = shown_pair(measured)
    if not pair or not all(one.frames for _, one in pair):
        reasons = [
            point["not_drawn"]
            for cell in measured["cells"]
            for member in cell["members"]
            for point in member["points"]
            if "not_drawn" in point
        ]
        return SectionImage(None, "", f"No frames: {reasons[0]}.") if reasons else None
    text = ", ".join(f"{label} seed {one.seed}, {_posture(one)}" for label, one in pair)
    return SectionImage(
        draw_frames(pair, folder).read_bytes(),
        f"Frames of {text}",
        f"One pair at equal times, in env steps: {text}. {chosen(measured)} Of each its clearest "
        "episode in that posture.",
    )


def plots(measured: Mapping[str, Any]) -> list[Plot]:
    """Returns the explained variance of both members of the pair over training."""
    pair = shown_pair(measured)
    if not pair:
        return []
    lines = []
    for label, one in pair:
        x, y = one.curve["env_steps"], one.curve["explained_variance"]
        lines.append(Line(label, x, y, [None] * len(x), [None] * len(x), []))
    said = ", ".join(f"{label} {_posture(one)}" for label, one in pair)
    caption = (
        f"Of one pair of seeds: {said}. {chosen(measured)} Over the env steps that an "
        f"update learned from, which a filter chooses. The axis is cut at -1."
    )
    panel = Panel(f"{measured['cells'][0]['task']}, seed {pair[0][1].seed}", lines)
    return [
        Plot(
            "pair",
            "Explained variance of one pair",
            caption,
            "env steps",
            "explained variance",
            (-1.0, 1.0),
            [panel],
        )
    ]


def _posture(one: Posture) -> str:
    return f"on its {'feet' if one.on_feet else 'back'} (return {one.return_:,.0f})"


def draw_frames(pair: list[tuple[str, Posture]], place: Path) -> Path:
    """Writes `figures/frames.png`: a row for each member, a column for each time."""
    from matplotlib.figure import Figure
    from PIL import Image

    with style.applied():
        steps = [step for step in pair[0][1].frames if step in pair[1][1].frames]
        figure = Figure(figsize=(1.25 * len(steps), 3.2), layout="constrained")
        grid = figure.subplots(2, len(steps), squeeze=False)
        for (label, one), row in zip(pair, grid, strict=True):
            strip = np.asarray(Image.open(MEASUREMENT.folder(place) / one.picture))
            side = strip.shape[0]
            for axes, step in zip(row, steps, strict=True):
                at = side * one.frames.index(step)
                axes.imshow(strip[:, at : at + side])
                axes.set_xticks([])
                axes.set_yticks([])
                axes.grid(False)
                axes.set_title(f"step {step}" if one is pair[0][1] else "", fontsize=8)
            row[0].set_ylabel(f"{label}\nseed {one.seed}", fontsize=8)
        return style.save(figure, place / "figures" / "frames.png")


MEASUREMENT = Measurement(
    "posture",
    "sauna.experiments.measure.posture:compute",
    report,
    points=(1.0,),
    check=check,
    curves=("explained_variance",),
)
