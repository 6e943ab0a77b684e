"""What `results/exports.json` says, for `docs/how-to/deploy.md`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from studies import markdown


def exports_text(found: Mapping[str, Any]) -> str:
    """The largest difference of all kinds in a line, and a table of each."""
    rows = found["kinds"]
    versions = ", ".join(f"{name} {number}" for name, number in found["versions"].items())
    most = max(max(row["numpy"], row["onnx"]) for row in rows.values())
    line = (
        f"Both forms of {len(rows)} kinds of policy ran in an environment without JAX, with "
        f"{versions}. No action differs from the policy's own by more than {most:.0e}, relative to "
        "its size if that is above 1 (`python results/exports.py`, numbers in "
        "`results/exports.json`)."
    )
    table = [["Policy, with random weights", "Observations", "Different actions", "NumPy", "ONNX"]]
    for kind, row in rows.items():
        counts = (f"{row[name]:,}" for name in ("observations", "actions"))
        table.append([kind, *counts, _shown(row["numpy"]), _shown(row["onnx"])])
    summary = "<summary>Largest difference of each kind</summary>"
    return f'{line}\n\n<details markdown="1">{summary}\n\n{markdown(table)}\n\n</details>'


def _shown(difference: float) -> str:
    return f"{difference:.0e}" if difference else "0"
