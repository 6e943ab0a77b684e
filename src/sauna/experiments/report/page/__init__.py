"""Pages that open from disk and fetch nothing: a template, its style, script and data in one file.

Each kind of page has `NAME.html` and `NAME.js` here; `report.css` is everybody's style and
`draw.js` everybody's drawing.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from importlib.resources import files
from string import Template
from typing import Any


def filled(name: str, data: Any, style: str = "", **parts: str) -> str:
    """The page `NAME.html` as text.

    Args:
      data: what the script draws, as JSON values.
      style: CSS behind the common one.
      **parts: the template's other places, as HTML.
    """
    script = asset("draw.js") + asset(f"{name}.js")
    return Template(asset(f"{name}.html")).substitute(
        style=asset("report.css") + style,
        script=script,
        # The browser runs this one script and fetches nothing, whatever a label may hold.
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        data=embedded(data),
        **parts,
    )


def asset(name: str) -> str:
    return (files("sauna.experiments.report") / "page" / name).read_text(encoding="utf-8")


def embedded(value: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def rounded(value: Any) -> Any:
    """A JSON value with its numbers to five digits, and null for those that are not finite."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value
