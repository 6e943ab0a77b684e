"""What several rules share: ranks, counts, and the mask of the rows that score highest."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array


def count_of(share: float, rows: int) -> int:
    """Rounds up: `ceil(share * rows)`, at least 1; a float product's last bit does not count."""
    return min(rows, max(1, math.ceil(share * rows - 1e-6)))


def check_range(name: str, value: float, low: float, high: float = math.inf) -> None:
    """Refuses a rule's argument outside `low <= value <= high`.

    Raises:
      ValueError: naming it; also if it is no number.
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not low <= value <= high:
        bounds = f"at least {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
        raise ValueError(f"{name} must be a number {bounds}, not {value!r}")


def check_share(value: float) -> None:
    """Refuses a share of rows outside (0, 1].

    Raises:
      ValueError: it is outside, or no number.
    """
    check_range("share", value, 0.0, 1.0)
    if value == 0:
        raise ValueError("share must be above 0: it is how many rows are taken")


def check_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    """Refuses a word that a rule does not know.

    Raises:
      ValueError: naming the known ones.
    """
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}, not {value!r}")


def ranks(score: Array, eligible: Array) -> Array:
    """Ranks rows `[M]` from 0, the largest score first; where scores tie, the lower row first.

    Rows that are not eligible come last.
    """
    order = jnp.argsort(jnp.where(eligible, -score, jnp.inf), stable=True)
    return jnp.zeros(len(score), jnp.int32).at[order].set(jnp.arange(len(score), dtype=jnp.int32))


def largest(score: Array, count: int | Array, eligible: Array) -> Array:
    """Marks the `count` eligible rows of largest score; where scores tie, the lower rows.

    If the count is static, no full sort is needed.
    """
    if not isinstance(count, int):
        return (ranks(score, eligible) < count) & eligible
    _, found = jax.lax.top_k(jnp.where(eligible, score, -jnp.inf), count)
    return jnp.zeros(len(score), bool).at[found].set(True) & eligible
