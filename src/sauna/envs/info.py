"""The numbers of `info` that become metrics: those of the step that ends an episode."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

MAX_NAME = 100  # letters of a key
IS_SUCCESS = "is_success"
SUCCESS_RATE, INFO_PREFIX = "success_rate", "info_"  # of the metrics' keys


def numbers_of(info: Any) -> dict[str, float]:
    """The finite single numbers of an `info`; whatever else it holds is left out.

    A truth value is 0 or 1, and an array of a single number is that number.
    """
    found = {}
    for name, value in (info or {}).items():
        if is_metric_name(name) and (number := _number_in(value)) is not None:
            found[name] = number
    return found


def info_means(infos: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each number over the episodes that gave it, in the order of their names."""
    found: dict[str, list[float]] = {}
    for info in infos:
        for name, number in info.items():
            found.setdefault(name, []).append(number)
    return {name: sum(found[name]) / len(found[name]) for name in sorted(found)}


def info_key(name: str) -> str:
    """The metric of a number that environments give in `info`."""
    return SUCCESS_RATE if name == IS_SUCCESS else INFO_PREFIX + name


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
