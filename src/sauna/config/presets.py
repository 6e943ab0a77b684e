"""Named settings: presets, arms (which selection method), and how a run's config is resolved.

A preset says how an algorithm trains; an arm says which rules a run trains with. METHOD, in
`docs/concepts/ppo.md`, gives the origin of every number.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from sauna.config.checks import check_consistent, check_read, is_read
from sauna.config.other_names import key_hint
from sauna.config.settings import FIELDS, Config, fields_with, parse
from sauna.config.task_presets import TASK_PRESET_HELP, TASK_PRESETS
from sauna.config.zoo import AUTO, MUJOCO, entry_for
from sauna.system.errors import BadInput, nearest

# Schulman et al. (2017) and OpenAI baselines' defaults for MuJoCo are `Config`'s own defaults.
PRESETS: dict[str, dict[str, Any]] = {
    "mujoco": {},
    # The SAUNA authors' run script: more epochs and a constant learning rate.
    "mujoco-release": {"epochs": 15, "learning_rate_schedule": "constant"},
    # Schulman et al. (2017) on Roboschool's Flagrun tasks: minibatches of 4096 of 512 x 32 steps.
    # Their log-std was annealed and their step size followed the KL divergence; here the log-std
    # is learned and the step size falls linearly, as everywhere else.
    "flagrun": {"envs": 32, "rollout_steps": 512, "minibatches": 4, "epochs": 15},
    # Schulman et al. (2017) on Atari, as in OpenAI baselines (whose clip range also falls to 0).
    "atari": {
        "envs": 8,
        "rollout_steps": 128,
        "minibatches": 4,
        "epochs": 3,
        "learning_rate": 2.5e-4,
        "clip_range": 0.1,
        "entropy_coef": 0.01,
        "value_coef": 1.0,
        "trunk": "shared",
        "sign_rewards": True,
        "normalize_rewards": False,
    },
    # PureJaxRL's settings for gymnax's MinAtar (examples/brax_minatar.ipynb): two 64-64 MLPs on
    # the flattened picture. Theirs are for 10^7 steps, over which the step size falls to 0.
    "minatar": {
        "envs": 64,
        "rollout_steps": 128,
        "minibatches": 8,
        "epochs": 4,
        "learning_rate": 5e-3,
        "entropy_coef": 0.01,
        "activation": "relu",
        "normalize_observations": False,
        "normalize_rewards": False,
    },
    # Mnih et al. (2016) in its synchronous form, with OpenAI baselines' defaults (`a2c.py`).
    # Lambda 1 makes n-step returns. A checkpoint comes after as many env steps as with PPO.
    "a2c": {
        "algorithm": "a2c",
        "envs": 16,
        "rollout_steps": 5,
        "minibatches": 1,
        "epochs": 1,
        "learning_rate": 7e-4,
        "optimizer": "rmsprop",
        "normalize_advantages": False,
        "entropy_coef": 0.01,
        "gae_lambda": 1.0,
        "trunk": "shared",
        "checkpoint_every": 1280,
    },
}
PRESETS["a2c-atari"] = {**PRESETS["a2c"], "sign_rewards": True, "normalize_rewards": False}
PRESETS["a2c-mujoco"] = {**PRESETS["a2c"], "entropy_coef": 0.0, "trunk": "separate"}
PRESETS |= TASK_PRESETS

# Tasks with published results: MuJoCo's actions stay in the robot's own units, as there, if nobody
# says otherwise (the other tasks here have boxes of [-1, 1], or no boxes).
PUBLISHED = re.compile(
    r"^(?:ALE|sauna|mjx|brax|playground)/|^gymnax/.*-MinAtar$|"
    rf"^(?:[\w.]+:)?(?:{MUJOCO})-v\d+$"
)
# What was done before a field existed, if that is not its default.
BEFORE = {"rescale_actions": False}

# The preset of an algorithm where none is named.
FIRST = {"ppo": "mujoco", "a2c": "a2c"}

PRESET_HELP = {
    "mujoco": "PPO on MuJoCo as published (Schulman et al. 2017, OpenAI baselines)",
    "mujoco-release": "the same as the SAUNA authors ran it: 15 epochs, constant learning rate",
    "flagrun": "PPO on HumanoidFlagrunHarder: 32 actors, 512 steps each, minibatches of 4096",
    "atari": "PPO on Atari as published: Nature CNN, 8 games, signs of rewards",
    "minatar": "PPO on gymnax's MinAtar as PureJaxRL runs it: 64 environments, 64-64 MLPs",
    "a2c": "A2C's numbers as published (Mnih et al. 2016, baselines): 16 actors, 5 steps each",
    "a2c-atari": "the same on Atari: signs of rewards, none of them normalised",
    "a2c-mujoco": "the same for continuous control: separate trunks, no entropy bonus",
    **TASK_PRESET_HELP,
}

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
# standardised over the rollout before the choice, so that the rule turns no sign round.
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
    "vex-oracle": "rollout: keep where SAUNA's quantity, known afterwards, is high",
}
STAGES = ("collect", "rollout", "epoch", "loss", "stop", "critic")
# What `sauna list rules` shows: `stage: sentence`.
RULE_HELP = {
    "sauna": "collect: keep a step if its predicted explained variance is informative (eq. 7)",
    **{name: text for name, text in ARM_HELP.items() if text.split(": ")[0] in STAGES},
}
CONTROL_HELP = {
    "random": "control: as many samples as the rule takes in each iteration, at random",
    "stride": "control: as many, every k-th",
    "low-advantage": "control: as many, those of smallest |advantage|",
    "reversed": "control: as many, those that the rule wants least",
}

FILTER_HELP = {
    "none": "keep everything",
    "sauna": "keep where |Vex| / |median of earlier Vex| reaches the threshold (eq. 7)",
    "random-drop": "drop at random at a given rate",
}
TARGET_HELP = {
    "rollout": "eq. 5 over one actor's rollout, one number for all its states (the paper)",
    "minibatch": "1 - Var(R - V) / Var(R) over each minibatch (the released code)",
    "episode": "eq. 5 over each segment of one episode",
    "sample": "each state's own share of eq. 5",
}

# The arms of a comparison where none are named; the first is the baseline.
COMPARED = ("ppo", "vex-head", "sauna+random", "sauna")
COMPARED_SEEDS = 6


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
    if name not in ARMS:
        raise BadInput(f"unknown arm {name!r} (known: {', '.join(ARMS)}){nearest(name, ARMS)}")
    return ARMS[name]


# What makes an arm what its name says; the user's own values do not apply to these.
FIXED: dict[str, tuple[str, ...]] = {
    "ppo": ("filter", "vex_coef"),
    "vex-head": ("filter",),
    "random-drop": ("filter",),
}


class Member(NamedTuple):
    """One seed of one arm: what a population is made of."""

    name: str
    arm: str
    seed: int
    config: Config


class RunConfig(NamedTuple):
    """The settings of a run, resolved.

    Attributes:
      config: what the program of all members is compiled from.
      arms: each arm's config, which differs from it in values that are traced.
    """

    config: Config
    arms: dict[str, Config]

    @property
    def members(self) -> list[Member]:
        """Lists all members, arm by arm and seed by seed; each with its own arm's config."""
        return [
            Member(f"{arm}/{seed}", arm, seed, self.arms[arm])
            for arm in self.config.arm
            for seed in self.config.seeds
        ]

    def replace(self, **changes: Any) -> RunConfig:
        """Changes settings of the program and of all arms."""
        arms = {arm: dataclasses.replace(own, **changes) for arm, own in self.arms.items()}
        return RunConfig(dataclasses.replace(self.config, **changes), arms)


