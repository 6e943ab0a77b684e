"""Imports that take less time."""

from __future__ import annotations

import gc
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


@contextmanager
def uncollected() -> Iterator[None]:
    """Collects no garbage in a block that imports much: nearly all of that stays."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


class _PutOff(ModuleType):
    """Stands for a module: the first use of anything in it imports it."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # of the import system, which only looks
            raise AttributeError(name)
        return getattr(importlib.import_module(self.__name__), name)


@contextmanager
def put_off(*names: str) -> Iterator[None]:
    """Lets the imports of a block take stand-ins for these modules, a package before its parts.

    What the block imports keeps its stand-ins; to all others the modules are as before.
    """
    stand_ins = {name: _PutOff(name) for name in names if name not in sys.modules}
    for name, stand_in in stand_ins.items():
        package, _, part = name.rpartition(".")
        if package in stand_ins:
            setattr(stand_ins[package], part, stand_in)
    sys.modules.update(stand_ins)
    try:
        yield
    finally:
        for name in stand_ins:
            del sys.modules[name]
