"""Every choice of a run, as one flat frozen dataclass, and the checks on it.

The dataclass is the single source of the command line's flags and help lines, of `config.json`,
and of the keyword arguments of `sauna.train`. Nothing here imports JAX, so that bad input is
refused in well under a second.
"""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sauna.config.parsing import read_value
from sauna.config.plugins import import_name, is_local
from sauna.system.errors import BadInput, nearest

NATIVE = ("gymnax", "playground", "brax", "mjx")  # `NAME/...`: environments of the device alone
ON_DEVICE = ("reset", "device", "devices", "distributed")  # fields that only the device reads
FILTERS = ("none", "sauna", "random-drop")
VEX_TARGETS = ("rollout", "minibatch", "episode", "sample")
NETWORKS = ("auto", "mlp", "nature-cnn")


def option(
    default: Any,
    help: str,
    *,
    choices: tuple[str, ...] = (),
    plugin: bool = False,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    shapes_program: bool = True,
) -> Any:
    """A config field: its default, its help line, and the values it accepts.

    `plugin` also accepts `module:name`. `shapes_program` is False for a value that is traced (one
    compiled program serves members that differ in it) or that does not touch training at all.
    """
    metadata = {
        "help": help,
        "choices": choices,
        "plugin": plugin,
        "at_least": at_least,
        "above": above,
        "at_most": at_most,
        "shapes_program": shapes_program,
    }
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Config:
    """All settings of one run; see each field's help line. Built by `resolve`, never by hand."""

    env: str = option("", "Gymnasium id, or module:function that makes an environment")
    env_kwargs: str = option("{}", "keyword arguments of the environment, as a JSON object")
    arm: tuple[str, ...] = option(
        ("sauna",), "what to train, a name or several: see `sauna list arms`", shapes_program=False
    )
    algorithm: str = option(
        "ppo", "how the policy is improved: by PPO, or by A2C", choices=("ppo", "a2c")
    )
    preset: str = option(
        "mujoco", "settings to start from; with A2C, preset a2c", shapes_program=False
    )
    seeds: tuple[int, ...] = option(
        (0,), "how many seeds (6: seeds 0 to 5), or which ones (100,101,110)", shapes_program=False
    )
    steps: int = option(1_000_000, "env steps per member", at_least=1)

    out: str = option("", "run directory (default: runs/ENV_ARM_TIME)", shapes_program=False)
    processes: int = option(
        0, "processes that share the members (0: one per core)", at_least=0, shapes_program=False
    )
    env_processes: int = option(
        0,
        "worker processes that step the environments of one process (0: stepped in-process)",
        at_least=0,
        shapes_program=False,
    )
    backend: str = option(
        "auto",
        "what steps the environments (auto: the fastest with the same "
        "numbers; device: inside the compiled program)",
        choices=("auto", "gymnasium", "device"),
        shapes_program=False,
    )
    reset: str = option(
        "fresh",
        "on the device, an episode starts in a new state, or in its environment's first one again",
        choices=("fresh", "cached"),
    )
    device: str = option(
        "auto",
        "with backend device: gpu where there is one (auto), or the CPU",
        choices=("auto", "cpu", "gpu"),
        shapes_program=False,
    )
    devices: int = option(
        0,
        "devices that share the population (0: every GPU, or one CPU; 8 simulates 8 on a CPU)",
        at_least=0,
        shapes_program=False,
    )
    distributed: str = option(
        "",
        "HOST:PORT,COUNT,INDEX: COUNT machines train together; INDEX 0 writes the run",
        shapes_program=False,
    )
    env_timeout: float = option(
        60.0, "seconds to wait for an environment worker", above=0, shapes_program=False
    )
    checkpoint_every: int = option(
        50, "iterations between checkpoints", at_least=1, shapes_program=False
    )
    keep_checkpoints: int = option(
        2, "how many of the newest checkpoints to keep", at_least=1, shapes_program=False
    )
    tensorboard: bool = option(
        False, "also write the metrics for TensorBoard", shapes_program=False
    )

    envs: int = option(1, "environments per member (N)", at_least=1)
    rollout_steps: int = option(2048, "kept steps per environment and iteration (T)", at_least=1)
    minibatches: int = option(32, "minibatches per epoch", at_least=1)
    epochs: int = option(10, "passes over each rollout", at_least=1)
    learning_rate: float = option(3e-4, "the optimizer's step size", above=0, shapes_program=False)
    learning_rate_schedule: str = option(
        "linear", "over the budget of steps: to 0, or constant", choices=("linear", "constant")
    )
    optimizer: str = option("adam", "what scales the gradient", choices=("adam", "rmsprop"))
    adam_epsilon: float = option(1e-5, "Adam's epsilon", above=0)
    rmsprop_epsilon: float = option(1e-5, "RMSProp's epsilon, under the root", above=0)
    rmsprop_decay: float = option(
        0.99, "of RMSProp's running mean square", at_least=0, at_most=0.999999
    )
    max_grad_norm: float = option(
        0.5, "the gradient is scaled down to this global norm", above=0, shapes_program=False
    )
    clip_range: float = option(
        0.2, "clip range of the probability ratio (and the value)", above=0, shapes_program=False
    )
    clip_value: bool = option(True, "clip the value function's change as the ratio's")
    normalize_advantages: bool = option(True, "standardise the advantages of each minibatch")
    entropy_coef: float = option(
        0.0, "weight of the entropy bonus", at_least=0, shapes_program=False
    )
    value_coef: float = option(0.5, "weight of the value loss", at_least=0, shapes_program=False)
    gamma: float = option(0.99, "discount", at_least=0, at_most=1, shapes_program=False)
    gae_lambda: float = option(
        0.95, "lambda of the advantage estimate", at_least=0, at_most=1, shapes_program=False
    )

    network: str = option(
        "auto", "trunk (auto: nature-cnn for images, else mlp)", choices=NETWORKS, plugin=True
    )
    hidden: tuple[int, ...] = option((64, 64), "widths of the MLP's hidden layers", at_least=1)
    activation: str = option("tanh", "the MLP's activation", choices=("tanh", "relu"))
    trunk: str = option(
        "separate", "whether policy and value share a trunk", choices=("separate", "shared")
    )
    log_std_init: float = option(0.0, "first log standard deviation of continuous actions")
    normalize_observations: bool = option(
        True, "running mean and variance of vector observations (images are divided by 255)"
    )
    sign_rewards: bool = option(
        False, "learn from each reward's sign, -1, 0 or 1 (returns are told in full)"
    )
    normalize_rewards: bool = option(True, "divide rewards by the std of the discounted return")
    clip_observations: float = option(10.0, "bound of normalised observations", above=0)
    clip_rewards: float = option(10.0, "bound of normalised rewards", above=0)

    vex_target: str = option(
        "sample", "what the Vex head regresses", choices=VEX_TARGETS, plugin=True
    )
    vex_coef: float = option(
        0.5, "weight of the Vex loss (c2 of eq. 6)", at_least=0, shapes_program=False
    )
    filter: str = option(
        "sauna", "which transitions the update keeps", choices=FILTERS, plugin=True
    )
    threshold: float = option(
        0.3, "keep where |Vex| / |median| reaches this (eq. 7)", at_least=0, shapes_program=False
    )
    threshold_schedule: str = option(
        "constant",
        "over the budget of steps: constant, rising from 0, or falling to 0",
        choices=("constant", "rising", "falling"),
    )
    keep_rate_target: float = option(
        0.0,
        "share of steps to keep; the threshold is moved at every step to hold it (0: off)",
        at_least=0,
        at_most=1,
    )
    history: str = option(
        "all", "steps of the rollout whose predictions the median covers", choices=("all", "kept")
    )
    decision: str = option(
        "env", "decide for each env, or jointly for a vector step", choices=("env", "joint")
    )
    dropped: str = option(
        "replace",
        "dropped steps: replaced by further env steps, or masked",
        choices=("replace", "mask"),
    )
    max_env_steps_factor: int = option(
        4, "with replace: at most this many times T env steps are tried", at_least=1
    )
    gae_over: str = option(
        "all", "advantages over all env steps, or over the kept ones", choices=("all", "kept")
    )
    truncation: str = option(
        "bootstrap",
        "at a time limit: bootstrap the final value, or treat it as termination",
        choices=("bootstrap", "terminate"),
    )
    budget: str = option(
        "env", "what `steps` counts: all env steps or kept ones", choices=("env", "kept")
    )
    drop_rate: float = option(
        0.0,
        "share of steps that random-drop drops",
        at_least=0,
        at_most=0.99,
        shapes_program=False,
    )
    drop_rate_from: str = option(
        "",
        "a SAUNA run whose measured rates random-drop repeats, seed by seed",
        shapes_program=False,
    )


