"""How every figure looks: the colour, line and marker of each label, and plain axes.

Matplotlib is imported where it is used: most commands draw nothing.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sauna.system.safe_write import own_folder, replacing

# Okabe and Ito's palette, which the colour-blind can tell apart; an arm always has its colour.
COLOURS = {
    "ppo": "#0072B2",
    "vex-head": "#E69F00",
    "random-drop": "#999999",
    "sauna": "#D55E00",
    "sauna-paper": "#CC79A7",
    "sauna-reference": "#009E73",
    "sauna+random": "#999999",
}
_OTHER_ARMS = ("#882255", "#997700", "#4B5563", "#56B4E9")  # the one near ppo's blue last
_MARKERS = ("o", "s", "D", "^", "v", "P", "X")  # matplotlib's names; the round one is ppo's
_DASHES: tuple[tuple[float, ...], ...] = ((), (6, 2.5), (1.5, 2), (8, 2.5, 1.5, 2.5))
_SHADES = (0.0, 0.45, -0.45, 0.65)  # towards black, white if negative

_RC: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#8A8D91",
    "axes.formatter.limits": (-4, 6),
    "axes.grid": True,
    "axes.labelsize": 9,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "font.size": 9,
    "grid.color": "#E6E6E3",
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "savefig.dpi": 130,
    "svg.fonttype": "none",  # text stays text: small, and it can be searched
    "svg.hashsalt": "sauna",  # ids of elements: the same in every run
    "text.parse_math": False,  # a label is a name, even with a dollar in it
    "xtick.color": "#8A8D91",
    "xtick.labelcolor": "#3D4044",
    "xtick.labelsize": 8,
    "ytick.color": "#8A8D91",
    "ytick.labelcolor": "#3D4044",
    "ytick.labelsize": 8,
}
# What a file would otherwise say of the day and the library's version.
_METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
}


class Look(NamedTuple):
    """How one label is drawn: `dash` in points on and off, `marker` as matplotlib names it."""

    colour: str
    dash: tuple[float, ...]
    marker: str


def looks(arms: Mapping[str, str]) -> dict[str, Look]:
    """Returns `label -> Look`, no two alike, from `label -> arm` in the order of the study.

    An arm's first label has the arm's own colour and a solid line; its further labels (say
    `sauna 0.8`) have shades of it and other dashes and markers.
    """
    unknown = [arm for arm in dict.fromkeys(arms.values()) if arm not in COLOURS]
    drawn: dict[str, int] = {}  # colour -> labels that have it so far
    found = {}
    for label in sorted(arms, key=lambda label: label != arms[label]):
        arm = arms[label]
        if arm in unknown:
            index = unknown.index(arm)
            place, colour = 1 + index % (len(_MARKERS) - 1), _OTHER_ARMS[index % len(_OTHER_ARMS)]
        else:
            place, colour = [*COLOURS].index(arm), COLOURS[arm]
        number = drawn.get(colour, 0)
        drawn[colour] = number + 1
        shade = _SHADES[number % len(_SHADES)]
        found[label] = Look(
            colour=_mix(colour, shade),
            # Moves on when the shades start again, so that the pair is a new one.
            dash=_DASHES[(number + number // len(_SHADES)) % len(_DASHES)],
            marker=_MARKERS[(place + number) % len(_MARKERS)],
        )
    return {label: found[label] for label in arms}


def _mix(colour: str, share: float) -> str:
    """`share` of the way to black, or to white where it is negative."""
    target = 0 if share > 0 else 255
    parts = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{round(part + (target - part) * abs(share)):02X}" for part in parts)


def short(value: float, position: object = None) -> str:
    """Returns `200000 -> 200k`, `1000000 -> 1M`: ticks of env steps."""
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{suffix}"
    return f"{value:g}"


def applied() -> AbstractContextManager[None]:
    """Applies this style to what matplotlib draws within it."""
    import matplotlib

    return matplotlib.rc_context(_RC)


def draw_line(
    axes: Any, look: Look, x: Any, y: Any, low: Any, high: Any, *, label: str = ""
) -> Any:
    """Draws a line with about eight markers and, where `low` and `high` are not NaN, its band."""
    every = max(1, len(x) // 8)
    first = 2 * len(axes.get_lines()) % every  # lines that lie on each other show both markers
    axes.fill_between(x, low, high, color=look.colour, alpha=0.16, linewidth=0)
    (line,) = axes.plot(
        x,
        y,
        color=look.colour,
        linestyle=_dashes(look.dash),
        linewidth=1.8,
        marker=look.marker,
        markersize=4,
        markeredgewidth=0,
        markevery=(first, every),
        label=label,
    )
    return line


def draw_seed(axes: Any, look: Look, x: Any, y: Any, dash: tuple[float, ...] = ()) -> None:
    """Draws a thin line for one seed."""
    axes.plot(x, y, color=look.colour, alpha=0.45, linewidth=0.8, linestyle=_dashes(dash))


def _dashes(dash: tuple[float, ...]) -> Any:
    return (0, dash) if dash else "-"


def count_steps(axes: Any) -> None:
    """Makes the x axis count env steps."""
    axes.set_xlabel("env steps")
    axes.xaxis.set_major_formatter(short)


MIN_BAND = 3  # seeds: below, Student's t makes a band that hides the lines


def fit_axes(axes: Any, lines: Any) -> None:
    """Fits the y axis to `lines` (arrays); bands may add a third of their range on either side."""
    known = [x[np.isfinite(x)] for x in (np.asarray(line, float) for line in lines)]
    values = np.concatenate([*known, np.zeros(0)])
    if not len(values):
        return
    low, high = values.min(), values.max()
    margin = (high - low) / 3 or abs(high) / 10 or 1.0
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low - margin), min(top, high + margin))


def save(figure: Any, path: Path) -> Path:
    """Writes a figure to a file; its bytes depend on what it shows alone."""
    own_folder(path.parent)
    with replacing(path) as temporary:
        figure.savefig(temporary, metadata=_METADATA[path.suffix])
    return path


def as_svg(figure: Any) -> bytes:
    """Draws a figure as SVG; its bytes depend on what it shows alone.

    Coordinates keep two decimals of a point, which halves a page of many panels; texts, which end
    in `<`, keep all of theirs.
    """
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata=_METADATA[".svg"])
    return re.sub(rb"(\d\.\d\d)\d+(?![\d<])", rb"\1", file.getvalue())
