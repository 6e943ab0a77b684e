"""Fields of `Config` as flags of a command and keywords of a function: types, defaults, help."""

from __future__ import annotations

import argparse
import dataclasses
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

from sauna.config.fields import GROUPS
from sauna.config.presets import arm_config
from sauna.config.settings import FIELDS, TYPES, Config, flag
from sauna.config.zoo import AUTO, entry_of
from sauna.system.errors import BadInput

FIRST = "most needed"
F = TypeVar("F", bound=Callable[..., Any])


def add_fields(
    parser: argparse.ArgumentParser, names: Iterable[str], values: Mapping[str, Any]
) -> None:
    """Adds a flag for each field: those that most people need first, then group by group.

    Args:
      values: the default of each field that the help shows.
    """
    chosen = list(names)
    for title in (FIRST, *GROUPS):
        members = [name for name in chosen if _title(name) == title]
        if not members:
            continue
        group = parser.add_argument_group(f"{title}{_of_preset(title, values)}")
        for name in members:
            _add_field(group, name, values[name])
        _add_accepted(group, members)


def lists_settings(names: Iterable[str]) -> Callable[[F], F]:
    """Makes a decorator that adds the fields to a function's docstring, for `help`."""
    texts = (f"      {name}: {FIELDS[name].metadata['help']}" for name in names)
    head = "\n    Settings (the preset has what is not given; `sauna train ENV --help` shows it):\n"
    listed = head + "\n".join(texts) + "\n    "

    def add(function: F) -> F:
        function.__doc__ = (function.__doc__ or "").rstrip(" ") + listed
        return function

    return add


def _of_preset(title: str, values: Mapping[str, Any]) -> str:
    preset = values["preset"]
    numbers = title in ("learning", "network", "normalisation")
    return f" (defaults of preset {preset})" if preset and numbers else ""


def _title(name: str) -> str:
    meta = FIELDS[name].metadata
    return FIRST if meta["common"] else str(meta["group"])


def _add_field(group: Any, name: str, value: Any) -> None:
    text = FIELDS[name].metadata["help"]
    shown = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
    shown = "none" if value is None else shown
    if name == "seeds" and value == (0,):
        shown = "1: seed 0"
    if name == "preset":
        shown = ""  # its text says what is taken
    text += f" (default {shown})" if shown else ""
    how: dict[str, Any] = {"metavar": metavar(name)}
    if TYPES[name] is bool:
        how = {"action": argparse.BooleanOptionalAction}
    group.add_argument(flag(name), default=argparse.SUPPRESS, help=text.replace("%", "%%"), **how)


def _add_accepted(group: Any, chosen: list[str]) -> None:
    """Adds the flags that stand for one of the fields `chosen`; see `accepted.translate`."""
    batch = "samples per minibatch, in place of --minibatches"
    kl = "stop an iteration whose KL divergence exceeds 1.5 times this, in place of --stop"
    texts = {
        "seeds": ("seed", "INT", "this one seed, in place of --seeds"),
        "rollout_steps": ("batch_size", "INT", batch),
        "stop": ("target_kl", "FLOAT", kl),
    }
    for ours, (name, kind, text) in texts.items():
        if ours in chosen:
            group.add_argument(flag(name), default=argparse.SUPPRESS, help=text, metavar=kind)


def metavar(name: str) -> str:
    """Writes a field's type for the help: INT, FLOAT, INT,..., TEXT, or its choices."""
    meta, field_type = FIELDS[name].metadata, TYPES[name]
    if name.endswith("_kwargs"):
        return "JSON"
    if meta["choices"]:
        return "|".join((*meta["choices"], *(["MODULE:NAME"] if meta["plugin"] else [])))
    if typing.get_origin(field_type) is tuple:
        item = typing.get_args(field_type)[0]
        return "NAME,..." if item is str else "INT,..."
    return {int: "INT", float: "FLOAT", float | None: "FLOAT"}.get(field_type, "TEXT")


def shown_values(arguments: Sequence[str], arm: str | None = None) -> dict[str, Any]:
    """Finds the defaults that hold for a command line: of the arm, preset or environment it names.

    Args:
      arguments: all of them; what is wrong in them is found later.
      arm: whose values count; None: of the one named, or the default.
    """
    reader = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("--arm", "--preset", "--algorithm"):
        reader.add_argument(name)
    for name in ("command", "env"):
        reader.add_argument(name, nargs="?")
    try:
        named, _ = reader.parse_known_args(list(arguments))
        own = ("preset", "algorithm")
        preset = {n: v for n in own if (v := getattr(named, n)) is not None}
        known = named.command == "train" and entry_of(named.env or "") is not None
        if known and "preset" not in preset:
            preset |= {"env": named.env, "preset": AUTO}
        first = arm or str(named.arm or Config.arm[0]).split(",")[0]
        config = arm_config(first, preset)
    except (argparse.ArgumentError, BadInput):
        config = Config()
    return {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