FIELDS = {field.name: field for field in dataclasses.fields(Config)}
TYPES = typing.get_type_hints(Config)


def flag(name: str) -> str:
    """`rollout_steps` -> `--rollout-steps`."""
    return "--" + name.replace("_", "-")


def parse(name: str, value: Any) -> Any:
    """`value` (text from a command line, or a Python or JSON value) as field `name`'s type.

    Raises:
      BadInput: the value cannot be read as that type, or lies outside what the field accepts.
    """
    field_type, meta = TYPES[name], FIELDS[name].metadata
    try:
        parsed = read_value(name, value, field_type)
    except (ValueError, TypeError, KeyError, OverflowError):
        expected = getattr(field_type, "__name__", str(field_type))
        raise BadInput(f"{name}: cannot read {value!r} as {expected}") from None
    named = meta["plugin"] and ":" in str(parsed)
    if isinstance(parsed, str) and meta["choices"] and parsed not in meta["choices"] and not named:
        known = ", ".join(meta["choices"]) + (", or module:name" if meta["plugin"] else "")
        hint = nearest(parsed, meta["choices"])
        raise BadInput(f"{name}: unknown value {parsed!r} (known: {known}){hint}")
    for number in parsed if isinstance(parsed, tuple) else (parsed,):
        _check_bounds(name, number, meta)
    return parsed


