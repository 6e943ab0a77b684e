"""Fills the reference pages from the program itself, when the site is built.

A line `<!-- generated: NAME -->` of a page is replaced by what `PARTS[NAME]` returns: the commands
and their arguments from the parser, the settings, presets and arms from the configuration, the
public names from the package. Nothing of it is stored, so nothing can be out of date.

    python docs/_build/reference.py NAME    prints one part
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable
from typing import Any

import sauna
from sauna import cli
from sauna.config import presets
from sauna.config.fields import GROUPS
from sauna.config.settings import FIELDS, TYPES, flag

MARK = re.compile(r"<!-- generated: (\w+) -->")
API_ORDER = ("train", "resume", "load", "evaluate", "compare", "inspect", "export", "push", "pull", "Result")
POLICY = "sauna.experiments.evaluate.policy.TrainedPolicy"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """MkDocs' hook: a page's Markdown with its generated parts."""
    return MARK.sub(lambda found: PARTS[found[1]](), markdown)


def commands() -> str:
    """A table of the commands."""
    rows = [[f"[`sauna {name}`](#sauna-{name})", text] for name, (_, text) in _commands().items()]
    return _table(["Command", "What it does"], rows)


def arguments() -> str:
    """A section for each command; settings of training link to their own page."""
    parts = []
    for name, (command, text) in _commands().items():
        parts += [f"## sauna {name}", f"{text}.", *_arguments(command)]
    return "\n\n".join(parts)


def _commands() -> dict[str, tuple[argparse.ArgumentParser, str]]:
    parser = cli.make_parser()
    (action,) = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    helps = {choice.dest: choice.help or "" for choice in action._choices_actions}
    return {name: (p, _sentence(helps.get(name, ""))) for name, p in action.choices.items()}


def _arguments(command: argparse.ArgumentParser) -> Iterable[str]:
    own, settings = [], []
    for action in command._actions:
        if action.option_strings and _is_setting(action):
            settings.append(action.dest)
        elif action.dest != "help":
            own.append(_argument(action))
    if own:
        yield _table(["Argument", "Meaning"], own)
    if settings:
        yield _settings_of(settings)


def _argument(action: argparse.Action) -> list[str]:
    text = _sentence((action.help or "").replace("%%", "%"))
    if action.option_strings:
        return [f"`{action.option_strings[0]}`", f"{text}."]
    if action.choices:
        choices = ", ".join(f"`{choice}`" for choice in action.choices)
        return [f"`{action.dest.upper()}`", f"One of {choices}."]
    return [f"`{action.metavar or action.dest}`".replace("|", r"\|"), f"{text}."]


def _is_setting(action: argparse.Action) -> bool:
    """Whether an option is a field of the configuration, and not another one of the same name."""
    field = FIELDS.get(action.dest)
    text = (action.help or "").replace("%%", "%")
    return field is not None and text.startswith(field.metadata["help"])


def _settings_of(names: list[str]) -> str:
    """Which settings a command takes: all of them but a few, or a few."""
    missing = [name for name in FIELDS if name not in names and name != "env"]
    if len(missing) > len(names):
        return f"These [settings](settings.md) are flags: {_flags(names)}."
    but = f", except {_flags(missing)}" if missing else ""
    return f"Every [setting](settings.md) is a flag{but}."


def _flags(names: list[str]) -> str:
    return ", ".join(f"[`{flag(name)}`](settings.md#{name})" for name in names)


def settings() -> str:
    """A table of the fields of the configuration for each group of them."""
    parts = []
    for group in GROUPS:
        names = [name for name, field in FIELDS.items() if field.metadata["group"] == group]
        rows = [[f'<span id="{n}"></span>`{flag(n)}`', _default(n), _meaning(n)] for n in names]
        parts += [f"## {_sentence(group)}", _table(["Setting", "Default", "Meaning"], rows)]
    return "\n\n".join(parts)


def _default(name: str) -> str:
    default = FIELDS[name].default
    if isinstance(default, tuple):
        default = ",".join(map(str, default))
    if isinstance(default, bool):
        default = "on" if default else "off"
    default = "none" if default is None else default
    return "" if default == "" else f"`{default}`"


def _meaning(name: str) -> str:
    """The help line, and what values are accepted."""
    meta = FIELDS[name].metadata
    text = f"{_sentence(meta['help'])}."
    if meta["choices"]:
        own = ", or `module:name`" if meta.get("plugin") else ""
        text += f" One of {', '.join(f'`{choice}`' for choice in meta['choices'])}{own}."
    words = {"at_least": "at least", "above": "above", "at_most": "at most"}
    bounds = [f"{word} {meta[key]:g}" for key, word in words.items() if meta.get(key) is not None]
    if bounds:
        text += f" {_sentence(' and '.join(bounds))}."
    if TYPES[name] is bool:
        text += f" `--no-{name.replace('_', '-')}` turns it off."
    return text.replace("|", r"\|")


def preset_table() -> str:
    """A table of the presets."""
    rows = [
        [f"`{name}`", _sentence(presets.PRESET_HELP[name]), _changes(values)]
        for name, values in presets.PRESETS.items()
    ]
    return _table(["Preset", "What it is", "Differs from the defaults in"], rows)


def arm_table() -> str:
    """A table of the arms."""
    rows = [
        [f"`{name}`", _sentence(presets.ARM_HELP[name]).replace("|", r"\|"), _changes(values)]
        for name, values in presets.ARMS.items()
    ]
    return _table(["Arm", "What it is", "Sets"], rows)


def control_table() -> str:
    """A table of the controls that an arm can be joined to."""
    rows = [
        [f"`{name}`", _sentence(text).replace("|", r"\|"), f"`gigaflow+{name}`"]
        for name, text in presets.CONTROL_HELP.items()
    ]
    return _table(["Control", "Takes", "Example"], rows)


def _changes(values: dict[str, Any]) -> str:
    return ", ".join(f"`{name}={value}`" for name, value in values.items()) or "nothing"


def api() -> str:
    """A line for mkdocstrings for each public name."""
    order = [name for name in API_ORDER if name in sauna.__all__]
    order += [name for name in sauna.__all__ if name not in order]
    homes = [f"{getattr(sauna, name).__module__}.{name}" for name in order]
    return "\n\n".join(f"::: {path}" for path in (*homes, POLICY))


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines)


PARTS: dict[str, Callable[[], str]] = {
    "commands": commands,
    "arguments": arguments,
    "settings": settings,
    "presets": preset_table,
    "arms": arm_table,
    "controls": control_table,
    "api": api,
}

if __name__ == "__main__":
    print(PARTS[sys.argv[1]]())
