"""Measurements of one member, as a process.

    python -m sauna.experiments.measure < settings

The first line of standard input holds, as JSON: `compute` (the `module:function` of a
`Measurement`), the run, the member's name, the checkpoints' numbers, and the file that each result
is written to; `scale` is the run, the member and the checkpoint of the scale, or null. Each file is
written whole, so that a process that is stopped loses only the checkpoint it was at. It ends at the
end of standard input. Mistakes are reported as JSON lines.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

from sauna.config.plugins import import_name
from sauna.system import run_directory
from sauna.system.errors import SaunaError
from sauna.system.jax_setup import configure_jax


def measure(settings: dict[str, Any]) -> None:
    """Computes every measurement whose file is not there yet."""
    configure_jax()
    from sauna.experiments.measure.streams import load_snapshot

    compute = import_name("measure", settings["compute"])
    scale: Any = settings.get("scale")
    scale = scale and load_snapshot(Path(scale["run"]), scale["member"], scale["iteration"])
    for iteration, file in zip(settings["iterations"], settings["files"], strict=True):
        if Path(file).exists():
            continue
        snapshot = load_snapshot(Path(settings["run"]), settings["member"], iteration)
        found = compute(snapshot, scale, Path(file))
        place = {"iteration": iteration, "env_steps": snapshot.env_steps}
        run_directory.write_json(Path(file), {**place, **found})


def main() -> int:
    settings = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_our_parent, daemon=True).start()
    try:
        measure(settings)
    except SaunaError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        print(error, file=sys.stderr)
        return 1
    return 0


def _end_with_our_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
