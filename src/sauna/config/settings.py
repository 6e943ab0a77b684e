"""The settings of a run: `Config`, and how a value of a field is read, written and named."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from collections.abc import Mapping
from typing import Any

from sauna.config.choices import FILTERS as FILTERS
from sauna.config.choices import VEX_TARGETS as VEX_TARGETS
from sauna.config.options import Config as Config
from sauna.config.parsing import read_value
from sauna.system.errors import BadInput, nearest

NATIVE = ("gymnax", "playground", "brax", "mjx")  # `NAME/...`: environments of the device alone

EXAMPLE = """'{"share": 0.25}'"""  # of a field `..._kwargs`, as a shell takes it

FIELDS = {field.name: field for field in dataclasses.fields(Config)}
TYPES = typing.get_type_hints(Config)


def fields_with(mark: str) -> tuple[str, ...]:
    """Names the fields whose `option` has a mark, say `resumable`."""
    return tuple(name for name, field in FIELDS.items() if field.metadata[mark])


def flag(name: str) -> str:
    """Spells a field as a flag: `rollout_steps` -> `--rollout-steps`."""
    return "--" + name.replace("_", "-")


_KINDS: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    float | None: "a number",
    bool: "yes or no",
    str: "text",
    tuple[int, ...]: "whole numbers, separated by commas",
    tuple[str, ...]: "names, separated by commas",
}


def parse(name: str, value: Any) -> Any:
    """Reads `value` (text of a command line, or a Python or JSON value) as field `name`'s type.

    Raises:
      BadInput: the value cannot be read as that type, or lies outside what the field accepts.
    """
    field_type, meta = TYPES[name], FIELDS[name].metadata
    try:
        parsed = read_value(name, value, field_type)
    except (ValueError, TypeError, KeyError, OverflowError):
        raise BadInput(f"{name}: cannot read {value!r} as {_expected(name, value)}") from None
    named = meta["plugin"] and ":" in str(parsed)
    if isinstance(parsed, str) and meta["choices"] and parsed not in meta["choices"] and not named:
        known = ", ".join(meta["choices"]) + (", or module:name" if meta["plugin"] else "")
        hint = nearest(parsed, meta["choices"])
        raise BadInput(f"{name}: unknown value {parsed!r} (known: {known}){hint}")
    for number in parsed if isinstance(parsed, tuple) else (parsed,):
        _check_bounds(name, number, meta)
    return parsed


def _expected(name: str, value: Any) -> str:
    """Says what the value of a field must be, where it is something else."""
    if name.endswith("_kwargs"):
        return f"a JSON object, such as {EXAMPLE}"
    if name == "seeds":
        return "a count (6 are the seeds 0 to 5) or the seeds themselves (0,1,2)"
    kind = _KINDS[TYPES[name]]
    if not callable(value):
        return kind
    schedule = FIELDS.get(f"{name}_schedule")
    if schedule is None:
        return f"{kind}; it does not change over the training"
    choices = ", ".join((*schedule.metadata["choices"], "your function"))
    return f"{kind}; over the training {schedule.name} changes it ({choices})"


def _check_bounds(name: str, value: Any, meta: Mapping[str, Any]) -> None:
    if value is None or isinstance(value, str | bool):
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


def to_json(config: Config) -> dict[str, Any]:
    """Writes the config as JSON values, in field order."""
    values = dataclasses.asdict(config)
    values |= {name: json.loads(values[name]) for name in values if name.endswith("_kwargs")}
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in values.items()
    }
