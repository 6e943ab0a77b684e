"""`docs/results/zoo.md`: what `sauna train ENV` gives, beside RL Zoo's published returns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from studies import listed, load, markdown, page
from zoo import BY_SPACES, EVERY, SHORTER, TRAINED, plan_of, planned

from sauna.config.zoo import ENVS, PUBLISHED, entry_of, shown_published
from sauna.experiments.report import style

COLUMNS = 4  # panels side by side
# RL Zoo's `rl_zoo3/enjoy.py` samples the actions in MiniGrid.
SAMPLED = (
    "RL Zoo samples the actions here, and we take the most likely ones. Sampled, the last 100 "
    "training episodes of each seed have the returns {sampled}."
)
# Why a return is below the published one by more than the published spread.
WORDS = {
    "Ant-v5": "`Ant-v5` shows contact forces and charges for them. Gymnasium's page says that in "
    "`Ant-v3` they may have been 0.",
    "BipedalWalker-v3": "RL Zoo's return is that of one policy, and its spread is over that "
    "policy's episodes. One of our three seeds lies above it.",
    "BipedalWalkerHardcore-v3": "it was trained for 5% of RL Zoo's env steps.",
    "MiniGrid-DoorKey-5x5-v0": f"{SAMPLED} With the most likely actions, one seed does not reach "
    "the goal in 2 of its 20 episodes.",
    "MiniGrid-KeyCorridorS3R1-v0": f"{SAMPLED} With the most likely actions, one seed does not "
    "reach the goal in 1 of its 20 episodes.",
    "MiniGrid-RedBlueDoors-6x6-v0": f"{SAMPLED} With the most likely actions, many episodes "
    "open the wrong door first or never end.",
    "MiniGrid-Unlock-v0": f"{SAMPLED} With the most likely actions, one seed does not reach the "
    "goal in 4 of its 20 episodes.",
    "gymnax/Breakout-MinAtar": "each seed settles in the first half of the training, at its own "
    "level. Sampled, the last 100 training episodes of each seed have the returns {sampled}.",
}


def zoo_page(units: Mapping[str, Any]) -> str:
    """The page, from the units of `results/zoo.json`."""
    done = [env for env in EVERY if env in units]
    missing = [env for env in EVERY if env not in units]
    below = [f"`{env}`: {_word(env, units[env])}" for env in done if needs_word(env, units[env])]
    figure = "![Training curves of three seeds each](figures/zoo.svg)\n\n" + CAPTION
    return page(
        "zoo",
        figure=figure if done else "",
        table=markdown([HEAD, *(_row(env, units[env]) for env in done)]),
        words=listed(below) if below else "None so far.",
        seconds=_seconds(),
        shorter=" ".join(map(_shorter, SHORTER)),
        planned=f"{len(TRAINED)} of the {len(ENVS)} environments",
        by_spaces=", ".join(f"`{env}`" for env in BY_SPACES),
        missing=markdown(
            [["Environment", "Preset", "Env steps", "RL Zoo", "Why"], *map(_missing, missing)]
        ),
    )


CAPTION = """*Training return of the last 100 episodes (actions sampled), three seeds. Grey:
the return and the spread that RL Zoo publishes.*"""
HEAD = [
    "Environment",
    "Preset",
    "Env steps",
    "Return of each seed",
    "Mean and spread",
    "RL Zoo",
    "CPU minutes",
]


def _row(env: str, unit: Mapping[str, Any]) -> list[str]:
    returns = list(unit["returns"].values())
    digits = 1 if max(map(abs, returns)) >= 10 else 3
    return [
        f"`{env}`",
        f"`{unit['preset']}`",
        f"{unit['steps']:,}",
        ", ".join(f"{value:,.{digits}f}" for value in returns),
        f"{np.mean(returns):,.{digits}f} ± {np.std(returns, ddof=1):,.{digits}f}",
        _published(env),
        f"{unit['cpu_seconds'] / 60:.1f}",
    ]


def _published(env: str) -> str:
    return shown_published(env).replace("+-", "±") or "-"


def _missing(env: str) -> list[str]:
    entry = planned(env)
    return [f"`{env}`", f"`{entry.preset}`", f"{entry.steps:,}", _published(env), plan_of(env)]


def _shorter(env: str) -> str:
    entry = entry_of(env)
    assert entry is not None
    return f"`{env}`: {SHORTER[env]:,} instead of {entry.steps:,}."


def is_below(env: str, unit: Mapping[str, Any]) -> bool:
    """Whether the mean of the seeds is below the published one by more than the published spread.

    The spread of the seeds does not count: the less they agree, the less would be below.
    """
    published = PUBLISHED.get(env)
    if published is None:
        return False
    return bool(np.mean(list(unit["returns"].values())) < published.mean - published.std)


def is_split(unit: Mapping[str, Any]) -> bool:
    """Whether the worst seed has less than half of the best one's return, if that is positive."""
    returns = list(unit["returns"].values())
    return bool(max(returns) > 0 and min(returns) < 0.5 * max(returns))


def needs_word(env: str, unit: Mapping[str, Any]) -> bool:
    """Whether the page has to explain a return: it is below the published one, or seeds differ."""
    return is_below(env, unit) or is_split(unit)


def _word(env: str, unit: Mapping[str, Any]) -> str:
    sampled = ", ".join(
        f"{curve['return'][-1]:,.3f}" for _, curve in sorted(unit["curves"].items())
    )
    return WORDS.get(env, "**not explained yet**.").format(sampled=sampled)


def _seconds() -> str:
    """Training seconds beside Stable-Baselines3's; empty if they were not measured."""
    found = load("zoo_seconds")
    if not found:
        return ""
    rows = [["Environment", "Seconds here", "Seconds, SB3", "Return here", "Return, SB3"]]
    for env, pair in found["tasks"].items():
        numbers = [pair[side][name] for name in ("seconds", "return") for side in ("ours", "sb3")]
        rows.append([f"`{env}`", *(f"{number:,.1f}" for number in numbers)])
    text = (
        f"## Seconds next to Stable-Baselines3\n\nThe same numbers, {found['seeds']} seeds of "
        f"{found['steps']:,} env steps, two processes, one side after the other. Seconds are those "
        "from the command to its end, with imports and compilation. A return is the mean training "
        "return of the last 100 episodes."
    )
    return f"{text}\n\n{markdown(rows)}"


def draw_zoo(units: Mapping[str, Any], path: Path) -> Path:
    """Draws the training curves of every unit, with RL Zoo's return as a line and a band."""
    from matplotlib.figure import Figure

    done = [env for env in EVERY if env in units]
    rows = -(-len(done) // COLUMNS)
    look = style.looks({"ppo": "ppo"})["ppo"]
    with style.applied():
        figure = Figure(figsize=(3.2 * COLUMNS, 2.2 * rows), layout="tight")
        panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        for axes, env in zip(panels, done, strict=False):
            lines = [curve["return"] for curve in units[env]["curves"].values()]
            if published := PUBLISHED.get(env):
                low, high = published.mean - published.std, published.mean + published.std
                axes.axhspan(low, high, color="#999999", alpha=0.2, linewidth=0)
                axes.axhline(published.mean, color="#666666", linewidth=0.8)
                lines.append([published.mean])
            for curve in units[env]["curves"].values():
                axes.plot(curve["env_steps"], curve["return"], color=look.colour, linewidth=1.2)
            style.fit_axes(axes, lines)
            axes.set_title(env)
            axes.xaxis.set_major_formatter(style.short)
        for axes in panels[len(done) :]:
            axes.set_axis_off()
        path.write_bytes(style.as_svg(figure))
    return path
