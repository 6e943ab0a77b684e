"""The table of a run: what the logs say, in any order of appending, resuming and new keys."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sauna.system.metrics_csv import NAME, MetricsCsv, trained_seconds

START = {"member": "ppo/0", "arm": "ppo", "seed": 0}
ROWS: list[list[dict[str, Any]]] = [
    [{**START, "iteration": 0, "env_steps": 32, "episode_returns": []}],
    [{**START, "iteration": 1, "env_steps": 64, "return_mean": 0.1, "episode_returns": [0.1]}],
    [{**START, "iteration": 2, "env_steps": 96, "return_mean": 1e-300}],
    [
        {**START, "iteration": 3, "env_steps": 128, "kl": -0.5, 'info_a,"b': 2.0},
        {**START, "member": "ppo/1", "seed": 1, "iteration": 3, "env_steps": 7},
    ],
]


def write_logs(run: Path, iterations: int) -> None:
    rows = [row for rows in ROWS[:iterations] for row in rows]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    timings = [{"iteration": i, "wall_seconds": i + 0.5} for i in range(iterations)]
    (run / "timing.jsonl").write_text("".join(json.dumps(row) + "\n" for row in timings))


def appended(run: Path, table: MetricsCsv, start: int, end: int) -> bytes:
    for i in range(start, end):
        write_logs(run, i + 1)
        table.append(ROWS[i], i + 0.5)
    return (run / NAME).read_bytes()


def test_it_holds_every_number_of_the_rows_and_the_time(tmp_path: Path) -> None:
    appended(tmp_path, MetricsCsv(tmp_path, refuse), 0, 4)
    with (tmp_path / NAME).open(newline="") as file:
        found = list(csv.DictReader(file))
    wanted = [
        {k: str(v) for k, v in {**row, "wall_seconds": i + 0.5}.items() if k != "episode_returns"}
        for i, rows in enumerate(ROWS)
        for row in rows
    ]
    assert [{k: v for k, v in row.items() if v} for row in found] == wanted
    assert float(found[2]["return_mean"]) == 1e-300
    assert list(found[0])[:5] == ["member", "arm", "seed", "iteration", "wall_seconds"]


@pytest.mark.parametrize("cut", range(5))
def test_a_resumed_run_has_the_bytes_of_one_left_alone(cut: int, tmp_path: Path) -> None:
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    whole.mkdir(), resumed.mkdir()
    expected = appended(whole, MetricsCsv(whole, refuse), 0, 4)
    appended(resumed, MetricsCsv(resumed, refuse), 0, 4)
    (resumed / NAME).write_bytes(expected[:-3])  # killed in the middle of a row
    write_logs(resumed, cut)
    table = MetricsCsv(resumed, refuse)
    assert (resumed / NAME).exists() == (cut > 0)
    assert appended(resumed, table, cut, 4) == expected if cut < 4 else True
    assert (resumed / NAME).read_bytes() == expected


def test_a_run_of_before_gets_a_table_without_times(tmp_path: Path) -> None:
    write_logs(tmp_path, 3)
    (tmp_path / "timing.jsonl").unlink()
    MetricsCsv(tmp_path, refuse)
    rows = (tmp_path / NAME).read_text().splitlines()
    assert len(rows) == 4 and rows[1] == "ppo/0,ppo,0,0,,32,"


@pytest.mark.parametrize("row", ["[]", "{}", '{"iteration": []}', '{"seconds": "x"}', "nothing"])
def test_strange_times_are_left_out(row: str, tmp_path: Path) -> None:
    write_logs(tmp_path, 3)
    (tmp_path / "timing.jsonl").write_text(f'{{"iteration": 0, "seconds": 2.5}}\n{row}\n')
    MetricsCsv(tmp_path, refuse)
    assert len((tmp_path / NAME).read_text().splitlines()) == 4
    assert trained_seconds(tmp_path) == 2.5


def test_the_time_goes_on_from_what_a_run_has(tmp_path: Path) -> None:
    write_logs(tmp_path, 3)
    assert trained_seconds(tmp_path) == 2.5
    (tmp_path / "timing.jsonl").write_text('{"seconds": 1.5}\n' * 4)  # of 0.1.0
    assert trained_seconds(tmp_path) == 6.0


def refuse(text: str) -> None:
    raise AssertionError(text)


@pytest.mark.parametrize("plant", ["link", "hard link", "fifo", "folder"])
def test_what_is_planted_in_its_place_costs_the_table_alone(plant: str, tmp_path: Path) -> None:
    """Before the first row and in between; nothing is written through it, nothing waits for it."""
    run, victim, said = tmp_path / "run", tmp_path / "victim", []
    run.mkdir()
    victim.write_text("mine")
    plants: dict[str, Callable[[], object]] = {
        "link": lambda: (run / NAME).symlink_to(victim),
        "hard link": lambda: os.link(victim, run / NAME),
        "fifo": lambda: os.mkfifo(run / NAME),
        "folder": (run / NAME).mkdir,
    }
    write_logs(run, 2)
    plants[plant]()
    table = MetricsCsv(run, said.append)
    assert len(said) == (plant == "folder")  # a new file takes the place of all others
    if plant != "folder":
        (run / NAME).unlink(), plants[plant]()
        said.clear()
        appended(run, table, 2, 3) if plant != "fifo" else (
            write_logs(run, 3),
            table.append(ROWS[2], 2.5),
        )
        assert len(said) == 1 and "metrics.csv cannot be written" in said[0]
    table.append(ROWS[3], 3.5)  # is not tried
    write_logs(run, 4)
    table.finish()
    assert len(said) == (2 if plant == "folder" else 1) and victim.read_text() == "mine"
    if plant != "folder":
        expected = tmp_path / "expected"
        expected.mkdir()
        wanted = appended(expected, MetricsCsv(expected, refuse), 0, 4)
        assert (run / NAME).read_bytes() == wanted and not (run / NAME).is_symlink()


def test_a_fifo_in_its_place_at_the_end_is_not_waited_for(tmp_path: Path) -> None:
    said: list[str] = []
    table = MetricsCsv(tmp_path, said.append)
    expected = appended(tmp_path, table, 0, 4)
    (tmp_path / NAME).unlink(), os.mkfifo(tmp_path / NAME)
    table.finish()
    assert (tmp_path / NAME).read_bytes() == expected and len(said) == 1
