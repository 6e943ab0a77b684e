"""Registering this package's environments with Gymnasium, at no cost where nobody uses it.

Gymnasium 1 reads no entry points of other packages. So `import sauna` registers: at once if
Gymnasium is loaded, else right after it is. Nothing here imports Gymnasium by itself.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any

_OURS = "sauna.envs.flagrun"  # importing it registers


def register() -> None:
    """Registers now, or as soon as the program imports Gymnasium."""
    if "gymnasium" in sys.modules:
        importlib.import_module(_OURS)
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium:
    """Finds Gymnasium as the other finders do; its loader then also registers."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """Answers for Gymnasium alone; None if the other finders know none."""
        if name != "gymnasium":
            return None
        others = (f for f in sys.meta_path if f is not self and hasattr(f, "find_spec"))
        spec: Any = next((s for f in others if (s := f.find_spec(name, path, target))), None)
        if spec is not None and spec.loader is not None:
            spec.loader.exec_module = _and_register(spec.loader.exec_module, self)
        return spec


def _and_register(execute: Any, finder: _AfterGymnasium) -> Any:
    def exec_module(module: Any) -> None:
        execute(module)
        if finder in sys.meta_path:
            sys.meta_path.remove(finder)
        importlib.import_module(_OURS)

    return exec_module
