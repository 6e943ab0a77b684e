"""All rows in full: one table, and `results/reliability.json`, row by row as they come.

    python tests/faults/campaign.py                 every row that is not there yet (hours)
    python tests/faults/campaign.py --row 2 --row 9 these rows only
    python tests/faults/campaign.py --again         also what is there already
    python tests/faults/campaign.py --scale small   what `make test` tries; nothing is stored
    python tests/faults/campaign.py --docs          the tables of the page on reliability

A row is kept as long as the sources that it was measured with are the same.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]
RESULTS = ROOT / "results" / "reliability.json"
DOCS = ROOT / "docs" / "concepts" / "reliability.md"
SEED = 20240229

# Row: what is broken, the module of its experiment, tries in full and small.
ROWS: dict[int, tuple[str, str, int, int]] = {
    1: ("killed while saving: crash states", "test_01_killed_while_saving", 2000, 200),
    2: ("SIGKILL while training", "test_02_killed_while_training", 200, 2),
    3: ("bit flips and truncations", "test_03_bit_rot", 10_000, 300),
    4: ("malicious files", "test_04_malicious_checkpoint", 60, 60),
    5: ("other version, environment or network", "test_05_other_version", 40, 40),
    6: ("NaN or infinity from an environment", "test_06_not_a_number", 50, 20),
    7: ("NaN in loss or gradient", "test_07_poisoned_batch", 40, 12),
    8: ("worker dies, hangs, raises", "test_08_workers", 100, 4),
    9: ("SIGINT, SIGTERM", "test_09_signals", 100, 2),
    10: ("disk full, read-only, EIO", "test_10_disk_full", 100, 30),
    11: ("two processes, one run", "test_11_two_processes", 50, 3),
    12: ("bad configurations", "test_12_bad_configuration", 300, 100),
    13: ("one seed of a study fails, study killed", "test_13_failing_seed", 10, 1),
    14: ("log ahead of checkpoint", "test_14_log_ahead", 100, 30),
    15: ("hostile runs, studies and configs", "test_15_hostile_runs", 60, 60),
}


def sources() -> str:
    """A digest of the package."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "src").rglob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def load() -> dict[str, Any]:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {"rows": {}}


def measure(row: int, scale: str) -> dict[str, Any]:
    """One row's experiment."""
    from sauna.system import run_directory

    name, module, full, small = ROWS[row]
    tries, clock = full if scale == "full" else small, time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        result = import_module(f"faults.{module}").experiment(tries, SEED, Path(place))
    return {
        "row": name,
        **result._asdict(),
        "seconds": round(time.monotonic() - clock, 1),
        "sources": sources(),
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
    }


def store(row: int, found: dict[str, Any]) -> None:
    """Into the file as it is now: another row may have been stored meanwhile."""
    stored = load()
    stored["rows"][f"{row:02d}"] = found
    stored["rows"] = dict(sorted(stored["rows"].items()))
    RESULTS.write_text(json.dumps(stored, indent=1) + "\n")


def table(rows: dict[str, dict[str, Any]]) -> list[str]:
    head = ("row", "tried", "lost", "silent", "worst time")
    lines = [head] + [
        (
            f"{int(number)} {row['row']}",
            f"{row['tried']:,}",
            str(row["lost"]),
            str(row["silent"]),
            f"{row['worst']:.3g} s",
        )
        for number, row in rows.items()
    ]
    return ["| " + " | ".join(line) + " |" for line in [head, ("---",) * 5, *lines[1:]]]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--row", type=int, action="append", choices=list(ROWS))
    parser.add_argument("--scale", choices=("full", "small"), default="full")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--docs", action="store_true")
    given = parser.parse_args()
    rows = {} if given.docs else _measure_all(given)
    if given.scale == "full":
        rows = load()["rows"]
        if DOCS.exists():
            from faults.docs import write

            write(DOCS, load())
    print("\n".join(table(rows)))
    return int(any(row["lost"] or row["silent"] for row in rows.values()))


def _measure_all(given: argparse.Namespace) -> dict[str, dict[str, Any]]:
    rows, now = {}, sources()
    for row in given.row or ROWS:
        before = load()["rows"].get(f"{row:02d}")
        if given.scale == "full" and before and before["sources"] == now and not given.again:
            continue
        print(f"row {row}: {ROWS[row][0]} ...", flush=True)
        rows[f"{row:02d}"] = found = measure(row, given.scale)
        print(f"  {found}", flush=True)
        if given.scale == "full":
            store(row, found)
    return rows


if __name__ == "__main__":
    sys.exit(main())
