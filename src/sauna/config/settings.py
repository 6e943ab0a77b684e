"""Every choice of a run, as one flat frozen dataclass.

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
from functools import partial
from typing import Any

from sauna.config.fields import option
from sauna.config.parsing import read_value
from sauna.system.errors import BadInput, nearest

NATIVE = ("gymnax", "playground", "brax", "mjx")  # `NAME/...`: environments of the device alone
FILTERS = ("none", "sauna", "random-drop")
VEX_TARGETS = ("rollout", "minibatch", "episode", "sample")
NETWORKS = ("auto", "mlp", "nature-cnn")

_task = partial(option, group="task")
_run = partial(option, group="run", shapes_program=False)
_where = partial(option, group="where it runs", shapes_program=False)
_learning = partial(option, group="learning")
_network = partial(option, group="network")
_normalisation = partial(option, group="normalisation")
_selection = partial(option, group="selection")
_rule = partial(option, group="selection", rule_of_experiment=True)

# What reads a field that not every run reads.
_ON_HOST = ("environments on the host", lambda c: c.backend != "device")
_WORKERS = ("env_processes above 0", lambda c: c.env_processes > 0)
_PPO = ("algorithm ppo", lambda c: c.algorithm == "ppo")
_ADAM = ("optimizer adam", lambda c: c.optimizer == "adam")
_RMSPROP = ("optimizer rmsprop", lambda c: c.optimizer == "rmsprop")
_MLP = ("the mlp network", lambda c: c.network in ("auto", "mlp"))
_CONTINUOUS = ("continuous actions", lambda spaces: spaces.action_kind == "continuous")
_VECTORS = (
    "vector observations: others have no running moments",
    lambda spaces: spaces.observation_kind == "vector",
)
_NORMALIZED = ("normalize_observations", lambda c: c.normalize_observations)
_SCALED = ("normalize_rewards", lambda c: c.normalize_rewards)
_VEX = ("vex_coef above 0", lambda c: c.vex_coef > 0)
_FILTERED = ("a filter", lambda c: c.filter != "none")
_REPLACED = (
    "a filter with dropped=replace",
    lambda c: c.filter != "none" and c.dropped == "replace",
)
_THRESHOLD = (
    "a filter other than none and random-drop, and keep_rate_target 0",
    lambda c: c.filter not in ("none", "random-drop") and not c.keep_rate_target,
)
_SAUNA = ("filter sauna", lambda c: c.filter == "sauna")
_SEVERAL = ("filter sauna and several envs", lambda c: c.filter == "sauna" and c.envs > 1)
_RANDOM = ("filter random-drop", lambda c: c.filter == "random-drop")


@dataclass(frozen=True)
class Config:
    """All settings of one run; see each field's help line. Built by `resolve`, never by hand."""

    env: str = _task(
        "",
        "Gymnasium id, or module:function that makes an environment",
        common=True,
        plugin=True,
        decided_by_study=True,
    )
    env_kwargs: str = _task("{}", "keyword arguments of the environment, as a JSON object")
    arm: tuple[str, ...] = _run(
        ("ppo",), "what to train, a name or several: see `sauna list arms`", common=True
    )
    algorithm: str = _run(
        "ppo",
        "how the policy is improved: by PPO, or by A2C",
        choices=("ppo", "a2c"),
        shapes_program=True,
    )
    preset: str = _run("mujoco", "settings to start from; with A2C, preset a2c", common=True)
    seeds: tuple[int, ...] = _run(
        (0,),
        "how many seeds (6: seeds 0 to 5; 42: 42 of them), or which ones (100,101,110)",
        common=True,
    )
    steps: int = _run(
        1_000_000, "env steps per member", at_least=1, common=True, shapes_program=True
    )

    out: str = _run(
        "",
        "run directory; none: runs/ENV_ARM_SEEDS_TIME",
        common=True,
        machine_local=True,
        decided_by_study=True,
    )
    processes: int = _where(
        0,
        "processes that share the members (0: one per core)",
        at_least=0,
        common=True,
        resumable=True,
        machine_local=True,
        decided_by_study=True,
    )
    env_processes: int = _where(
        0,
        "worker processes that step the environments of one process (0: stepped in-process)",
        at_least=0,
        read_when=_ON_HOST,
        resumable=True,
    )
    backend: str = _where(
        "auto",
        "what steps the environments (auto: the fastest with the same "
        "numbers; device: inside the compiled program)",
        choices=("auto", "gymnasium", "device"),
        resumable=True,
    )
    reset: str = _where(
        "fresh",
        "on the device, an episode starts in a new state, or in its environment's first one again",
        choices=("fresh", "cached"),
        shapes_program=True,
        device_only=True,
    )
    device: str = _where(
        "auto",
        "with backend device: gpu if there is one (auto), or the CPU",
        choices=("auto", "cpu", "gpu"),
        common=True,
        device_only=True,
        resumable=True,
    )
    devices: int = _where(
        0,
        "devices that share the population (0: every GPU, or one CPU; 8 simulates 8 on a CPU)",
        at_least=0,
        device_only=True,
        resumable=True,
    )
    distributed: str = _where(
        "",
        "HOST:PORT,COUNT,INDEX: COUNT machines train together; INDEX 0 writes the run",
        device_only=True,
        resumable=True,
        machine_local=True,
        decided_by_study=True,
    )
    env_timeout: float = _where(
        60.0,
        "seconds to wait for an environment worker",
        above=0,
        read_when=_WORKERS,
        resumable=True,
    )
    checkpoint_every: int = _run(50, "iterations between checkpoints", at_least=1, resumable=True)
    keep_checkpoints: int = _run(
        2,
        "how many of the newest checkpoints to keep",
        at_least=1,
        resumable=True,
        machine_local=True,
    )
    tensorboard: bool = _run(
        False,
        "also write the metrics for TensorBoard",
        resumable=True,
        machine_local=True,
        decided_by_study=True,
    )

    envs: int = _learning(1, "environments per member (N)", at_least=1, common=True)
    rollout_steps: int = _learning(
        2048, "kept steps per environment and iteration (T)", at_least=1, common=True
    )
    minibatches: int = _learning(32, "minibatches per epoch", at_least=1, read_when=_PPO)
    epochs: int = _learning(10, "passes over each rollout", at_least=1, read_when=_PPO)
    learning_rate: float = _learning(
        3e-4, "the optimizer's step size", above=0, common=True, shapes_program=False
    )
    learning_rate_schedule: str = _learning(
        "linear", "over the budget of steps: to 0, or constant", choices=("linear", "constant")
    )
    optimizer: str = _learning("adam", "what scales the gradient", choices=("adam", "rmsprop"))
    adam_epsilon: float = _learning(1e-5, "Adam's epsilon", above=0, read_when=_ADAM)
    rmsprop_epsilon: float = _learning(
        1e-5, "RMSProp's epsilon, under the root", above=0, read_when=_RMSPROP
    )
    rmsprop_decay: float = _learning(
        0.99,
        "of RMSProp's running mean square",
        at_least=0,
        at_most=0.999999,
        read_when=_RMSPROP,
    )
    max_grad_norm: float = _learning(
        0.5, "the gradient is scaled down to this global norm", above=0, shapes_program=False
    )
    clip_range: float = _learning(
        0.2,
        "clip range of the probability ratio (and the value)",
        above=0,
        shapes_program=False,
        read_when=_PPO,
    )
    clip_value: bool = _learning(
        True, "clip the value function's change as the ratio's", read_when=_PPO
    )
    normalize_advantages: bool = _learning(True, "standardise the advantages of each minibatch")
    entropy_coef: float = _learning(
        0.0, "weight of the entropy bonus", at_least=0, shapes_program=False
    )
    value_coef: float = _learning(0.5, "weight of the value loss", at_least=0, shapes_program=False)
    gamma: float = _learning(0.99, "discount", at_least=0, at_most=1, shapes_program=False)
    gae_lambda: float = _learning(
        0.95, "lambda of the advantage estimate", at_least=0, at_most=1, shapes_program=False
    )

    network: str = _network(
        "auto", "trunk (auto: nature-cnn for images, else mlp)", choices=NETWORKS, plugin=True
    )
    hidden: tuple[int, ...] = _network(
        (64, 64), "widths of the MLP's hidden layers", at_least=1, read_when=_MLP
    )
    activation: str = _network(
        "tanh", "the MLP's activation", choices=("tanh", "relu"), read_when=_MLP
    )
    trunk: str = _network(
        "separate", "whether policy and value share a trunk", choices=("separate", "shared")
    )
    log_std_init: float = _network(
        0.0, "first log standard deviation of continuous actions", needs_spaces=_CONTINUOUS
    )
    normalize_observations: bool = _normalisation(
        True,
        "running mean and variance of vector observations (images are divided by 255)",
        needs_spaces=_VECTORS,
    )
    sign_rewards: bool = _normalisation(
        False, "learn from each reward's sign, -1, 0 or 1 (returns are reported in full)"
    )
    normalize_rewards: bool = _normalisation(
        True, "divide rewards by the std of the discounted return"
    )
    clip_observations: float = _normalisation(
        10.0, "bound of normalised observations", above=0, read_when=_NORMALIZED
    )
    clip_rewards: float = _normalisation(
        10.0, "bound of normalised rewards", above=0, read_when=_SCALED
    )

    vex_target: str = _rule(
        "sample",
        "what the Vex head regresses",
        choices=VEX_TARGETS,
        plugin=True,
        read_when=_VEX,
    )
    vex_coef: float = _selection(
        0.5, "weight of the Vex loss (c2 of eq. 6)", at_least=0, shapes_program=False
    )
    filter: str = _rule("sauna", "which transitions the update keeps", choices=FILTERS, plugin=True)
    threshold: float = _selection(
        0.3,
        "keep if |Vex| / |median| reaches this (eq. 7)",
        at_least=0,
        shapes_program=False,
        read_when=_THRESHOLD,
    )
    threshold_schedule: str = _rule(
        "constant",
        "over the budget of steps: constant, rising from 0, or falling to 0",
        choices=("constant", "rising", "falling"),
        read_when=_THRESHOLD,
    )
    keep_rate_target: float = _rule(
        0.0,
        "share of steps to keep; the threshold is moved at every step to hold it (0: off)",
        at_least=0,
        at_most=1,
        read_when=_SAUNA,
    )
    history: str = _rule(
        "all",
        "steps of the rollout whose predictions the median covers",
        choices=("all", "kept"),
        read_when=_SAUNA,
    )
    decision: str = _rule(
        "env",
        "decide for each env, or jointly for a vector step",
        choices=("env", "joint"),
        read_when=_SEVERAL,
    )
    dropped: str = _rule(
        "replace",
        "dropped steps: replaced by further env steps, or masked",
        choices=("replace", "mask"),
        read_when=_FILTERED,
    )
    max_env_steps_factor: int = _rule(
        4,
        "with replace: at most this many times T env steps are tried",
        at_least=1,
        read_when=_REPLACED,
    )
    gae_over: str = _rule(
        "all", "advantages over all env steps, or over the kept ones", choices=("all", "kept")
    )
    truncation: str = _learning(
        "bootstrap",
        "at a time limit: bootstrap the final value, or treat it as termination",
        choices=("bootstrap", "terminate"),
        rule_of_experiment=True,
    )
    budget: str = _rule(
        "env", "what `steps` counts: all env steps or kept ones", choices=("env", "kept")
    )
    drop_rate: float = _selection(
        0.0,
        "share of steps that random-drop drops",
        at_least=0,
        at_most=0.99,
        shapes_program=False,
        read_when=_RANDOM,
    )
    drop_rate_from: str = _selection(
        "",
        "a SAUNA run whose measured rates random-drop repeats, seed by seed",
        shapes_program=False,
        read_when=_RANDOM,
        machine_local=True,
        decided_by_study=True,
    )


