"""The settings that are searched, and the values that each may take.

A file names them in TOML, a list of choices or the ends of a range:

    learning_rate = {low = 1e-5, high = 1e-2, log = true}
    gamma = [0.9, 0.99, 0.999]
    epochs = {low = 3, high = 20}
    hidden = [[64, 64], [256, 256]]
    batch_size = [32, 64, 128]

`batch_size` stands for samples per minibatch: the largest number up to it that divides the rollout.
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sauna.config.checks import is_read
from sauna.config.settings import FIELDS, TYPES, Config, parse
from sauna.config.trust import check_trusted
from sauna.system.errors import BadInput, nearest
from sauna.system.safe_read import JSON_BYTES, Untrusted, read_file

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

BATCH_SIZE = "batch_size"
GROUPS = ("learning", "network", "normalisation", "selection", "update rules")
TUNABLE = (*(name for name, f in FIELDS.items() if f.metadata["group"] in GROUPS), BATCH_SIZE)
MIN_ITERATIONS = 8  # that the default space leaves of a trial

# The values of RL Zoo's `hyperparams_opt.py` for PPO and A2C (DLR-RM/rl-baselines3-zoo) for the
# most part. Ours differ so: learning rates end at 1e-2 instead of 1, value_coef is twice its
# vf_coef, and rollouts begin at 32 steps and minibatches at 16 samples instead of 8.
DEFAULT: dict[str, Any] = {
    "learning_rate": {"low": 1e-5, "high": 1e-2, "log": True},
    "clip_range": [0.1, 0.2, 0.3, 0.4],
    "gamma": [0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9999],
    "gae_lambda": [0.8, 0.9, 0.92, 0.95, 0.98, 0.99, 1.0],
    "entropy_coef": {"low": 1e-8, "high": 0.1, "log": True},
    "value_coef": {"low": 0.1, "high": 2.0},
    "max_grad_norm": [0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 2.0, 5.0],
    "rollout_steps": [32, 64, 128, 256, 512, 1024, 2048],
    "batch_size": [16, 32, 64, 128, 256, 512],
    "epochs": [1, 5, 10, 20],
    "hidden": [[64], [64, 64], [256, 256]],
    "activation": ["tanh", "relu"],
}


class Range(NamedTuple):
    """The values that one setting may take.

    Attributes:
      name: of the setting.
      choices: the values, as Optuna takes them; none: numbers from `low` to `high`.
      low, high: the ends, which belong to it.
      log: whether numbers are drawn by their logarithm.
    """

    name: str
    choices: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    log: bool = False

    @property
    def whole(self) -> bool:
        """Whether its values are whole numbers."""
        return self.name == BATCH_SIZE or TYPES[self.name] is int

    @property
    def shapes_program(self) -> bool:
        """Whether members that differ in it need programs of their own."""
        return self.name == BATCH_SIZE or bool(FIELDS[self.name].metadata["shapes_program"])

    def distribution(self) -> BaseDistribution:
        """Makes Optuna's form of it."""
        from optuna import distributions

        if self.choices:
            return distributions.CategoricalDistribution(self.choices)
        if self.whole:
            return distributions.IntDistribution(int(self.low), int(self.high), log=self.log)
        return distributions.FloatDistribution(self.low, self.high, log=self.log)

    def inside(self, value: Any) -> Any:
        """Returns the value of the range that is nearest to `value`; None if there is none.

        A text or list that is not among the choices has none.
        """
        value = as_choice(value)
        if self.choices:
            if value in self.choices:
                return next(choice for choice in self.choices if choice == value)
            numbers = [c for c in self.choices if _is_number(c)]
            if not _is_number(value) or not numbers:
                return None
            return min(numbers, key=lambda choice: abs(choice - value))
        bounded = min(max(value, self.low), self.high)
        return round(bounded) if self.whole else float(bounded)


Space = dict[str, Range]


def as_choice(value: Any) -> Any:
    """Writes a value as Optuna stores one: a list becomes the text that a command line takes."""
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def read_space(values: Mapping[str, Any]) -> Space:
    """Reads a space from JSON or TOML values.

    Raises:
      BadInput: a name cannot be searched, or its values cannot be read as the setting's.
    """
    if not values:
        raise BadInput("space: empty; give at least one setting")
    return {name: _range(name, value) for name, value in values.items()}


