"""The numbers of `info` that become metrics: those of the step that ends an episode."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

MAX_NAME = 100  # letters of a key


def numbers_of(info: Any) -> dict[str, float]:
    """The finite single numbers of an `info`; whatever else it holds is left out.

    A truth value is 0 or 1, and an array of a single number is that number.
    """
    found = {}
    for name, value in (info or {}).items():
        if is_metric_name(name) and (number := _number_in(value)) is not None:
            found[name] = number
    return found


def is_metric_name(name: Any) -> bool:
    """Whether a key of `info` can name a metric; `life_lost` has a meaning of its own."""
    usable = isinstance(name, str) and 0 < len(name) <= MAX_NAME and name.isprintable()
    return usable and name != "life_lost"


def _number_in(value: Any) -> float | None:
    if not isinstance(value, int | float) and not is_one_number(value):
        return None
    try:
        number = float(np.asarray(value).reshape(()))
    except (OverflowError, TypeError, ValueError):  # an integer of hundreds of digits
        return None
    return number if math.isfinite(number) else None


def is_one_number(value: Any) -> bool:
    """Whether an array, of NumPy or another library, holds a single real number."""
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    return kind in ("b", "i", "u", "f") and np.size(value) == 1