def resolve(overrides: Mapping[str, Any]) -> Config:
    """Resolves the config that all members of a run share; see `resolve_run`."""
    return resolve_run(overrides).config


def resolve_run(overrides: Mapping[str, Any]) -> RunConfig:
    """Resolves a run: defaults < preset < arm < what the user gives.

    With several arms, the program-shaping values are those of the arm that filters.

    Raises:
      BadInput: an unknown key, arm or preset (naming the nearest), or impossible values.
    """
    parsed = parse_all(overrides)
    arms = parsed.get("arm", FIELDS["arm"].default)
    _check_arms(arms, parsed)
    configs = {arm: arm_config(arm, parsed) for arm in arms}
    check_read(list(configs.values()), parsed)
    shared = _shared(configs)
    for arm, config in configs.items():
        _check_same_program(arm, config, shared)
    check_consistent(shared)
    return RunConfig(shared, {arm: _member_config(own, shared) for arm, own in configs.items()})


def parse_all(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Reads each value as its field's type.

    Raises:
      BadInput: an unknown key, or a value that cannot be read.
    """
    for name in overrides:
        if name not in FIELDS:
            raise BadInput(f"unknown key {name!r}{key_hint(name)}")
    return {name: parse(name, value) for name, value in overrides.items()}


def _check_arms(arms: tuple[str, ...], parsed: Mapping[str, Any]) -> None:
    if not arms or len(set(arms)) != len(arms):
        raise BadInput("arm: give each arm once, and at least one")
    for arm in arms:
        arm_settings(arm)
    chosen_preset(parsed)
    for name in parsed:
        if all(name in FIXED.get(arm, ()) for arm in arms):
            raise BadInput(f"{name}: fixed by arm {', '.join(arms)}; `--arm sauna` lets you set it")


def chosen_preset(parsed: Mapping[str, Any]) -> str:
    """Names the preset that is given, or the first one of the algorithm.

    `auto` is the environment's, with A2C the first one.

    Raises:
      BadInput: there is no such preset, it is another algorithm's than the one named, or `auto`
        knows nothing of the environment.
    """
    algorithm = parsed.get("algorithm")
    entry = entry_for(parsed)
    preset = entry.preset if entry else parsed.get("preset", AUTO)
    if preset == AUTO:
        preset = FIRST[algorithm or Config.algorithm]
    if preset not in PRESETS:
        known = ", ".join(PRESETS)
        raise BadInput(f"unknown preset {preset!r} (known: {known}){nearest(preset, PRESETS)}")
    if algorithm is not None and algorithm_of(preset) != algorithm:
        known = ", ".join(name for name in PRESETS if algorithm_of(name) == algorithm)
        raise BadInput(f"preset: {preset} is not one of {algorithm}'s ({known})")
    return preset


def algorithm_of(preset: str) -> str:
    """Names the algorithm that a preset is for."""
    return str(PRESETS[preset].get("algorithm", Config.algorithm))


def arm_config(arm: str, parsed: Mapping[str, Any]) -> Config:
    """Layers defaults < preset < arm < what the user gives and the arm does not fix; unchecked."""
    preset = chosen_preset(parsed)
    free = {name: value for name, value in parsed.items() if name not in FIXED.get(arm, ())}
    of_env: dict[str, Any] = (
        {"rescale_actions": False} if PUBLISHED.match(parsed.get("env", "")) else {}
    )
    if entry := entry_for(parsed):
        of_env["steps"] = entry.steps
    settings = {**of_env, **PRESETS[preset], **arm_settings(arm), **free, "preset": preset}
    return dataclasses.replace(Config(), **settings)


def _shared(configs: Mapping[str, Config]) -> Config:
    """Chooses the config that shapes the program: the first that filters, else the first."""
    every = list(configs.values())
    return next((config for config in every if config.filter != "none"), every[0])


def _member_config(config: Config, shared: Config) -> Config:
    """Puts an arm's traced values on the shared program; filter off is threshold 0."""
    off = config.filter == "none" and shared.filter != "none"
    rules = {name: getattr(shared, name) for name in fields_with("rule_of_experiment")}
    return dataclasses.replace(config, **rules, threshold=0.0 if off else config.threshold)


def _check_same_program(arm: str, config: Config, shared: Config) -> None:
    follows = config.filter == "none" and shared.filter in ("none", "sauna")
    free = fields_with("rule_of_experiment") if follows else ()
    for name in (name for name in fields_with("shapes_program") if name not in free):
        if getattr(config, name) != getattr(shared, name):
            raise BadInput(
                f"arm: {arm} differs from the other arms in {name}, which shapes the compiled "
                f"program; train it in a run of its own"
            )


def plain(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Writes what a user gives as JSON values; `None` is not given.

    Raises:
      BadInput: an unknown key, or a value that cannot be read.
    """
    parsed = parse_all({name: value for name, value in overrides.items() if value is not None})
    return {name: list(v) if isinstance(v, tuple) else v for name, v in parsed.items()}


def overrides_of(run: RunConfig) -> dict[str, Any]:
    """Lists what a user has to give to get this run again, whatever is the default today.

    Its directory is left out, as a new run takes a new one, and the number of processes, which the
    machine may have decided and which changes no result.

    Raises:
      BadInput: there is no such arm or preset any more.
    """
    named = {name: getattr(run.config, name) for name in ("arm", "preset", "algorithm")}
    _check_arms(run.config.arm, named)
    usual = {arm: arm_config(arm, named) for arm in run.config.arm}
    shared = _shared(usual)
    found = dict(named)
    for arm, config in run.arms.items():
        today = _member_config(usual[arm], shared)
        for name in FIELDS:
            value = getattr(config, name)
            fixed = name in FIXED.get(arm, ()) or not is_read(name, config)
            if value != getattr(today, name) and not fixed and name not in ("out", "processes"):
                found[name] = value
    return plain(found)
