"""Numbers as HTML tables. All that comes from data is escaped here, and only once."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence

MINUS, DOT = "\N{MINUS SIGN}", "\N{MIDDLE DOT}"


def number(value: float | None, digits: int) -> str:
    """`1,345.2` in a `data` element that holds the exact value; `-` where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    shown = f"{value:,.{digits}f}".replace("-", MINUS)
    return f'<data value="{json.dumps(value)}">{shown}</data>'


def with_interval(values: Sequence[float | None] | None, digits: int) -> str:
    """A value and, after it, its interval; `-` for what is missing."""
    if values is None or values[0] is None:
        return "-"
    value, low, high = (number(v, digits) for v in values)
    interval = "-" if low == high == "-" else f"[{low}, {high}]"
    return f'{value} <span class="interval">{interval}</span>'


def mean_and_std(mean: float | None, std: float | None, digits: int) -> str:
    """`1,345 ± 95`; `-` for what is missing."""
    if mean is None:
        return "-"
    return f"{number(mean, digits)} &plusmn; {number(std, digits)}"


def table(
    head: Sequence[str],
    rows: Iterable[tuple[str, Sequence[str]]],
    *,
    caption: str = "",
    name: str = "",
) -> str:
    """A table in a box that scrolls sideways; each row is its header and its cells, as HTML.

    A row without cells is the heading of those that follow.
    """
    columns = "".join(f'<th scope="col">{text}</th>' for text in head)
    body, opened = "", False
    for first, cells in rows:
        if cells:
            inside = "".join(f"<td>{cell}</td>" for cell in cells)
            body += f'<tr><th scope="row">{first}</th>{inside}</tr>\n'
            continue
        body += "</tbody><tbody>" if opened else ""
        heading = f'<th scope="rowgroup" colspan="{len(head)}"><span>{first}</span></th>'
        body += f'<tr class="group">{heading}</tr>\n'
        opened = True
    described = f"<caption>{caption}</caption>" if caption else ""
    box = f'<div class="wide" role="region" tabindex="0" aria-label="{name}">' if name else "<div>"
    return (
        f"{box}<table>{described}<thead><tr>{columns}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )
