"""Do the studies' runs still come out the same? `results/revisions.json`.

    python results/revisions.py     (some minutes)

The runs of a study may have been trained by several revisions of the package. Of every study, arm
and revision the first and the last seed of one task are begun again with the package as it is now,
up to the second point of the curves in `results/`, where every stored number is compared (six
digits). Arms that the study has no more are left out: the random controls of 0.1.0, which repeated
the drop rates of whole runs.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from make import CURVES, ROOT, STUDIES, load

from sauna.experiments.study.execute.process import Message, UnitProcess
from sauna.experiments.study.results import DIGITS
from sauna.experiments.study.spec import Arm, load_spec
from sauna.system import run_directory

PATH = ROOT / "results" / "revisions.json"
SECONDS = 300.0  # within which a run has to get there


def chosen() -> Iterator[tuple[str, Arm, dict[str, Any], str]]:
    """A study's name, an arm, its first cell that a revision trained, and the revision."""
    for name in STUDIES:
        seen = set()
        arms = {arm.label: arm for arm in load_spec(name).arms}
        for cell in (load(name) or {"cells": []})["cells"]:
            arm, revision = arms.get(cell["label"]), shown(cell["git"])
            if arm is not None and (arm.label, revision) not in seen:
                seen.add((arm.label, revision))
                yield name, arm, cell, revision


def shown(revisions: str | list[str]) -> str:
    """Seven digits of each, and `+changes` where there were any."""
    found = [revisions] if isinstance(revisions, str) else revisions
    return ", ".join("+".join([r.split("+")[0][:7], *r.split("+")[1:]]) for r in found)


def again(arm: Arm, task: str, wanted: dict[int, int]) -> dict[int, dict[str, Any]]:
    """Each seed's row at its wanted env step, trained now; none where it is not met."""
    waiting, done = set(wanted), threading.Event()

    def hear(message: Message | None) -> None:
        for row in message.get("rows", []) if message else []:
            if row["env_steps"] >= wanted[row["seed"]]:
                waiting.discard(row["seed"])
        if message is None or not waiting:
            done.set()

    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        given = {**arm.overrides(task, tuple(wanted)), "out": str(run), "processes": 1}
        process = UnitProcess(given, Path(folder) / "stderr.txt", hear)
        done.wait(SECONDS)
        process.stop()
        process.end()
        return {
            r["seed"]: r for r in run_directory.rows(run) if r["env_steps"] == wanted[r["seed"]]
        }


def is_equal(row: dict[str, Any] | None, curve: dict[str, list[Any]]) -> bool:
    """Whether a row shows the numbers of the curve's second point."""
    if row is None:
        return False
    now = [float(f"{row[key]:.{DIGITS}g}") if key in row else None for key in CURVES]
    return now == [curve[key][1] for key in CURVES]


def main() -> None:
    os.chdir(ROOT)
    found = []
    for name, arm, cell, revision in chosen():
        ended = [m for m in cell["members"] if m["status"] == "complete"]
        members = {m["seed"]: m["curve"] for m in (ended[0], ended[-1])}
        wanted = {seed: curve["env_steps"][1] for seed, curve in members.items()}
        rows = again(arm, cell["task"], wanted)
        equal = [seed for seed, curve in members.items() if is_equal(rows.get(seed), curve)]
        found.append(
            {
                "study": name,
                "arm": arm.label,
                "task": cell["task"],
                "revision": revision,
                "env_steps": wanted,
                "equal": equal,
            }
        )
        print(found[-1], flush=True)
    now = shown(run_directory.git_revision() or "")
    result = {"command": "python results/revisions.py", "now": now, "runs": found}
    PATH.write_text(json.dumps(result).replace('{"study"', '\n{"study"') + "\n")
    differ = [run for run in found if len(run["equal"]) < len(run["env_steps"])]
    if differ:
        sys.exit(f"{len(differ)} of {len(found)} differ")


if __name__ == "__main__":
    main()