def _range(name: str, value: Any) -> Range:
    if name not in TUNABLE:
        if name in FIELDS:
            raise BadInput(f"space: {name} is not searched; give it as an option")
        raise BadInput(f"space: unknown key {name!r}{nearest(name, TUNABLE)}")
    if isinstance(value, list):
        return Range(name, _choices(name, value))
    if not isinstance(value, Mapping) or not {"low", "high"} <= {*value} <= {"low", "high", "log"}:
        raise BadInput(
            f"space: {name} must be a list of choices, or {{low = ..., high = ..., log = true}}"
        )
    log = value.get("log", False)
    if not isinstance(log, bool):
        raise BadInput(f"space: {name}: log must be true or false")
    low, high = (_value(name, value[end]) for end in ("low", "high"))
    if not (_is_number(low) and _is_number(high)):
        raise BadInput(f"space: {name} is no number; give a list of choices")
    if low >= high:
        raise BadInput(f"space: {name}: low {low} is not below high {high}")
    if log and low <= 0:
        raise BadInput(f"space: {name}: log needs low above 0")
    return Range(name, (), low, high, log)


def _choices(name: str, values: list[Any]) -> tuple[Any, ...]:
    choices = tuple(as_choice(_value(name, value)) for value in values)
    if not choices or len(set(choices)) < len(choices):
        raise BadInput(f"space: {name}: give each choice once, and at least one")
    return choices


def _value(name: str, value: Any) -> Any:
    if name != BATCH_SIZE:
        try:
            return parse(name, value)
        except BadInput as error:
            raise BadInput(f"space: {error}") from None
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise BadInput(f"space: {name} must be whole numbers of at least 1, not {value!r}")
    return value


def load_space(path: str, trust: bool) -> dict[str, Any]:
    """Loads the values of a space from a TOML file.

    Raises:
      BadInput: it cannot be read, or names code and is not trusted.
    """
    place = Path(path)
    if not os.path.lexists(place):
        raise BadInput(f"space: there is no file {path}")
    try:
        values = tomllib.loads(read_file(Path(os.path.realpath(place)), JSON_BYTES).decode())
    except (Untrusted, ValueError, RecursionError) as error:
        raise BadInput(f"space: cannot read {path}: {error}") from error
    check_trusted(values, f"space {path}", None, trust)
    return values


def default_space(config: Config) -> dict[str, Any]:
    """Lists the values that are searched if nobody says otherwise: those that `config` reads.

    A rollout leaves at least eight iterations of the budget, if one of the choices does.
    """
    found = {
        name: values
        for name, values in DEFAULT.items()
        if is_read("minibatches" if name == BATCH_SIZE else name, config)
    }
    most = config.steps // (MIN_ITERATIONS * config.envs)
    fitting = [steps for steps in DEFAULT["rollout_steps"] if steps <= most]
    if fitting:
        return {**found, "rollout_steps": fitting}
    del found["rollout_steps"]
    return found


def start_of(space: Space, config: Config) -> dict[str, Any]:
    """Finds the values of `space` that are nearest to those of `config`."""
    size = config.rollout_steps * config.envs // config.minibatches
    values = {name: size if name == BATCH_SIZE else getattr(config, name) for name in space}
    near = {name: space[name].inside(value) for name, value in values.items()}
    return {name: value for name, value in near.items() if value is not None}


def settings_of(values: Mapping[str, Any], config: Config) -> dict[str, Any]:
    """Writes values of a space as settings of a run: `batch_size` becomes `minibatches`.

    Args:
      values: by name, as Optuna gives them.
      config: has the settings that are not searched.
    """
    found = {name: value for name, value in values.items() if name != BATCH_SIZE}
    if BATCH_SIZE in values:
        rollout, envs = (int(found.get(n, getattr(config, n))) for n in ("rollout_steps", "envs"))
        found["minibatches"] = fewest_minibatches(rollout * envs, values[BATCH_SIZE])
    return found


def fewest_minibatches(samples: int, size: int) -> int:
    """Counts the fewest equal minibatches of `samples` that hold at most `size` of them each."""
    number = math.ceil(samples / size)
    while samples % number:
        number += 1
    return number


def traced(space: Space) -> Space:
    """Keeps what members of one program may differ in."""
    return {name: one for name, one in space.items() if not one.shapes_program}


def shown(value: Any) -> str:
    """Writes a value for a table."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
