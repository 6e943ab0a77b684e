"""Arms: which rules a run trains with, what a name fixes, and rules joined by `+`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sauna.system.errors import BadInput, nearest

ARMS: dict[str, dict[str, Any]] = {
    "ppo": {"filter": "none", "vex_coef": 0.0},
    "vex-head": {"filter": "none"},
    "random-drop": {"filter": "random-drop"},
    "sauna": {"filter": "sauna", "vex_target": "sample"},
    "sauna-paper": {"filter": "sauna", "vex_target": "rollout"},
    "sauna-reference": {
        "filter": "sauna",
        "vex_target": "minibatch",
        "history": "kept",
        "decision": "joint",
        "gae_over": "kept",
        "truncation": "terminate",
        "budget": "kept",
        # The released loop has no bound and can run for ever; this one is rarely reached.
        "max_env_steps_factor": 16,
    },
}

# A rule that ranks by |A| or by its sign leaves advantages whose mean is not 0: they are
# standardised over the rollout before the choice, so that no advantage changes its sign.
_PPO = {"filter": "none", "vex_coef": 0.0}
_OVER_ROLLOUT = {**_PPO, "normalize_over": "rollout"}
ARMS |= {
    "gigaflow": {**_OVER_ROLLOUT, "sampler": "gigaflow"},
    "top-advantage": {**_OVER_ROLLOUT, "sampler": "top-advantage"},
    "prioritized": {**_OVER_ROLLOUT, "sampler": "prioritized"},
    "gradient-norm": {**_OVER_ROLLOUT, "sampler": "gradient-norm"},
    "delight": {**_OVER_ROLLOUT, "loss_weight": "delight"},
    "kondo": {**_OVER_ROLLOUT, "sampler": "kondo", "selection_losses": "policy"},
    "sample-dropout": {**_PPO, "loss_weight": "sample-dropout"},
    "espo": {**_PPO, "objective": "unclipped", "stop": "espo"},
    "target-kl": {**_PPO, "stop": "target-kl"},
    "spo": {**_PPO, "objective": "spo"},
    "positive": {**_PPO, "advantage_sign": "positive"},
    "recompute": {**_PPO, "recompute_advantages": True},
    "avec": {**_PPO, "critic": "avec", "clip_value": False},
    "merl": {"filter": "none", "vex_target": "sample", "auxiliary": "next-observation"},
    "pods": {**_OVER_ROLLOUT, "sampler": "pods"},
    "vex-oracle": {**_OVER_ROLLOUT, "sampler": "vex-oracle"},
}
# Controls follow the rule that they are joined to: `gigaflow+random`.
CONTROLS = ("random", "stride", "low-advantage", "reversed")
RANDOM_CONTROL = "+random"  # ends the name of an arm that is another's matched random control

ARM_HELP = {
    "ppo": "PPO (or A2C) alone: no Vex loss, nothing dropped",
    "vex-head": "the Vex head is trained, nothing is dropped",
    "random-drop": "as SAUNA, but drops at random at a given rate (a control)",
    "sauna": "the corrected method: every state has its own Vex target",
    "sauna-paper": "the method as the paper states it",
    "sauna-reference": "the method as the authors' released code does it, quirks included",
    "gigaflow": "rollout: drop samples far below the running largest |advantage|",
    "top-advantage": "rollout: keep the half of largest |advantage|",
    "prioritized": "rollout: draw minibatches by |advantage|, weighted back",
    "gradient-norm": "rollout: draw minibatches by the norm of the gradient at the policy head",
    "delight": "loss: weigh a sample by advantage times surprisal",
    "kondo": "rollout: the policy learns from the 30% of largest advantage times surprisal",
    "sample-dropout": "loss: leave out policy terms whose ratio has gone far from 1",
    "espo": "stop: no clip; stop once the mean |ratio - 1| is 0.25",
    "target-kl": "stop: stop once the KL divergence is 1.5 times 0.02",
    "spo": "loss: a penalty on the ratio in place of the clip",
    "positive": "loss: learn from max(0, advantage) alone",
    "recompute": "epoch: advantages anew before each epoch",
    "avec": "critic: fit the variance of the error instead of its square",
    "merl": "critic: heads for the explained variance and the next observation are trained along",
    "pods": "rollout: the half of the 64-step segments whose advantages vary most",
    "vex-oracle": "rollout: SAUNA's test (eq. 7) on its quantity known afterwards",
}
STAGES = ("collect", "rollout", "epoch", "loss", "stop", "critic")
# What `sauna list rules` shows: `stage: sentence`.
RULE_HELP = {
    "sauna": "collect: keep a step if its predicted explained variance is informative (eq. 7)",
    **{name: text for name, text in ARM_HELP.items() if text.split(": ")[0] in STAGES},
}
# The default `share` of samplers that have one.
SHARES = {
    "top-advantage": 0.5,
    "prioritized": 1.0,
    "gradient-norm": 1.0,
    "kondo": 0.3,
    "pods": 0.5,
}
CONTROL_HELP = {
    "random": "control: as many samples as the rule takes in each iteration, at random",
    "stride": "control: as many, every k-th",
    "low-advantage": "control: as many, those of smallest |advantage|",
    "reversed": "control: as many, those that the rule wants least",
}


def arm_settings(arm: str) -> dict[str, Any]:
    """The settings of an arm, or of several rules joined by `+`: `sauna+avec`, `gigaflow+random`.

    A part of a joined arm adds what it changes of `ppo`; the last part may be a control.

    Raises:
      BadInput: an unknown name (naming the nearest), or two parts that want different things.
    """
    first, *others = arm.split("+")
    if len({first, *others}) <= len(others):
        raise BadInput(f"arm: {arm} joins a rule to itself")
    settings = dict(_part(first))
    changed = {name for name, value in settings.items() if ARMS["ppo"].get(name) != value}
    for part in others:
        added = {"control": part} if part in CONTROLS else _part(part)
        for name, value in added.items():
            if ARMS["ppo"].get(name) == value:
                continue
            if name in changed and settings[name] != value:
                raise BadInput(f"arm: {arm} joins {name} {settings[name]} and {name} {value}")
            settings[name] = value
            changed.add(name)
    return settings


def _part(name: str) -> Mapping[str, Any]:
    if name in CONTROLS:
        raise BadInput(f"arm: {name} follows a rule; join it to one, such as gigaflow+{name}")
    if ":" in name:
        raise BadInput(
            f"arm: {name} is a rule of your own: give --arm ppo --sampler {name}, or --arm sauna "
            f"--filter {name}; `sauna compare ENV --arms ppo,{name}` takes it as it is"
        )
    if name not in ARMS:
        raise BadInput(f"unknown arm {name!r} (known: {', '.join(ARMS)}){nearest(name, ARMS)}")
    return ARMS[name]


# What makes an arm what its name says; the user's own values do not apply to these.
BARE = ("filter", "vex_coef")
FIXED: dict[str, tuple[str, ...]] = {
    "ppo": BARE,
    "vex-head": ("filter",),
    "random-drop": ("filter",),
    "merl": ("filter", "auxiliary"),
    **{arm: (*BARE, "sampler") for arm, settings in ARMS.items() if "sampler" in settings},
    **dict.fromkeys(("delight", "sample-dropout"), (*BARE, "loss_weight")),
    "espo": (*BARE, "objective", "stop"),
    "target-kl": (*BARE, "stop"),
    "spo": (*BARE, "objective"),
    "positive": (*BARE, "advantage_sign"),
    "recompute": (*BARE, "recompute_advantages"),
    "avec": (*BARE, "critic"),
}


def fixed_by(arm: str) -> set[str]:
    """Names the fields that an arm fixes, which may be several joined by `+`.

    What joined arms lack in common (`sauna+avec` has a filter) is fixed by none of them.
    """
    parts = arm.split("+")
    rules = [set(FIXED.get(part, ())) for part in parts if part not in CONTROLS]
    bare = set.intersection(*rules) & set(BARE)
    own = set.union(*rules) - set(BARE)
    return bare | own | ({"control"} if len(rules) < len(parts) else set())