FIELDS = {field.name: field for field in dataclasses.fields(Config)}
TYPES = typing.get_type_hints(Config)


def fields_with(mark: str) -> tuple[str, ...]:
    """Names the fields whose `option` has a mark, say `resumable`."""
    return tuple(name for name, field in FIELDS.items() if field.metadata[mark])


def flag(name: str) -> str:
    """Spells a field as a flag: `rollout_steps` -> `--rollout-steps`."""
    return "--" + name.replace("_", "-")


def parse(name: str, value: Any) -> Any:
    """Reads `value` (text of a command line, or a Python or JSON value) as field `name`'s type.

    Raises:
      BadInput: the value cannot be read as that type, or lies outside what the field accepts.
    """
    field_type, meta = TYPES[name], FIELDS[name].metadata
    try:
        parsed = read_value(name, value, field_type)
    except (ValueError, TypeError, KeyError):
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
    if not math.isfinite(value):
        raise BadInput(f"{name}: must be a finite number, not {value}")
    if meta["at_least"] is not None and value < meta["at_least"]:
        raise BadInput(f"{name}: must be at least {meta['at_least']}, not {value}")
    if meta["above"] is not None and value <= meta["above"]:
        raise BadInput(f"{name}: must be above {meta['above']}, not {value}")
    if meta["at_most"] is not None and value > meta["at_most"]:
        raise BadInput(f"{name}: must be at most {meta['at_most']}, not {value}")


def to_json(config: Config) -> dict[str, Any]:
    """Writes the config as JSON values, in field order."""
    values = dataclasses.asdict(config)
    values["env_kwargs"] = json.loads(config.env_kwargs)
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in values.items()
    }
