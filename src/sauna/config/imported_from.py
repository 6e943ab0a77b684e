"""Where a run's own modules were imported from: a hint for whoever opens it elsewhere.

Nothing is ever imported from there by itself: a run directory may be somebody else's.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from sauna.config.plugins import NotFound
from sauna.config.trust import named_code
from sauna.system.errors import BadInput
from sauna.system.tracebacks import is_users

KEY = "imported_from"  # of `config.json`
F = TypeVar("F", bound=Callable[..., Any])


def folders_of(stored: Mapping[str, Any]) -> dict[str, str]:
    """`{module: folder}` of the user's own modules that a config names: what was on the path."""
    found = {}
    for _, name in named_code(stored):
        module = name.partition(":")[0]
        file = getattr(sys.modules.get(module), "__file__", None)
        if file is not None and is_users(file):
            above = module.count(".") + (Path(file).name == "__init__.py")
            found[module] = str(Path(file).resolve().parents[above])
    return found


def names_the_folder(open_run: F) -> F:
    """Decorates a function of a run, its first argument: says where the run found a module.

    Only if that cannot be found now, and the run knows.
    """
    first = next(iter(inspect.signature(open_run).parameters))

    @functools.wraps(open_run)
    def call(*args: Any, **kwargs: Any) -> Any:
        run = Path.cwd() / (args[0] if args else kwargs.get(first, ""))
        try:
            return open_run(*args, **kwargs)
        except NotFound as error:
            from sauna.system import run_directory  # which Windows cannot import

            if not (run / "config.json").exists():  # an exported policy does not know
                raise
            folders = run_directory.read_config(run, needed=()).get(KEY)
            folder = folders.get(error.module) if isinstance(folders, dict) else None
            if not isinstance(folder, str):
                raise
            raise BadInput(
                f"{error}; the run imported it from {folder}: run there, or set PYTHONPATH={folder}"
            ) from error

    return cast(F, call)
