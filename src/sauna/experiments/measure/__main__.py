"""Measurements of one member, as a process.

    python -m sauna.experiments.measure < settings

The first line of standard input holds, as JSON, what is measured (`noise`, `dial`, `torso`), the
run, the member's name, the checkpoints' numbers, and the file that each measurement is written to;
for `dial` also the run, the member and the checkpoint whose normaliser is the scale. What is
written is whole, so that a process that is stopped loses only the checkpoint it was at. The end of
standard input means that whoever asked is gone: the process ends. Mistakes are told as JSON lines.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

from sauna.system import run_directory
from sauna.system.errors import SaunaError
from sauna.system.jax_setup import configure_jax


def measure(given: dict[str, Any]) -> None:
    """Makes every measurement whose file is not there yet."""
    configure_jax()
    from sauna.experiments.evaluate.artifact import load_artifact
    from sauna.experiments.measure import coverage, noise, posture
    from sauna.experiments.measure.streams import load_standing

    scale: Any = given.get("scale")
    scale = scale and load_standing(Path(scale["run"]), scale["member"], scale["iteration"])
    for iteration, file in zip(given["iterations"], given["files"], strict=True):
        if Path(file).exists():
            continue
        standing = load_standing(Path(given["run"]), given["member"], iteration)
        if given["what"] == "torso":
            artifact = load_artifact(Path(given["run"]), iteration=iteration)
            found = posture.measure(artifact, given["member"], Path(file).with_suffix(".png"))
        elif given["what"] == "noise":
            found = noise.measure(standing)
        else:
            found = coverage.measure(standing, scale)
        place = {"iteration": iteration, "env_steps": standing.env_steps}
        run_directory.write_json(Path(file), {**place, **found})


def main() -> int:
    given = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_our_parent, daemon=True).start()
    try:
        measure(given)
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
