"""`results/make.py`: result files that several trainings of a study fill, arm by arm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import make
import pytest

from sauna.experiments.study.results import cell_command
from sauna.experiments.study.spec import Spec, load_spec

NAME = "memory"


def cell(spec: Spec, task: str, index: int, value: float, missing: int = 0) -> dict[str, Any]:
    arm = spec.arms[index]
    seeds = arm.seeds[: len(arm.seeds) - missing]
    members = [{"seed": seed, "final_return": value} for seed in seeds]
    command = cell_command(arm, task)
    return {"task": task, "label": arm.label, "command": command, "members": members}


def file_of(cells: list[dict[str, Any]], machine: str) -> dict[str, Any]:
    return {"cells": cells, "versions": {"jax": "1"}, "machine": machine, "git": "a"}


def whole(spec: Spec, task: str, value: float) -> list[dict[str, Any]]:
    return [cell(spec, task, i, value) for i in range(len(spec.arms))]


def test_new_cells_join_the_old_ones_in_the_studys_order() -> None:
    spec = load_spec(NAME)
    first, second = spec.tasks
    old = file_of([*whole(spec, second, 1.0), cell(spec, first, 0, 1.0)], "here")
    new = file_of([cell(spec, first, 0, 2.0)], "there")
    found = make.merged(old, new, spec)
    keys = [(c["task"], c["label"]) for c in found["cells"]]
    assert keys == [
        (first, spec.arms[0].label),
        *((second, arm.label) for arm in spec.arms),
    ]
    assert found["cells"][0]["members"][0]["final_return"] == 2.0
    assert found["machine"] == ["here", "there"]
    assert (found["git"], found["versions"]) == ("a", {"jax": "1"})


def test_cells_of_other_settings_do_not_stay() -> None:
    spec = load_spec(NAME)
    other = {**cell(spec, spec.tasks[1], 0, 1.0), "command": "sauna train X --steps 5"}
    new = file_of([cell(spec, spec.tasks[0], 0, 2.0)], "here")
    assert make.merged(file_of([other], "here"), new, spec)["cells"] == new["cells"]


def test_only_what_a_file_lacks_is_trained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    spec = load_spec(NAME)
    first, second = spec.tasks
    stored: dict[str, Any] = {}
    monkeypatch.setattr(make, "ROOT", tmp_path)
    monkeypatch.setattr(make, "load", lambda name: stored)
    assert make.remaining(NAME) == NAME

    baseline, *others = range(len(spec.arms))
    some = [cell(spec, second, i, 1.0) for i in (baseline, *others[1:])]
    stored.update(file_of([*whole(spec, first, 1.0), *some], "here"))
    path = make.remaining(NAME)
    assert isinstance(path, Path)
    part = load_spec(str(path))
    assert part.name == NAME
    assert [(arm.label, arm.tasks, arm.settings) for arm in part.arms] == [
        (spec.arms[i].label, (second,), spec.arms[i].settings) for i in (baseline, others[0])
    ]

    stored.update(file_of([*whole(spec, first, 1.0), *whole(spec, second, 1.0)], "here"))
    assert make.remaining(NAME) is None
    (tmp_path / "runs" / NAME).mkdir()
    assert make.remaining(NAME) == NAME  # its runs are here
