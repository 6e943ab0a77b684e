"""Trackers get every row once, a failing one ends alone, and a resumed run finds them again."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, ClassVar

import pytest

import sauna
from sauna.config.presets import resolve_run
from sauna.config.stored import stored_config
from sauna.config.trust import named_code
from sauna.system.errors import BadInput
from sauna.training.tracking.tracker import scalars
from sauna.training.tracking.trackers import Trackers, check_trackers, last_steps


class Listed(sauna.Tracker):
    """Keeps what it is given, in the order of the calls."""

    made: ClassVar[list[Listed]] = []

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        Listed.made.append(self)

    def open(self, run: sauna.TrackedRun) -> dict[str, Any]:
        self.run = run
        return {"number": run.before.get("number", 7), "urls": {"ppo/0": "https://here/7"}}

    def row(self, row: Any) -> None:
        self.calls.append(("row", row["member"], row["env_steps"], row.get("steps_per_second")))

    def picture(self, name: str, path: Path) -> None:
        self.calls.append(("picture", name, path))

    def summary(self, members: Any, complete: bool) -> None:
        self.calls.append(("summary", members, complete))

    def close(self) -> None:
        self.calls.append(("close",))


class Failing(Listed):
    def row(self, row: Any) -> None:
        super().row(row)
        raise OSError("no network")


class Closed(Listed):
    def close(self) -> None:
        raise OSError("gone")


class Exits(Listed):
    def row(self, row: Any) -> None:
        raise SystemExit("please log in")


class Nothing(Listed):
    def open(self, run: sauna.TrackedRun) -> Any:
        return None


class BadUrls(Listed):
    def open(self, run: sauna.TrackedRun) -> dict[str, Any]:
        return {"urls": ["https://here/7"]}


class Unwritable(Listed):
    def open(self, run: sauna.TrackedRun) -> dict[str, Any]:
        return {"key": self}


class NotOpen(Listed):
    def open(self, run: sauna.TrackedRun) -> dict[str, Any]:
        raise OSError("no key")


def row(member: str, steps: int) -> dict[str, Any]:
    arm, seed = member.split("/")
    return {"member": member, "arm": arm, "seed": int(seed), "env_steps": steps, "iteration": 0}


ROWS = [row("ppo/0", 10), row("ppo/1", 10)]
CLOCK = {"steps_per_second": 5.0, "wall_seconds": 2.0}
LATER = [row("ppo/0", 20), row("ppo/1", 20)]


def opened(path: Path, names: str, done: dict[str, int] | None = None) -> tuple[Trackers, list]:
    Listed.made.clear()
    track = ",".join(f"{__name__}:{name}" for name in names.split(","))
    run = resolve_run({"env": "x", "seeds": 2, "track": track, "track_project": "mine"})
    said: list[str] = []
    trackers = Trackers(path, run.config, run.members, said.append, done or {})
    trackers.open()
    return trackers, said


def test_a_tracker_gets_rows_picture_and_summary_and_knows_the_run(tmp_path: Path) -> None:
    trackers, said = opened(tmp_path, "Listed")
    trackers.rows(ROWS, CLOCK)
    trackers.summary({"ppo/0": {"return_mean": 1.0}}, True)
    trackers.picture("learning_curve", tmp_path / "x.png")
    trackers.close()
    (one,) = Listed.made
    assert one.calls == [
        ("row", "ppo/0", 10, 5.0),
        ("row", "ppo/1", 10, 5.0),
        ("summary", {"ppo/0": {"return_mean": 1.0}}, True),
        ("picture", "learning_curve", tmp_path / "x.png"),
        ("close",),
    ]
    assert one.run.note == f"run directory: {tmp_path}" and one.run.project == "mine"
    assert one.run.members["ppo/1"]["seed"] == 1 and one.run.members["ppo/1"]["arm"] == "ppo"
    assert said == [f"{__name__}:Listed: https://here/7"]
    assert trackers.urls == {f"{__name__}:Listed": {"ppo/0": "https://here/7"}}
    kept = json.loads((tmp_path / "tracking.json").read_text())
    assert kept[f"{__name__}:Listed"]["number"] == 7


def test_a_resumed_run_is_the_same_one_and_rows_that_come_again_are_left_out(tmp_path) -> None:
    opened(tmp_path, "Listed")[0].close()
    trackers, _ = opened(tmp_path, "Listed", last_steps(ROWS))
    trackers.rows(ROWS, CLOCK)
    trackers.rows(LATER, CLOCK)
    (one,) = Listed.made
    assert one.run.before["number"] == 7
    assert [call[2] for call in one.calls] == [20, 20]


def test_a_damaged_record_of_the_trackers_is_named(tmp_path: Path) -> None:
    (tmp_path / "tracking.json").write_text("{")
    trackers, said = opened(tmp_path, "Listed")
    trackers.rows(ROWS, CLOCK)
    assert said[0].startswith("warning: cannot read ") and "begin anew" in said[0]
    assert len(Listed.made[0].calls) == 2


def test_a_tracker_that_is_new_to_a_run_gets_the_rows_of_before(tmp_path: Path) -> None:
    lines = "".join(json.dumps(one) + "\n" for one in ROWS)
    (tmp_path / "metrics.jsonl").write_text(lines)
    trackers, _ = opened(tmp_path, "Listed", last_steps([*ROWS, *LATER]))
    trackers.rows(LATER, CLOCK)
    (one,) = Listed.made
    assert [call[1:3] for call in one.calls] == [
        (r["member"], r["env_steps"]) for r in ROWS + LATER
    ]


@pytest.mark.parametrize("failing, why", [("Failing", "no network"), ("NotOpen", "no key")])
def test_a_failing_tracker_ends_alone_with_one_line(tmp_path: Path, failing: str, why: str) -> None:
    trackers, said = opened(tmp_path, f"{failing},Listed")
    trackers.rows(ROWS, CLOCK)
    trackers.rows(LATER, CLOCK)
    trackers.close()
    warnings = [text for text in said if text.startswith("warning")]
    assert warnings == [
        f"warning: {__name__}:{failing} ended, the training goes on: OSError: {why}"
    ]
    bad, good = Listed.made
    assert len([call for call in bad.calls if call[0] == "row"]) <= 1 and bad.calls[-1:] == [
        ("close",)
    ]
    assert [call[2] for call in good.calls if call[0] == "row"] == [10, 10, 20, 20]
    assert good.calls[-1] == ("close",)


class FailsOnce(Listed):
    away: ClassVar[bool] = True

    def row(self, row: Any) -> None:
        if row["env_steps"] == 20 and self.away:
            raise OSError("no network")
        super().row(row)


def test_a_tracker_that_failed_gets_what_it_missed(tmp_path: Path, monkeypatch) -> None:
    written: list[dict[str, Any]] = []
    monkeypatch.setattr("sauna.system.run_directory.rows", lambda *_: written)
    monkeypatch.setattr(FailsOnce, "away", True)

    def given(rows: list[list[dict[str, Any]]]) -> list[tuple[str, int]]:
        trackers, _ = opened(tmp_path, "FailsOnce", last_steps(written))
        for two in rows:
            trackers.rows(two, CLOCK)
            written.extend(two)
        trackers.close()
        (one,) = Listed.made
        return [call[1:3] for call in one.calls if call[0] == "row"]

    assert given([ROWS, LATER]) == [("ppo/0", 10), ("ppo/1", 10)]
    assert given([]) == []  # it is still away
    monkeypatch.setattr(FailsOnce, "away", False)
    assert given([]) == [("ppo/0", 20), ("ppo/1", 20)]
    assert given([]) == []  # now it is a tracker like any other


def test_a_tracker_that_fails_at_the_end_is_named(tmp_path: Path) -> None:
    trackers, said = opened(tmp_path, "Closed,Listed")
    trackers.close()
    assert "OSError: gone" in said[-1] and Listed.made[1].calls == [("close",)]


@pytest.mark.parametrize(
    "track, message",
    [
        ("none,tensorboard", "track: none stands alone"),
        ("wndb", "unknown tracker 'wndb' .*did you mean 'wandb'"),
        ("no_such_module:T", "track: cannot import 'no_such_module'"),
        (f"{__name__}:row", "is no subclass of sauna.Tracker"),
    ],
)
def test_a_tracker_that_does_not_exist_is_refused(track: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        check_trackers(resolve_run({"env": "x", "track": track}).config)


def test_a_missing_library_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"wandb needs `pip install 'sauna-rl\[wandb\]'`"):
        check_trackers(resolve_run({"env": "x", "track": "wandb"}).config)


def test_a_project_needs_a_tracker_and_none_is_none() -> None:
    with pytest.raises(BadInput, match="track_project: not read"):
        resolve_run({"env": "x", "track_project": "p"})
    check_trackers(resolve_run({"env": "x", "track": "none"}).config)


def test_a_stored_run_that_wrote_for_tensorboard_goes_on_with_it() -> None:
    assert stored_config({"env": "x", "tensorboard": True}).track == ("tensorboard",)
    assert stored_config({"env": "x", "tensorboard": False}).track == ("none",)


def test_a_tracker_s_code_counts_as_code_that_a_run_names() -> None:
    assert named_code({"config": {"track": ["mine:T", "wandb"]}}) == [["track", "mine:T"]]


def test_charts_get_numbers_over_env_steps() -> None:
    whole = {**row("ppo/0", 10), "kl": 0.5, "kept_steps": 9, "episode_returns": [1.0, 3.0]}
    assert scalars(whole) == {"kl": 0.5, "kept_steps": 9, "episode_return": 2.0}


@pytest.mark.parametrize("name", ["Exits", "Nothing", "BadUrls", "Unwritable"])
def test_a_tracker_that_keeps_to_no_rule_ends_alone(name: str, tmp_path: Path) -> None:
    """It calls sys.exit, or returns what no `tracking.json` could hold."""
    trackers, said = opened(tmp_path, f"{name},Listed")
    trackers.rows(ROWS, CLOCK)
    trackers.close()
    assert f"{name} ended, the training goes on" in " ".join(said)
    assert [call[0] for call in Listed.made[-1].calls] == ["row", "row", "close"]
    assert f"{__name__}:Listed" in json.loads((tmp_path / "tracking.json").read_text())


@pytest.mark.parametrize("plant", ["link", "fifo", "dangling", "no tracker's"])
def test_what_is_planted_for_its_record_is_neither_followed_nor_waited_for(plant, tmp_path) -> None:
    run, victim = tmp_path / "run", tmp_path / "victim"
    run.mkdir()
    file = run / "tracking.json"
    if plant == "fifo":
        os.mkfifo(file)
    elif plant == "no tracker's":
        file.write_text(json.dumps({f"{__name__}:Listed": [7]}))
    else:
        file.symlink_to(victim)
    if plant == "link":
        victim.write_text("{}")
    said = opened(run, "Listed")[1]
    named = [line for line in said if line.startswith("warning: ") and "tracking.json" in line]
    assert len(named) == (plant != "no tracker's")
    assert Listed.made[0].run.before == {}
    assert file.is_file() and not file.is_symlink()
    assert (victim.read_text() if victim.exists() else None) == ("{}" if plant == "link" else None)
