"""Do the studies' runs still come out the same? `results/revisions.json`.

    python results/revisions.py     (needs runs/; some minutes)

The runs of a study may have been trained by several revisions of the package. Of every study, arm
and revision one run is begun again with the package as it is now, and its first rows of metrics are
compared with those that were stored then, every number bit for bit.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from make import ROOT, STUDIES

from sauna import rundir
from sauna.study.process import UnitProcess
from sauna.study.spec import load_spec
from sauna.study.units import Unit, units_of

FOLDER = ROOT / "runs" / "units"
PATH = ROOT / "results" / "revisions.json"
ITERATIONS = 4
SECONDS = 300.0  # within which they have to be trained


def chosen() -> Iterator[tuple[str, str, Unit]]:
    """A study's name, a revision, and the first unit of an arm that it trained."""
    seen = set()
    for name in STUDIES:
        stored = ROOT / "runs" / name / "study.json"
        if not stored.exists():
            continue
        for unit in units_of(load_spec(name), json.loads(stored.read_text())["seeds_per_unit"]):
            if unit.is_complete(FOLDER):
                git = str(rundir.read_config(unit.run(FOLDER))["git"])
                if (name, unit.label, git) not in seen:
                    seen.add((name, unit.label, git))
                    yield name, git, unit


def again(unit: Unit, place: Path) -> list[dict[str, Any]]:
    """The rows of its first iterations, trained now."""
    given = {**unit.given(FOLDER), "out": str(place / "run")}
    process = UnitProcess(given, place / "stderr.txt", lambda message: None)
    wanted, until = ITERATIONS * len(unit.seeds), time.monotonic() + SECONDS
    while len(rundir.rows(place / "run")) < wanted and time.monotonic() < until:
        time.sleep(0.5)
    process.stop()
    process.end()
    return rundir.rows(place / "run")[:wanted]


def main() -> None:
    found = []
    for name, git, unit in chosen():
        with tempfile.TemporaryDirectory() as folder:
            rows = again(unit, Path(folder))
        stored = list(itertools.islice(rundir.rows(unit.run(FOLDER)), len(rows)))
        equal = sum(one == other for one, other in zip(rows, stored, strict=True))
        found.append({"study": name, "arm": unit.label, "task": unit.task, "revision": git[:7],
                      "rows": len(rows), "equal": equal})  # fmt: skip
        print(found[-1], flush=True)
    result = {"command": "python results/revisions.py", "now": rundir.git_revision(), "runs": found}
    PATH.write_text(json.dumps(result, indent=None).replace('{"study"', '\n{"study"') + "\n")
    if any(one["rows"] == 0 or one["equal"] < one["rows"] for one in found):
        sys.exit("some rows differ")


if __name__ == "__main__":
    main()
