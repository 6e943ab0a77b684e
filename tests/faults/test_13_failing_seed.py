"""Row 13: one seed of a study always fails; the others go on, and the table says so."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from faults.nursery import environment
from faults.result import Result, Tally, assert_held
from helpers import SMALL
from sauna.experiments.study.command import write
from sauna.experiments.study.execute.executor import Executor
from sauna.experiments.study.spec import read_spec
from sauna.experiments.study.units import Unit, units_of
from sauna.system import run_directory

SEEDS = 20
BAD = 1  # the seed that fails
# On the host and on the device; and what has to be said of the seed.
TASKS = {"small_envs:Unlucky": "out of luck", "jax_envs:unlucky": "reward is not finite"}
QUICK = {key: value for key, value in SMALL.items() if key != "seeds"}
PATIENCE = 900.0


def experiment(kills: int, seed: int, place: Path) -> Result:
    """A study of two tasks and 20 seeds, killed at random and started again until it is done.

    `tried` counts the kills and the seeds. `worst`: seconds of the last, uninterrupted part.
    """
    rng, tally = random.Random(seed), Tally()
    study = place / "unlucky.toml"
    study.write_text(
        f"tasks = {json.dumps(list(TASKS))}\nseeds = {SEEDS}\n"
        + "".join(f"{key} = {json.dumps(value)}\n" for key, value in QUICK.items())
        + '[[arms]]\nlabel = "ppo"\n'
    )
    command = [
        sys.executable,
        "-m",
        "sauna",
        "study",
        str(study),
        "--out",
        str(place / "out"),
        "--processes=2",
        "--trust",
    ]
    for _ in range(kills):
        _kill(command, place, rng, tally)
    clock = time.monotonic()
    done = subprocess.run(
        command, env=environment(), capture_output=True, text=True, timeout=PATIENCE
    )
    tally.took(time.monotonic() - clock)
    if done.returncode != 0:
        tally.lose(f"the study ended with {done.returncode}: {done.stderr[-500:]}")
    _judge(place / "out" / "unlucky", TASKS, tally)
    return tally.result()


def _kill(command: list[str], place: Path, rng: random.Random, tally: Tally) -> None:
    """Kills the study; its units notice, save and end by themselves."""
    with (place / "log").open("w") as log:
        process = subprocess.Popen(command, env=environment(), stdout=log, stderr=log)
    time.sleep(rng.uniform(2.0, 25.0))
    process.send_signal(signal.SIGKILL)
    if process.wait() == -signal.SIGKILL:
        tally.tried += 1
        tally.count("kills")


def _judge(place: Path, reasons: dict[str, str], tally: Tally) -> None:
    """Of each task 19 complete, one failed with its reason; no mean has more than the 19."""
    cells = json.loads((place / "results.json").read_text())["cells"]
    rows = json.loads((place / "summary.json").read_text())["table"]
    if [cell["task"] for cell in cells] != list(reasons) or len(rows) != len(reasons):
        tally.lose(f"other cells than {list(reasons)}")
    for cell, row in zip(cells, rows, strict=False):
        _judge_cell(cell, row, reasons[cell["task"]], tally)
    page = (place / "report.html").read_text()
    for reason in reasons.values():
        if reason not in page:
            tally.miss("the report does not say why the seed failed")


def _judge_cell(cell: dict[str, Any], row: dict[str, Any], reason: str, tally: Tally) -> None:
    for member in cell["members"]:
        tally.tried += 1
        status = "failed" if member["seed"] == BAD else "complete"
        tally.count(f"seeds {member['status']}")
        if member["status"] != status:
            tally.lose(f"seed {member['seed']} is {member['status']}: {member['error']}")
    failed = cell["members"][BAD]
    if reason not in str(failed["error"]):
        tally.miss(f"the failed seed's reason is {failed['error']!r}")
    good = [m["final_return"] for m in cell["members"] if m["status"] == "complete"]
    if (row["seeds"], row["failed"]) != (SEEDS - 1, 1):
        tally.miss(f"the table says {row['seeds']} seeds and {row['failed']} failed")
    if abs(row["final_mean"] - sum(good) / len(good)) > 1e-9 * abs(row["final_mean"]):
        tally.miss("the mean is not that of the seeds that ended well")


def _row(seed: int, iteration: int) -> dict[str, Any]:
    steps = 32 * (iteration + 1)
    return {
        "member": f"ppo/{seed}",
        "arm": "ppo",
        "seed": seed,
        "iteration": iteration,
        "env_steps": steps,
        "kept_steps": steps,
        "episodes": iteration,
        "return_mean": float(seed + iteration),
    }


class _Pretended(Executor):
    """Units that train at once: rows of the right form, or the failure of the bad seed.

    After `budget` units the study is killed.
    """

    budget = 10**9

    def _open(self) -> None:
        pass

    def _start(self, unit: Unit) -> None:
        run = unit.run(self._folder)
        run.mkdir(parents=True, exist_ok=True)
        if BAD in unit.seeds:
            return
        rows = [_row(seed, iteration) for seed in unit.seeds for iteration in range(4)]
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        run_directory.write_json(run / "summary.json", {"complete": True})

    def _pump(self) -> None:
        for name in list(self._running):
            type(self).budget -= 1
            if type(self).budget < 0:
                raise KeyboardInterrupt
            self._end(name, "RuntimeError: out of luck")

    def _stop_all(self) -> None:
        pass

    def _stop_one(self, name: str) -> None:
        pass

    def _close(self) -> None:
        pass


class _Silent:
    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: None


def test_the_other_seeds_go_on_and_no_mean_hides_the_failed_one(tmp_path: Path) -> None:
    """The product's own scheduling, splitting, gathering and table; only training is pretended."""
    arms = [{"label": "ppo"}]
    spec = read_spec(
        {"name": "unlucky", "tasks": ["small_envs:Unlucky"], "seeds": SEEDS, "arms": arms, **QUICK}
    )
    units, folder = units_of(spec, 3), tmp_path / "units"
    tally, place = Tally(), tmp_path / "unlucky"
    place.mkdir()
    for budget in (2, 3, 1, 4, 100):  # killed again and again
        _Pretended.budget = budget
        try:
            _Pretended(folder, 2, _Silent(), lambda: False).run(units)
        except KeyboardInterrupt:
            tally.count("kills")
    write(spec, units, folder, place, "sauna study unlucky")
    _judge(place, {"small_envs:Unlucky": "out of luck"}, tally)
    assert tally.notes["kills"] == 4
    assert_held(tally.result(), SEEDS)
