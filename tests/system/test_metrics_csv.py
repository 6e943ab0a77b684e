"""The table of a run: what the logs say, in any order of appending, resuming and new keys."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from sauna.system.metrics_csv import NAME, MetricsCsv, trained_seconds
from sauna.system.safe_read import Untrusted

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
    appended(tmp_path, MetricsCsv(tmp_path), 0, 4)
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
    expected = appended(whole, MetricsCsv(whole), 0, 4)
    appended(resumed, MetricsCsv(resumed), 0, 4)
    (resumed / NAME).write_bytes(expected[:-3])  # killed in the middle of a row
    write_logs(resumed, cut)
    table = MetricsCsv(resumed)
    assert (resumed / NAME).exists() == (cut > 0)
    assert appended(resumed, table, cut, 4) == expected if cut < 4 else True
    assert (resumed / NAME).read_bytes() == expected


def test_a_run_of_before_gets_a_table_without_times(tmp_path: Path) -> None:
    write_logs(tmp_path, 3)
    (tmp_path / "timing.jsonl").unlink()
    MetricsCsv(tmp_path)
    rows = (tmp_path / NAME).read_text().splitlines()
    assert len(rows) == 4 and rows[1] == "ppo/0,ppo,0,0,,32,"


@pytest.mark.parametrize("row", ["[]", "{}", '{"iteration": []}', '{"seconds": "x"}', "nothing"])
def test_strange_times_are_left_out(row: str, tmp_path: Path) -> None:
    write_logs(tmp_path, 3)
    (tmp_path / "timing.jsonl").write_text(f'{{"iteration": 0, "seconds": 2.5}}\n{row}\n')
    MetricsCsv(tmp_path)
    assert len((tmp_path / NAME).read_text().splitlines()) == 4
    assert trained_seconds(tmp_path) == 2.5


def test_the_time_goes_on_from_what_a_run_has(tmp_path: Path) -> None:
    write_logs(tmp_path, 3)
    assert trained_seconds(tmp_path) == 2.5
    (tmp_path / "timing.jsonl").write_text('{"seconds": 1.5}\n' * 4)  # of 0.1.0
    assert trained_seconds(tmp_path) == 6.0


def test_it_is_not_written_through_a_link(tmp_path: Path) -> None:
    run, victim = tmp_path / "run", tmp_path / "victim"
    run.mkdir()
    victim.write_text("mine")
    write_logs(run, 3)
    (run / NAME).symlink_to(victim)
    table = MetricsCsv(run)  # a new file in the link's place
    assert not (run / NAME).is_symlink() and victim.read_text() == "mine"
    (run / NAME).unlink(), (run / NAME).symlink_to(victim)
    with pytest.raises(Untrusted):
        table.append(ROWS[2], 1.0)
    assert victim.read_text() == "mine"
