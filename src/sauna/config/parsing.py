"""Text from a command line, or a Python or JSON value, as the value of a setting."""

from __future__ import annotations

import json
import typing
from typing import Any

from sauna.system.errors import BadInput


def read_value(name: str, value: Any, field_type: Any) -> Any:
    """Reads `value` as `field_type`; the fields `..._kwargs` and `seeds` have forms of their own.

    Raises:
      ValueError, TypeError, KeyError: it cannot be read as that.
      BadInput: a number of seeds that is meant as a seed.
    """
    if name.endswith("_kwargs"):
        return _json_object(name, value)
    if name == "seeds":
        return _seeds(value)
    if field_type is bool:
        return value if isinstance(value, bool) else _BOOLEANS[str(value).lower()]
    if field_type is int:
        return _integer(value)
    if field_type == float | None:
        return None if value in (None, "none") else read_value(name, value, float)
    if field_type is float:
        if isinstance(value, bool):
            raise TypeError
        return float(value)
    if typing.get_origin(field_type) is tuple:
        item = typing.get_args(field_type)[0]
        if isinstance(value, str):
            value = value.split(",") if value.strip() else []
        parts = list(value)
        if len(parts) > MAX_VALUES:
            raise BadInput(f"{name}: {len(parts)} values are too many; at most {MAX_VALUES}")
        return tuple(str(part).strip() if item is str else _integer(part) for part in parts)
    if not isinstance(value, str):
        raise TypeError
    return value


MAX_VALUES = 100  # of a list, such as the arms or the widths of layers
_BOOLEANS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def _integer(value: Any) -> int:
    """Reads a whole number, also as `1e6`; a bool or 1.5 is not one."""
    if isinstance(value, bool):
        raise TypeError
    if isinstance(value, int):
        return value
    number = float(value)
    if not number.is_integer():
        raise ValueError
    return int(number)


MAX_SEEDS = 10_000


def _seeds(value: Any) -> tuple[int, ...]:
    """Reads a count (`6`, `"6"`: seeds 0 to 5) or the seeds themselves (a list, `"100,101"`)."""
    if isinstance(value, str) and "," in value:
        value = [part for part in value.split(",") if part.strip()]
    if isinstance(value, str) or not hasattr(value, "__len__"):  # also a number of numpy
        number = _integer(value)
        if number > MAX_SEEDS:
            raise BadInput(
                f"seeds: {number} is too many; for the one seed {number} write --seed {number}"
            )
        return tuple(range(number))
    if len(value) > MAX_SEEDS:
        raise BadInput(f"seeds: {len(value)} are too many; at most {MAX_SEEDS}")
    return tuple(_integer(seed) for seed in value)


MANY_SEEDS = 20  # from which a count may have been meant as a seed


def many_seeds(seeds: tuple[int, ...]) -> str | None:
    """Says what a large count of seeds means, for it may have been meant as a seed."""
    number = len(seeds)
    if number < MANY_SEEDS or seeds != tuple(range(number)):
        return None
    return (
        f"note: {number} seeds, 0 to {number - 1}; for the one seed {number} write --seed {number}"
    )


def _json_object(name: str, value: Any) -> str:
    parsed = json.loads(value) if isinstance(value, str) else dict(value)
    if not isinstance(parsed, dict):
        raise ValueError
    try:
        return json.dumps(parsed, sort_keys=True, allow_nan=False, default=_json_value)
    except ValueError:  # which no reader of JSON would take back
        raise BadInput(
            f"{name}: JSON has no infinity and no NaN; 1e300 is a bound that nothing reaches"
        ) from None


def _json_value(value: Any) -> Any:
    """A number or an array of numpy or JAX as JSON has it.

    Raises:
      BadInput: it is something else.
    """
    if hasattr(value, "tolist"):
        return value.tolist()
    raise BadInput(
        f"env_kwargs: a {type(value).__name__} is no JSON value; pass env as a function that "
        "sets it, such as lambda: MyEnv(...)"
    )


def whole_number(name: str, value: Any, least: int) -> int:
    """Reads option `name` as a whole number of at least `least`.

    Raises:
      BadInput: it is something else.
    """
    try:
        number = _integer(value)
    except (ValueError, TypeError):
        number = least - 1
    if number < least:
        raise BadInput(f"{name}: must be a whole number of at least {least}, not {value}")
    return number


def what_is_played(episodes: Any, seed: Any, max_steps: Any) -> tuple[int, int, int]:
    """Reads how many episodes are played, from which seed on, and of how many env steps at most.

    Raises:
      BadInput: one of them is no whole number, or too small.
    """
    return (
        whole_number("episodes", episodes, 1),
        whole_number("seed", seed, 0),
        whole_number("max_steps", max_steps, 1),
    )
