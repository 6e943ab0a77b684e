"""What the page says of a run's rules: which samples they take, in words and as lines."""

from __future__ import annotations

from typing import Any

import numpy as np

from sauna.config.settings import Config
from sauna.experiments.inspect.inspection import Inspection

# Rules that take no subset, by field and plain value: what they do instead.
ELSEWHERE = {
    ("objective", "clip"): "changes the form of each policy term",
    ("stop", "none"): "says when the gradient steps of an iteration end",
    ("critic", "squared"): "changes the value loss",
    ("recompute_advantages", False): "computes values and advantages anew before each epoch",
    ("auxiliary", "none"): "trains a further head along",
}


def words(found: Inspection) -> tuple[str, str]:
    """Returns what a step is called that is learned from, and one that is not."""
    config = found.member.config
    if found.learned is not None and found.learned.draws is not None:
        return "drawn", "not drawn"
    if config.sampler != "none" or config.loss_weight != "none":
        return "taken", "left out"
    return "kept", "dropped"


def rule_lines(found: Inspection) -> tuple[dict[str, tuple[str, np.ndarray]], list[dict[str, Any]]]:
    """Returns the lines of the learner's rules, `(label, [L])` by name, and their panels."""
    if found.learned is None:
        return {}, []
    config, made = found.member.config, found.learned
    panels = {
        "score": (f"Score by {config.sampler}", {"score": "score"}),
        "draws": (f"Draws of an epoch, expected by {config.sampler}", {"draws": "draws"}),
        "weight": (f"Weight by {config.sampler}", {"weight": "weight"}),
        "loss_weight": (
            f"Weight by {config.loss_weight}",
            {"last_weight": "after the update", "first_weight": "before it"},
        ),
    }
    lines: dict[str, tuple[str, np.ndarray]] = {}
    shown = []
    for name, (title, labels) in panels.items():
        there = [column for column in labels if getattr(made, column) is not None]
        if there:
            shown.append({"name": name, "title": title, "lines": there})
            lines |= {n: (labels[n], getattr(made, n)) for n in there}
    return lines, shown


def rule_notes(found: Inspection) -> list[str]:
    """Returns what a reader must know of the learner's rules."""
    config = found.member.config
    return [*_sampler_notes(found), *_weight_notes(config), *_other_notes(found)]


# What a rule's lines are, by name.
MEANING = {
    "score": "<b>Score</b>: what the sampler ranks steps by.",
    "draws": "<b>Draws</b>: how often an epoch draws a step on average.",
    "weight": "<b>Weight by the sampler</b>: what the step's policy term is multiplied by.",
    "last_weight": "<b>Weight by the loss</b>: what the step's policy term is multiplied by, "
    "before the rollout's update and after. A weight on the mean alone multiplies its gradient.",
}


def rule_meaning(found: Inspection) -> list[str]:
    """Returns what the lines of the learner's rules are."""
    lines, _ = rule_lines(found)
    return [text for name, text in MEANING.items() if name in lines]


def _sampler_notes(found: Inspection) -> list[str]:
    config, said = found.member.config, []
    if config.sampler != "none":
        share = float(found.taken.mean())
        rate = found.last.get("sample_rate")
        trained = "" if rate is None else f"; sample rate in the last iteration {rate:.3f}"
        verb = words(found)[0]
        who = "Sampler" if config.control == "none" else f"Control {config.control} of the sampler"
        said.append(
            f"{who} {config.sampler}: {share:.3f} of these steps are {verb} in the first epoch "
            f"of a rollout{trained}. It decides about whole rollouts: {config.rollout_steps:,} "
            f"steps of {_environments(config.envs)}. Those behind the last episode are played and "
            f"not shown."
        )
        if config.selection_losses == "policy":
            said.append("This holds for the policy. Value and Vex heads learn from every step.")
    if config.advantage_sign == "positive":
        said.append(
            "The policy learns from steps of positive advantage alone. Value and Vex heads learn "
            "from every step."
        )
    if config.sampler != "none" and config.control != "none":
        said.append(
            f"The control {config.control} chooses, as many steps as {config.sampler} would."
        )
    return said


def _weight_notes(config: Config) -> list[str]:
    if config.loss_weight == "none":
        return []
    said = [
        f"Loss weight {config.loss_weight}: as if a rollout of {config.rollout_steps:,} steps of "
        f"{_environments(config.envs)} were one minibatch, before its update (all ratios are 1) "
        f"and after. A step that weighs 0 afterwards counts as left out."
    ]
    if config.control != "none":
        said.append(f"The control {config.control} deals the weights to other steps.")
    return said


def _other_notes(found: Inspection) -> list[str]:
    config = found.member.config
    said = [
        f"{_value(config, name)} {does}"
        for (name, plain), does in ELSEWHERE.items()
        if getattr(config, name) != plain
    ]
    if not said:
        return []
    note = f"No subset is taken by: {'; '.join(said)}."
    if found.learned is None and config.filter == "none":
        note += " Every step is learned from."
    if config.critic == "avec":
        note += " AVEC's constant, which training adds to V, is left out here."
    return [note]


def _value(config: Config, name: str) -> str:
    value = getattr(config, name)
    return "recompute" if value is True else str(value)


def _environments(number: int) -> str:
    return f"{number} environment" + "s" * (number > 1)
