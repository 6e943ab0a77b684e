"""The page of `sauna inspect`: one HTML file that needs no network and no other file."""

from __future__ import annotations

import base64
import shlex
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from sauna.algorithm.rollout.collected import capacity
from sauna.experiments.inspect.inspection import Inspection, pixel_stride
from sauna.experiments.inspect.rules import rule_lines, rule_meaning, rule_notes, words
from sauna.experiments.report.page import asset, render, rounded

SETTINGS = (
    "filter",
    "threshold",
    "threshold_schedule",
    "keep_rate_target",
    "drop_rate",
    "history",
    "decision",
    "dropped",
    "vex_target",
    "vex_coef",
    "sampler",
    "sampler_kwargs",
    "selection_mode",
    "selection_losses",
    "loss_weight",
    "loss_weight_kwargs",
    "objective",
    "stop",
    "critic",
    "advantage_sign",
    "normalize_over",
    "control",
    "rollout_steps",
    "envs",
    "gae_over",
    "truncation",
    "gamma",
    "gae_lambda",
    "normalize_observations",
    "normalize_rewards",
    "sign_rewards",
)


def make_page(found: Inspection, run: Path) -> str:
    """Renders the page as text."""
    config = found.member.config
    return render(
        "inspect",
        asset("inspect.css"),
        asset("draw.js") + asset("inspect.js"),
        page_data(found),
        title=f"{config.env}, {found.member.name}",
        scope=scope(found),
        notes=notes(found),
        frames=bool(found.played.frames),
        states=states(found),
        scatter=found.points is not None,
        meaning=meaning(found),
        settings=[("Setting", "Value"), *((n, str(getattr(config, n))) for n in SETTINGS)],
        command=command(found, run),
    )


def compares(found: Inspection) -> bool:
    """Returns whether the head's prediction is compared with an edge: a rule that can drop
    steps."""
    return bool(found.hypers.threshold > 0) and bool(np.isfinite(found.decisions.edge).any())


def shows_vex(found: Inspection) -> bool:
    return found.head or compares(found)


def page_data(found: Inspection) -> dict[str, Any]:
    """Returns what the script draws: a value per env step in every list of `series` and of the
    panels."""
    played, decisions, config = found.played, found.decisions, found.member.config
    value, advantage = found.value.astype(float), found.advantage
    scaled = " (normalised)" if config.normalize_rewards else ""
    ends = np.flatnonzero(played.terminated | played.truncated)
    lines = {
        "value": ("V", value),
        "return": ("GAE return", advantage + value),
        "advantage": ("advantage", advantage),
        "reward": ("reward", found.reward),
        "raw_reward": ("raw reward", played.reward),
    }
    panels: list[dict[str, Any]] = [
        {"name": "value", "title": f"Value and GAE return{scaled}", "lines": ["value", "return"]},
        {"name": "advantage", "title": f"Advantage{scaled}", "lines": ["advantage"]},
        {"name": "reward", "title": f"Reward{scaled}", "lines": ["reward"]},
    ]
    by_rules, shown = rule_lines(found)
    panels, lines = [*shown, *panels], by_rules | lines
    if shows_vex(found):
        panels.insert(0, {"name": "vex", "title": "Vex, predicted", "lines": ["vex"]})
        vex = {"vex": ("Vex", decisions.prediction.astype(float))}
        if compares(found):
            middle = "running median" + " of |Vex|" * (config.keep_rate_target > 0)
            highest = 1.1 * np.abs(decisions.prediction).max()  # an edge may be infinite
            edge = np.minimum(decisions.edge, highest)
            vex |= {"median": (middle, decisions.median), "edge": ("dropped below", edge)}
            panels[0] |= {"lines": ["vex", "median"], "band": "edge"}
        lines = vex | lines
    return {
        "steps_per_second": found.steps_per_second,
        "starts": [0, *(ends[:-1] + 1).tolist()],
        "returns": rounded(played.returns),
        "rollouts": decisions.rollouts,
        "keep": found.taken.astype(int).tolist(),
        "words": words(found),
        "labels": {name: label for name, (label, _) in lines.items()},
        "series": {name: rounded(values.tolist()) for name, (_, values) in lines.items()},
        "panels": panels,
        "points": [] if found.points is None else rounded(found.points.T.tolist()),
        "frames": {
            "rows": [row for row, _ in played.frames],
            "images": [base64.b64encode(data).decode() for _, data in played.frames],
        },
    }


def scope(found: Inspection) -> str:
    """Returns what was played, in one line."""
    played, episodes = found.played, len(found.played.returns)
    returns = ", ".join(f"{value:,.1f}" for value in played.returns[:5])
    more = ", ..." if episodes > 5 else ""
    dropped = f"{int((~found.taken).sum()):,} {words(found)[1]}"
    return " \N{MIDDLE DOT} ".join(
        [
            f"{found.mode} actions",
            f"trained for {found.env_steps:,} env steps",
            f"{episodes} episode{'s' * (episodes > 1)}, return {returns}{more}",
            f"{len(played.reward):,} env steps, {dropped}",
        ]
    )


