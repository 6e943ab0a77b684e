"""`module:name`: the parts of a run that a user brings, found by name."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from sauna.config import local
from sauna.system.errors import BadInput, nearest, one_line

LOCAL = local.__name__
STORED_BEFORE = "sauna.local"  # its name in the runs of 0.1.0


def import_name(key: str, path: str) -> Any:
    """The object behind `module:name`; the working directory counts as a place of modules.

    Raises:
      BadInput: the module or the name does not exist, or importing it failed.
    """
    module_name, _, attribute = path.partition(":")
    if is_local(path):
        module_name = LOCAL
    if module_name.partition(".")[0] in sys.stdlib_module_names:
        raise BadInput(f"{key}: {module_name!r} is a part of Python, which no run may call")
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # a user's module may fail in any way; all are bad input
        raise BadInput(f"{key}: cannot import {module_name!r}: {one_line(error)}") from error
    if not hasattr(module, attribute):
        hint = nearest(attribute, vars(module))
        raise BadInput(f"{key}: module {module_name!r} has no {attribute!r}{hint}")
    return getattr(module, attribute)


def name_of(thing: Any) -> str:
    """`module:name` of a function, class or object that a user passed by value.

    What other processes could not import by name (a lambda, something of `__main__`) is put into
    `sauna.config.local`; a run with such a part trains in a thread of this process.
    """
    if isinstance(thing, str):
        return thing
    module = getattr(thing, "__module__", None)
    name = getattr(thing, "__qualname__", None)
    importable = isinstance(module, str) and isinstance(name, str) and module != "__main__"
    if importable and getattr(sys.modules.get(str(module)), str(name), None) is thing:
        return f"{module}:{name}"
    name = "".join(c if c.isalnum() else "_" for c in name or type(thing).__name__)
    setattr(local, name, thing)
    return f"{LOCAL}:{name}"


def is_local(path: str) -> bool:
    """Whether `module:name` names a part that was passed by value."""
    return path.partition(":")[0] in (LOCAL, STORED_BEFORE)
