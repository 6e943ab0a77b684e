"""Pages that open from disk and fetch nothing: everything is in one file.

Each kind of page is a jinja2 template here, `NAME.html`; `report.css` is the style of all. Every
text is escaped by the templates, and only there. The page of `sauna inspect` also has a script.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

from sauna.experiments.report.style import short

MINUS = "\N{MINUS SIGN}"
# Shapes of matplotlib's markers, as SVG paths about the origin.
MARKERS = {
    "o": "M-3.5,0a3.5,3.5 0 1,0 7,0a3.5,3.5 0 1,0 -7,0Z",
    "s": "M-3.2,-3.2H3.2V3.2H-3.2Z",
    "D": "M0,-4.6L4.6,0L0,4.6L-4.6,0Z",
    "^": "M0,-4.4L4.2,3.2H-4.2Z",
    "v": "M0,4.4L4.2,-3.2H-4.2Z",
    "P": "M-1.4,-4.2H1.4V-1.4H4.2V1.4H1.4V4.2H-1.4V1.4H-4.2V-1.4H-1.4Z",
    "X": "M-4,-2L-2,-4L0,-2L2,-4L4,-2L2,0L4,2L2,4L0,2L-2,4L-4,2L-2,0Z",
}


def render(
    template: str, style: str = "", script: str = "", data: Any = None, **values: Any
) -> str:
    """Renders the page `TEMPLATE.html` as text.

    Args:
      template: its name.
      style: CSS behind the common one.
      script: JavaScript, the only one that the page may run.
      data: what the script reads, as JSON values.
      **values: the template's.
    """
    return (
        _environment()
        .get_template(f"{template}.html")
        .render(
            # These texts are the package's own, or JSON that cannot end its element.
            style=Markup(asset("report.css") + style),
            script=Markup(script),
            script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
            if script
            else "",
            data=Markup(embedded(data)),
            **values,
        )
    )


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(asset),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["markers"] = MARKERS
    environment.tests["finite"] = lambda value: value is not None and math.isfinite(value)
    environment.filters |= {
        "exact": json.dumps,
        "grouped": lambda value, digits: f"{value:,.{digits}f}".replace("-", MINUS),
        "base64": lambda data: base64.b64encode(data).decode(),
        "short": short,
    }
    return environment


def asset(name: str) -> str:
    """Reads a file of this folder."""
    return (files("sauna.experiments.report") / "page" / name).read_text(encoding="utf-8")


def embedded(value: Any) -> str:
    """Writes JSON that cannot end the script element it stands in."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def rounded(value: Any) -> Any:
    """Returns a JSON value with its numbers to five digits, and null for those that are not
    finite."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value
