"""Makes the zoo, `src/sauna/training/zoo/`, of runs that `results/zoo.py` or `sauna train` left.

    python results/zoo_policies.py runs/zoo                     every complete run in the folder
    python results/zoo_policies.py runs/zoo --only Hopper-v5    these alone

A policy is `sauna export` of one member: of a run with several, which `sauna eval --deterministic`
has to have evaluated, the one with the highest return there. The return in its card is of other
episodes. A policy of the zoo that is there already is replaced.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from pathlib import Path
from typing import Any

import sauna
from sauna.experiments.run_list import find_runs
from sauna.experiments.share.card import placed
from sauna.system import run_directory

ZOO = Path(__file__).parent.parent / "src" / "sauna" / "training" / "zoo"
LARGEST = 600_000  # bytes of a policy's folder


def best_member(run: Path) -> str:
    """Names the member with the highest evaluated return, or the only one.

    Raises:
      SystemExit: there are several, and none is evaluated.
    """
    config = run_directory.read_config(run)["config"]
    names = [f"{arm}/{seed}" for arm in config["arm"] for seed in config["seeds"]]
    path = run / "evaluation_deterministic.json"
    if len(names) == 1:
        return names[0]
    if not path.exists():
        raise SystemExit(f"{run} has several members: sauna eval {run} --deterministic comes first")
    members: dict[str, Any] = json.loads(path.read_text())["members"]
    return max(members, key=lambda name: members[name]["mean"])


def add(run: Path) -> None:
    """Puts the policy of a run into the zoo."""
    env = run_directory.read_config(run)["config"]["env"]
    name = env.replace("/", "-")
    new = ZOO / f".{name}.new"
    shutil.rmtree(new, ignore_errors=True)
    sauna.export(run, new, member=best_member(run))
    card = new / "README.md"
    card.write_text(placed(card.read_text(), f"zoo:{name}"))
    size = sum(path.stat().st_size for path in new.iterdir())
    if size > LARGEST:
        shutil.rmtree(new)
        print(f"{name}: left out, {size:,} bytes")
        return
    shutil.rmtree(ZOO / name, ignore_errors=True)
    new.rename(ZOO / name)
    played = run_directory.read_config(ZOO / name, exported=True)["evaluation"]
    print(f"{name}: {played['mean']:.1f} +- {played['std']:.1f}, {size:,} bytes", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--only", nargs="+", metavar="ENV", default=[])
    arguments = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for run in find_runs(arguments.runs):
        env = run_directory.read_config(run)["config"]["env"]
        if run_directory.is_complete(run) and env in (arguments.only or [env]):
            add(run)


if __name__ == "__main__":
    main()