def notes(found: Inspection) -> list[str]:
    """Returns what a reader must know before the page is looked at."""
    config, arm, kept = found.member.config, found.member.arm, float(found.decisions.keep.mean())
    said = []
    if not shows_vex(found):
        keeps = ", and keeps every step" * (config.filter == "none" and found.learned is None)
        said.append(f"There is no Vex prediction: {arm} trains no Vex head{keeps}.")
    elif not found.head:
        said.append(
            "The Vex head was not trained (vex_coef 0): its predictions are those of its "
            "first weights."
        )
    if found.decisions.keep.all() and shows_vex(found):
        rule = "no step falls below the threshold" if compares(found) else f"{arm} keeps all"
        said.append(f"Nothing is dropped: {rule}.")
    elif not found.decisions.keep.all() and "keep_rate" in found.last:
        trained = found.last["keep_rate"]
        said.append(f"Keep rate here {kept:.3f}; in the last iteration of training {trained:.3f}.")
    if config.filter not in ("none", "sauna", "random-drop"):
        said.append(
            f"The filter is {config.filter}: what it drops is shaded, its rule is not drawn."
        )
    if config.filter == "random-drop":
        said.append(
            f"random-drop: each step is dropped with a chance of "
            f"{found.hypers.drop_rate:.3f}, whatever the head says."
        )
    if config.control != "none" and config.filter != "none":
        said.append(
            f"The control {config.control} chooses: of each environment and rollout as many steps "
            f"as the filter {config.filter} keeps there."
        )
    said += rule_notes(found)
    if found.environments > 1 and found.learned is None:
        said.append(
            f"Decisions look at {found.environments} environments together; environment 0 is shown."
        )
    if not found.played.frames:
        said.append("There are no frames.")
    return said


def states(found: Inspection) -> str:
    """Returns what the scatter shows, in words."""
    if found.points is None:
        return "Left out: the observations are too large for it."
    shares = " and ".join(f"{100 * share:.0f}%" for share in found.shares)
    return (
        f"What the network saw at each step, along its first two principal components "
        f"({shares} of the variance{_thinned(found)}). Point at a state to go to its step."
    )


def _thinned(found: Inspection) -> str:
    every = pixel_stride(found.played.observation)
    return f", of one row and column of pixels in {every}" if every > 1 else ""


def meaning(found: Inspection) -> list[Markup]:
    """Returns what the lines are, and their units; no value comes from a run but numbers."""
    config = found.member.config
    said = rule_meaning(found)
    if shows_vex(found):
        several = config.filter == "sauna" and config.decision == "joint" and config.envs > 1
        said.append(
            "<b>Vex</b>: the head's prediction of the explained variance"
            + (f", mean over {config.envs} environments." if several else ".")
        )
    if compares(found):
        has_target = config.keep_rate_target > 0
        rule = (
            f"below the quantile of the rollout's earlier ones that is moved at every step to keep "
            f"{config.keep_rate_target:g} of all"
            if has_target
            else f"below {float(found.hypers.threshold):g} times |median|"
        )
        said.append(
            f"<b>Running median</b>: of the rollout's earlier predictions "
            f"({'all of them' if config.history == 'all' else 'those of kept steps'}"
            f"{', without their sign' * has_target}). A step is <b>dropped</b> if |Vex| is {rule}, "
            f"inside the band. A rollout ends {_end_of_rollout(found)}; the next one begins with "
            f"an empty history (dashed upright line)."
        )
    unit = (
        "Value, GAE return, advantage and reward are in the units that the value function learns: "
        "rewards divided by the standard deviation of the discounted return, frozen as in the "
        "checkpoint. The raw reward is the environment's."
        if config.normalize_rewards
        else "Value, GAE return, advantage and reward are in "
        + ("signs of rewards." if config.sign_rewards else "the environment's raw units.")
    )
    over = " GAE runs over kept steps only, as in this arm's training." * (
        config.gae_over == "kept"
    )
    said.append(unit + over)
    said.append(
        "Observations are normalised by the checkpoint's statistics, frozen, as in evaluation."
        if config.normalize_observations
        else "Observations are as the environment gives them."
    )
    if len(found.played.returns) > 1:
        said.append("Solid upright lines: a new episode.")
    return [Markup(text) for text in said]


def _end_of_rollout(found: Inspection) -> str:
    config = found.member.config
    if config.dropped == "mask":
        return f"after {config.rollout_steps:,} env steps"
    return f"with its {config.rollout_steps:,}th kept step, or after {capacity(config):,} env steps"


def command(found: Inspection, run: Path) -> str:
    flags = f" --episodes {len(found.played.returns)} --seed {found.seed}"
    flags += " --deterministic" * (found.mode == "deterministic")
    return f"sauna inspect {shlex.quote(str(run))} --member {found.member.name}{flags}"
