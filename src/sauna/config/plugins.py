"""`module:name`: the parts of a run that a user brings, found by name."""

from __future__ import annotations

import importlib
import re
import sys
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sauna.config import local
from sauna.system.errors import BadInput, nearest, one_line

LOCAL = local.__name__
STORED_BEFORE = "sauna.local"  # its name in the runs of 0.1.0
RULES = ("filter", "sampler", "loss_weight", "objective", "stop", "critic")  # fields of rules
_UNIQUE = re.compile(r"_[0-9a-f]{16}$")  # ends a part's name; older runs have names that may meet


class NotFound(BadInput):
    """There is no such module where Python looks."""

    def __init__(self, message: str, module: str) -> None:
        super().__init__(message)
        self.module = module


def import_name(key: str, path: str) -> Any:
    """The object behind `module:name`; the working directory counts as a place of modules.

    Raises:
      BadInput: the module or the name does not exist, or importing it failed; or the part was
        passed by value, and this process does not hold it.
    """
    module_name, _, attribute = path.partition(":")
    if is_local(path):
        if not is_held(path):
            raise BadInput(
                f"{key}: was passed by value, and this process does not hold it; pass it again "
                f"from Python as {key}=..."
            )
        return getattr(local, attribute)
    module = import_module(key, module_name, path)
    if not hasattr(module, attribute):
        hint = nearest(attribute, vars(module))
        raise BadInput(f"{key}: module {module_name!r} has no {attribute!r}{hint}")
    return getattr(module, attribute)


def import_module(key: str, module_name: str, path: str) -> Any:
    """A module of a user's, which may lie in the working directory.

    Args:
      path: the whole `module:name`, of which a message is made.

    Raises:
      NotFound: there is no such module.
      BadInput: it is a file's name, or importing it failed.
    """
    if module_name.endswith(".py") or "/" in module_name:
        file = Path(module_name)
        name = ".".join(file.with_suffix("").parts)
        where = f"in the folder {file.parent}, " * file.is_absolute()
        name = file.stem if file.is_absolute() else name.lstrip(".")
        raise BadInput(
            f"{key}: {module_name} is a file; {where}write the module: "
            f"{name}:{path.rpartition(':')[2]}"
        )
    if module_name.partition(".")[0] in sys.stdlib_module_names:
        raise BadInput(f"{key}: {module_name!r} is a part of Python, which no run may call")
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return importlib.import_module(module_name)
    except Exception as error:  # a user's module may fail in any way; all are bad input
        text = f"{key}: cannot import {module_name!r}"
        if isinstance(error, ModuleNotFoundError) and _leads_to(error.name, module_name):
            near = nearest(module_name, (file.stem for file in Path.cwd().glob("*.py")))
            places = f"{Path.cwd()}, on PYTHONPATH, or among the installed packages"
            raise NotFound(f"{text}: it is not in {places}{near}", module_name) from error
        raise BadInput(f"{text}: {one_line(error)}") from error


def _leads_to(missing: str | None, module_name: str) -> bool:
    """Whether a missing module is the one that is asked for, or a package above it."""
    return missing is not None and f"{module_name}.".startswith(f"{missing}.")


def name_of(thing: Any) -> str:
    """`module:name` of a function, class or object that a user passed by value.

    What other processes could not import by name (a lambda, something of `__main__`) is put into
    `sauna.config.local`, under a name that no other part of any process has; a run with such a
    part trains in a thread of this process.
    """
    if isinstance(thing, str):
        return thing
    module = getattr(thing, "__module__", None)
    name = getattr(thing, "__qualname__", None)
    importable = isinstance(module, str) and isinstance(name, str) and module != "__main__"
    if importable and getattr(sys.modules.get(str(module)), str(name), None) is thing:
        return f"{module}:{name}"
    name = "".join(c if c.isalnum() else "_" for c in name or type(thing).__name__)
    name = f"{name}_{uuid.uuid4().hex[:16]}"
    setattr(local, name, thing)
    return f"{LOCAL}:{name}"


def label_of(arm: str, settings: Mapping[str, Any]) -> str:
    """Names an arm by the user's own rules as well: `ppo+my_module.rule`, fit for a folder."""
    named = [str(settings[field]) for field in RULES if ":" in str(settings.get(field, ""))]
    short = [_UNIQUE.sub("", name.partition(":")[2]) if is_local(name) else name for name in named]
    first, plus, others = arm.partition("+")
    return "+".join([first, *(re.sub(r"[^\w.-]", ".", name) for name in short)]) + plus + others


def is_held(path: str) -> bool:
    """Whether this process holds the part that was passed by value under this name."""
    return hasattr(local, path.partition(":")[2])


def provide(run: Path, given: Mapping[str, Any], parts: Sequence[str]) -> dict[str, Any]:
    """Puts parts passed by value where a run's config looks for them; returns the rest.

    Args:
      parts: the fields that may be passed by value.

    Raises:
      BadInput: a part is given that the run finds by name, or one is missing.
    """
    from sauna.system import run_directory  # which Windows cannot import

    config = run_directory.read_config(run, exported=True).get("config", {})
    for name in parts:
        path = str(config.get(name))
        if is_local(path):
            if name in given:
                setattr(local, path.partition(":")[2], given[name])
            elif not (_UNIQUE.search(path) and is_held(path)):
                raise BadInput(f"{name}: was passed by value; pass it again as {name}=...")
        elif name in given:
            raise BadInput(f"{name}: the run finds its own by name ({config.get(name)})")
    return {name: value for name, value in given.items() if name not in parts}


def is_local(path: str) -> bool:
    """Whether `module:name` names a part that was passed by value."""
    return path.partition(":")[0] in (LOCAL, STORED_BEFORE)
