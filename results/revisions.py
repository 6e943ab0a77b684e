"""Do the studies' runs still come out the same? `results/revisions.json`.

    python results/revisions.py     (needs runs/; some minutes)

The runs of a study may have been trained by several revisions of the package. Of every study, arm
and revision one run is begun again with the package as it is now, and its first rows of metrics are
compared with those that were stored then, every number bit for bit.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from make import MEASURED, ROOT, STUDIES

from sauna import rundir
from sauna.study.process import Message, UnitProcess
from sauna.study.spec import load_spec
from sauna.study.units import Unit, parts, units_of

FOLDER = ROOT / "runs" / "units"
PATH = ROOT / "results" / "revisions.json"
ITERATIONS = 4
SECONDS = 300.0  # within which they have to be trained


def chosen() -> Iterator[tuple[str, str, Unit]]:
    """A study's name, a revision, and the first unit of an arm that it trained."""
    seen = set()
    for name in (*STUDIES, *MEASURED):
        stored = ROOT / "runs" / name / "study.json"
        if not stored.exists():
            continue
        whole = units_of(load_spec(name), json.loads(stored.read_text())["seeds_per_unit"])
        for unit in itertools.chain.from_iterable(parts(one, FOLDER) for one in whole):
            if unit.is_complete(FOLDER):
                git = short(rundir.read_config(unit.run(FOLDER))["git"])
                if (name, unit.label, git) not in seen:
                    seen.add((name, unit.label, git))
                    yield name, git, unit


def short(revision: str | None) -> str:
    """Seven digits, and `+changes` where there were any."""
    commit, *changes = str(revision).split("+")
    return "+".join([commit[:7], *changes])


def again(unit: Unit, place: Path) -> list[dict[str, Any]]:
    """The rows of its first iterations, trained now; none where the run fails."""
    wanted, done = ITERATIONS * len(unit.seeds), threading.Event()
    rows = 0

    def hear(message: Message | None) -> None:
        nonlocal rows
        rows += len(message.get("rows", [])) if message else 0
        if message is None or rows >= wanted:
            done.set()

    given = {**unit.given(FOLDER), "out": str(place / "run")}
    process = UnitProcess(given, place / "stderr.txt", hear)
    done.wait(SECONDS)
    process.stop()
    process.end()
    return rundir.rows(place / "run")[:wanted]


def main() -> None:
    os.chdir(ROOT)
    found = []
    for name, git, unit in chosen():
        with tempfile.TemporaryDirectory() as folder:
            rows = again(unit, Path(folder))
        stored = rundir.rows(unit.run(FOLDER))[: ITERATIONS * len(unit.seeds)]
        equal = sum(one == other for one, other in zip(rows, stored, strict=False))
        found.append({"study": name, "arm": unit.label, "task": unit.task, "revision": git,
                      "rows": len(stored), "equal": equal})  # fmt: skip
        print(found[-1], flush=True)
    now = short(rundir.git_revision())
    result = {"command": "python results/revisions.py", "now": now, "iterations": ITERATIONS,
              "runs": found}  # fmt: skip
    PATH.write_text(json.dumps(result).replace('{"study"', '\n{"study"') + "\n")
    if any(run["equal"] < run["rows"] for run in found):
        sys.exit("some rows differ")


if __name__ == "__main__":
    main()