def _check_bounds(name: str, value: Any, meta: Mapping[str, Any]) -> None:
    if isinstance(value, str | bool):
        return
    if isinstance(value, int) and abs(value) >= 2**63:
        raise BadInput(f"{name}: must be a number of at most 63 bits")
    if not math.isfinite(value):
        raise BadInput(f"{name}: must be a finite number, not {value}")
    if meta["at_least"] is not None and value < meta["at_least"]:
        raise BadInput(f"{name}: must be at least {meta['at_least']}, not {value}")
    if meta["above"] is not None and value <= meta["above"]:
        raise BadInput(f"{name}: must be above {meta['above']}, not {value}")
    if meta["at_most"] is not None and value > meta["at_most"]:
        raise BadInput(f"{name}: must be at most {meta['at_most']}, not {value}")


# What reads a field that not every run reads. A field named by the user that nothing reads is
# refused, so that no setting is silently without effect.
_READERS: dict[str, tuple[str, Any]] = {
    **dict.fromkeys(
        ("minibatches", "epochs", "clip_range", "clip_value"),
        ("algorithm ppo", lambda c: c.algorithm == "ppo"),
    ),
    "adam_epsilon": ("optimizer adam", lambda c: c.optimizer == "adam"),
    **dict.fromkeys(
        ("rmsprop_epsilon", "rmsprop_decay"),
        ("optimizer rmsprop", lambda c: c.optimizer == "rmsprop"),
    ),
    **dict.fromkeys(
        ("threshold", "threshold_schedule"),
        (
            "a filter other than none and random-drop, and keep_rate_target 0",
            lambda c: c.filter not in ("none", "random-drop") and not c.keep_rate_target,
        ),
    ),
    "keep_rate_target": ("filter sauna", lambda c: c.filter == "sauna"),
    "history": ("filter sauna", lambda c: c.filter == "sauna"),
    "decision": ("filter sauna and several envs", lambda c: c.filter == "sauna" and c.envs > 1),
    "dropped": ("a filter", lambda c: c.filter != "none"),
    "max_env_steps_factor": (
        "a filter with dropped=replace",
        lambda c: c.filter != "none" and c.dropped == "replace",
    ),
    "drop_rate": ("filter random-drop", lambda c: c.filter == "random-drop"),
    "drop_rate_from": ("filter random-drop", lambda c: c.filter == "random-drop"),
    "vex_target": ("vex_coef above 0", lambda c: c.vex_coef > 0),
    "hidden": ("the mlp network", lambda c: c.network in ("auto", "mlp")),
    "activation": ("the mlp network", lambda c: c.network in ("auto", "mlp")),
    "env_timeout": ("env_processes above 0", lambda c: c.env_processes > 0),
    "clip_observations": ("normalize_observations", lambda c: c.normalize_observations),
    "clip_rewards": ("normalize_rewards", lambda c: c.normalize_rewards),
}


