"""`sauna runs`: each state, from files as a run writes them; files of strangers do no harm."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from sauna import cli
from sauna.experiments.run_list import TAIL, age, examine, find_runs, last_rows, list_runs
from sauna.system import run_directory
from sauna.system.errors import BadInput

CONFIG: dict[str, Any] = {"env": "Hopper-v5", "arm": ["ppo"], "seeds": [0, 1], "steps": 1000}


def make_run(
    folder: Path, config: dict[str, Any], rows: list[dict[str, Any]], complete: bool | None = None
) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"config": {**CONFIG, **config}}))
    if rows:
        (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    if complete is not None:
        (folder / "summary.json").write_text(json.dumps({"complete": complete}))
    return folder


def row(arm: str, seed: int, steps: int, **more: float) -> dict[str, Any]:
    who = {"member": f"{arm}/{seed}", "arm": arm, "seed": seed}
    return {**who, "iteration": 0, "env_steps": steps, "kept_steps": steps // 2, **more}


def test_each_state_is_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row("ppo", 0, 100, return_mean=5.0), row("ppo", 1, 200, return_mean=7.0)]
    make_run(tmp_path / "done", {}, [*rows, row("ppo", 0, 300, return_mean=1.0)], complete=True)
    make_run(tmp_path / "study" / "units" / "x" / "run", {}, rows, complete=False)
    stopped = make_run(tmp_path / "stopped", {}, rows)
    members = {"ppo/0": {"stopped_early": "return"}, "ppo/1": {}}
    (stopped / "summary.json").write_text(json.dumps({"complete": True, "members": members}))
    failed = make_run(tmp_path / "failed", {"arm": ["ppo", "sauna"]}, [*rows, row("sauna", 0, 50)])
    (failed / "failure.txt").write_text("Traceback")
    resumed = make_run(tmp_path / "resumed", {"budget": "kept"}, rows)
    (resumed / "failure.txt").write_text("Traceback")
    os.utime(resumed / "failure.txt", (1.0, 1.0))  # it has been trained further since
    running = make_run(tmp_path / "running", {"env": "a\x1b[2J" + "b" * 99}, [])
    make_run(running / "deeper", {}, [])  # belongs to the run that it is in
    with run_directory.lock(running):
        cli.main(["runs", str(tmp_path)])
    lines = [re.split(r"  +", line) for line in capsys.readouterr().out.splitlines()]
    found = {line[0]: line[1:-1] for line in lines[1:]}
    assert lines[0] == ["run", "env", "arms", "seeds", "steps", "state", "return", "age"]
    shown = found.pop("running")
    assert shown[0].startswith(r"a\x1b[2Jb") and len(shown[0]) == 60
    assert shown[1:] == ["ppo", "2", "0 of 1,000", "running"]
    assert found == {
        "done": ["Hopper-v5", "ppo", "2", "250 of 1,000", "finished", "4.00"],
        "stopped": ["Hopper-v5", "ppo", "2", "150 of 1,000", "finished (1 stopped early)", "6.00"],
        "study/units/x/run": ["Hopper-v5", "ppo", "2", "150 of 1,000", "interrupted", "6.00"],
        "failed": ["Hopper-v5", "ppo, sauna", "2", "88 of 1,000", "failed", "ppo 6.00"],
        "resumed": ["Hopper-v5", "ppo", "2", "75 of 1,000", "interrupted", "6.00"],
    }
    assert examine(running).state == "interrupted", "the lock is let go, and the process lives on"


def test_the_last_rows_are_read_from_the_end(tmp_path: Path) -> None:
    many = [row("ppo", 1, 7)] + [row("ppo", 0, step) for step in range(2000)]
    run = make_run(tmp_path / "run", {}, many)
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"member": "ppo/1", "arm"')  # being written
    found = last_rows(run / "metrics.jsonl", 2)
    assert {name: last["env_steps"] for name, last in found.items()} == {"ppo/0": 1999, "ppo/1": 7}
    assert set(last_rows(run / "metrics.jsonl", 1)) == {"ppo/0"}, "no more is read than needed"
    assert (run / "metrics.jsonl").stat().st_size < TAIL


@pytest.mark.parametrize(
    "config",
    [
        '{"config": {}}',
        '{"config": {"env": 1, "arm": 3, "seeds": [0], "steps": 1}}',
        '{"config": {"env": "x", "arm": [], "seeds": [], "steps": 1}}',
        '{"config": {"env": "x", "arm": ["ppo"], "seeds": [0], "steps": "many"}}',
        '{"config": [1]}',
        "nothing",
        "[" * 100_000,
    ],
)
def test_a_strange_run_is_named_and_the_others_are_shown(config: str, tmp_path: Path) -> None:
    make_run(tmp_path / "good", {}, [row("ppo", 0, 10)])
    strange = make_run(tmp_path / "strange", {}, [])
    (strange / "config.json").write_text(config)
    listed = list_runs(tmp_path)
    assert len(listed) == 3 and sum("cannot be read" in line for line in listed) == 1
    assert sum("5 of 1,000" in line for line in listed) == 1


def test_links_and_devices_are_not_followed(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", {}, [])
    os.mkfifo(run / "metrics.jsonl")
    (tmp_path / "again").symlink_to(run)
    assert list(find_runs(tmp_path)) == [run]
    assert "not a regular file" in examine(run).state


def test_no_folder_and_no_runs(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="there is no folder"):
        list_runs(tmp_path / "none")
    assert list_runs(tmp_path) == [f"no runs in {tmp_path}"]
    assert [age(s) for s in (-1, 59, 60, 7300, 900_000)] == ["0 s", "59 s", "1 min", "2 h", "10 d"]
