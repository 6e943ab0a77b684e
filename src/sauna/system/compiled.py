"""Small loops that run once per vector step, compiled for the host by Numba.

On a few dozen numbers a numpy call costs far more than its arithmetic. Compiled loops cost what
their arithmetic costs. Nothing is reordered
(no fast-math), so a loop gives the bits that it says.

A compiled function may only call compiled functions and read constants of its own file, and of no
library: the cache on disk is renewed when that file changes, not when something else does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` compiled at its first call, or read from the cache of an earlier process."""
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # no folder that could be written to: compiled anew in each process
        return numba.njit(error_model="numpy")(function)


def compiled_for_c(signature: Any, function: Callable[..., Any]) -> Any:
    """`function` compiled now, or read from the cache, as C may call it: its `ctypes` points to it.

    Args:
      signature: Numba's types of the result and the arguments.
    """
    try:
        return numba.cfunc(signature, cache=True)(function)
    except RuntimeError:  # as above
        return numba.cfunc(signature)(function)
