"""Named settings: presets, arms (which selection method), and how a run's config is resolved.

A preset says how an algorithm trains; an arm says which rules a run trains with. METHOD, in
`docs/concepts/ppo.md`, gives the origin of every number.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from sauna.config.arms import ARM_HELP as ARM_HELP
from sauna.config.arms import ARMS as ARMS
from sauna.config.arms import BARE, arm_settings, fixed_by
from sauna.config.arms import CONTROL_HELP as CONTROL_HELP
from sauna.config.arms import CONTROLS as CONTROLS
from sauna.config.arms import FIXED as FIXED
from sauna.config.arms import RANDOM_CONTROL as RANDOM_CONTROL
from sauna.config.arms import RULE_HELP as RULE_HELP
from sauna.config.checks import check_consistent, check_read, is_read
from sauna.config.choices import BOUNDED
from sauna.config.other_names import key_hint
from sauna.config.plugins import label_of
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
      names_rules: whether members are called by a rule of the user's own, too. Those of runs from
        before are called by the arm alone.
    """

    config: Config
    arms: dict[str, Config]
    names_rules: bool = False

    @property
    def members(self) -> list[Member]:
        """Lists all members, arm by arm and seed by seed; each with its own arm's config."""
        return [
            Member(f"{label}/{seed}", label, seed, self.arms[arm])
            for arm, label in self.labels.items()
            for seed in self.config.seeds
        ]

    @property
    def labels(self) -> dict[str, str]:
        """Names each arm as its members are: `ppo+my_module.rule` if the rule is the user's own."""
        if not self.names_rules:
            return {arm: arm for arm in self.config.arm}
        return {arm: label_of(arm, vars(self.arms[arm])) for arm in self.config.arm}

    def replace(self, **changes: Any) -> RunConfig:
        """Changes settings of the program and of all arms."""
        arms = {arm: dataclasses.replace(own, **changes) for arm, own in self.arms.items()}
        return RunConfig(dataclasses.replace(self.config, **changes), arms, self.names_rules)


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
    own = {arm: _member_config(config, shared) for arm, config in configs.items()}
    return RunConfig(shared, own, any(arm != label_of(arm, vars(c)) for arm, c in own.items()))


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
        if all(name in fixed_by(arm) for arm in arms):
            free = "sauna" if name in BARE else "ppo"
            raise BadInput(
                f"{name}: fixed by arm {', '.join(arms)}; `--arm {free}` lets you set it"
            )


def chosen_preset(parsed: Mapping[str, Any]) -> str:
    """Names the preset that is given, or the first one of the algorithm.

    `auto` is the environment's, with A2C the first one.

    Raises:
      BadInput: there is no such preset or algorithm, the preset is another algorithm's than the one
        named, or `auto` knows nothing of the environment.
    """
    algorithm = parse("algorithm", parsed["algorithm"]) if "algorithm" in parsed else None
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
    free = {name: value for name, value in parsed.items() if name not in fixed_by(arm)}
    of_env: dict[str, Any] = (
        {"rescale_actions": False} if PUBLISHED.match(parsed.get("env", "")) else {}
    )
    if entry := entry_for(parsed):
        of_env["steps"] = entry.steps
    settings = {**of_env, **PRESETS[preset], **arm_settings(arm), **free, "preset": preset}
    if settings.get("distribution") in BOUNDED:
        settings["rescale_actions"] = True
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
    of_env = {**named, "env": run.config.env}  # some defaults are an environment's
    usual = {arm: arm_config(arm, of_env) for arm in run.config.arm}
    shared = _shared(usual)
    found = {**of_env, "steps": run.config.steps}  # whatever the zoo's entry says one day
    for arm, config in run.arms.items():
        today = _member_config(usual[arm], shared)
        for name in FIELDS:
            value = getattr(config, name)
            fixed = name in fixed_by(arm) or not is_read(name, config)
            if value != getattr(today, name) and not fixed and name not in ("out", "processes"):
                found[name] = value
    return plain(found)