def check_read(configs: list[Config], given: Mapping[str, Any]) -> None:
    """Refuses a given field that none of the arms' `configs` reads.

    Raises:
      BadInput: naming the field and what would read it.
    """
    for name in given:
        if name in _READERS and not any(_READERS[name][1](config) for config in configs):
            arms = ",".join(configs[0].arm)
            raise BadInput(f"{name}: not read by arm {arms}; it needs {_READERS[name][0]}")


def check_consistent(config: Config) -> None:
    """Refuses values that are each possible but not together.

    Raises:
      BadInput: with the one line that says which.
    """
    if not config.env:
        raise BadInput("env: no environment given; try `sauna train InvertedPendulum-v5`")
    if not config.seeds:
        raise BadInput("seeds: empty; give a number of seeds or a list")
    if len(set(config.seeds)) != len(config.seeds):
        raise BadInput("seeds: a seed is given twice")
    if not config.hidden:
        raise BadInput("hidden: empty; give at least one width")
    if min(config.seeds) < 0 or max(config.seeds) >= 2**32:
        raise BadInput("seeds: must lie between 0 and 2**32 - 1")
    batch = config.rollout_steps * config.envs
    if batch % config.minibatches:
        raise BadInput(
            f"minibatches: {config.minibatches} does not divide rollout_steps x envs = {batch}"
        )
    if config.steps < batch:
        raise BadInput(f"steps: {config.steps} is less than one rollout of {batch} steps")
    if config.gae_over == "kept" and config.truncation == "bootstrap":
        raise BadInput(
            "gae_over: kept needs truncation=terminate (the final value belongs to a step that "
            "may have been dropped)"
        )
    if config.keep_rate_target and (config.history, config.decision) != ("all", "env"):
        raise BadInput("keep_rate_target: needs history=all and decision=env")
    if config.drop_rate and config.drop_rate_from:
        raise BadInput("drop_rate: give either drop_rate or drop_rate_from, not both")
    if config.filter == "random-drop" and not (config.drop_rate or config.drop_rate_from):
        raise BadInput("drop_rate: random-drop needs a rate, or drop_rate_from=RUN")
    if config.env_processes and "env" in local_parts(config):
        raise BadInput(
            "env_processes: the environment cannot be imported by another process; "
            "put it at the top level of a module"
        )
    if config.env_processes > config.envs * len(config.seeds) * len(config.arm):
        raise BadInput("env_processes: more worker processes than environments")
    for name in ("network", "vex_target", "filter"):
        value = getattr(config, name)
        if ":" in value:
            import_name(name, value)


def local_parts(config: Config) -> list[str]:
    """The fields whose values were passed by value and only this process knows."""
    return [name for name in FIELDS if is_local(str(getattr(config, name)))]


def to_json(config: Config) -> dict[str, Any]:
    """The config as JSON values, in field order."""
    values = dataclasses.asdict(config)
    values["env_kwargs"] = json.loads(config.env_kwargs)
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in values.items()
    }
