"""How often a unit is tried, and what is shown of it, without training anything."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

from sauna.experiments.study.execute.display import DONE, FAILED, WAITING, Cell, StudyView
from sauna.experiments.study.execute.executor import Executor, never
from sauna.experiments.study.spec import check, read_spec
from sauna.experiments.study.units import Unit, units_of
from sauna.system import run_directory

TWO = {
    "tasks": ["A-v0"],
    "seeds": 3,
    "steps": 10_000,
    "rollout_steps": 1000,
    "minibatches": 10,
    "arms": [{"label": "ppo"}, {"label": "sauna"}],
}


class Broken(Executor):
    """Every unit ends at once: complete, unless it trains seed 1 or its name is in `crashes`."""

    unlucky: int | None = 1

    def __init__(
        self,
        folder: Path,
        view: StudyView,
        crashes: tuple[str, ...] = (),
        enough: Callable[[Unit], bool] = never,
    ) -> None:
        super().__init__(folder, 2, view, lambda: False, enough)
        self.starts: Counter[str] = Counter()
        self.stopped: list[str] = []
        self._left = list(crashes)

    def _open(self) -> None:
        pass

    def _start(self, unit: Unit) -> None:
        self.starts[unit.name] += 1

    def _pump(self) -> None:
        for name, unit in list(self._running.items()):
            if name in self._left:
                self._left.remove(name)
            elif self.unlucky not in unit.seeds:
                unit.run(self._folder).mkdir(parents=True)
                run_directory.write_json(
                    unit.run(self._folder) / "summary.json", {"complete": True}
                )
            self._end(name, "broken")

    def _stop_all(self) -> None:
        pass

    def _stop_one(self, name: str) -> None:
        self.stopped.append(name)

    def _close(self) -> None:
        pass


def run(tmp_path: Path, text: dict, crashes: tuple[int, ...] = ()) -> tuple[Broken, list[Unit]]:
    spec = read_spec(text)
    units = units_of(spec, 3)
    view = StudyView(spec, units, tmp_path)
    executor = Broken(tmp_path, view, tuple(units[i].name for i in crashes))
    executor.run(units)
    return executor, units


def test_a_unit_is_continued_once_and_then_each_of_its_seeds_trained_once(tmp_path: Path) -> None:
    executor, (ppo, _) = run(tmp_path, TWO)
    seeds = [executor.starts[f"{ppo.name}/seed-{seed}"] for seed in range(3)]
    assert (executor.starts[ppo.name], seeds) == (2, [1, 1, 1])
    failed = sorted(path.parent.name for path in tmp_path.rglob("failed.json"))
    assert failed == ["seed-1", "seed-1"]


def test_one_that_crashed_once_is_continued_and_not_split(tmp_path: Path) -> None:
    executor, (ppo, _) = run(tmp_path, {**TWO, "seeds": [0, 2]}, crashes=(0,))
    assert executor.starts[ppo.name] == 2 and not list(tmp_path.rglob("split.json"))


def test_a_failed_seed_tries_again_once_its_folder_is_removed(tmp_path: Path, monkeypatch) -> None:
    """As the documentation says; the other arm's stays failed."""
    _, units = run(tmp_path, TWO)
    places = [tmp_path / unit.name / "seed-1" for unit in units]
    assert all((place / "failed.json").exists() for place in places)
    executor, _ = run(tmp_path, TWO)
    assert not executor.starts  # nothing was removed
    shutil.rmtree(places[0])
    monkeypatch.setattr(Broken, "unlucky", None)
    run(tmp_path, TWO)
    assert run_directory.is_complete(places[0] / "run")
    assert list(tmp_path.rglob("failed.json")) == [places[1] / "failed.json"]


class Endless(Broken):
    """A unit runs until it is told to stop, and is not complete then."""

    def _pump(self) -> None:
        for name in self.stopped:
            self._end(name, "stopped")
        self.stopped.clear()


def test_a_unit_that_has_trained_enough_is_stopped_and_is_no_failure(tmp_path: Path) -> None:
    spec = read_spec(TWO)
    ppo, sauna = units = units_of(spec, 3)
    at_first = {sauna.name}
    view = StudyView(spec, units, tmp_path)
    executor = Endless(tmp_path, view, (), lambda unit: unit.name in {*at_first, *executor.starts})
    executor.run(units)
    assert executor.starts == {ppo.name: 1}
    assert not list(tmp_path.rglob("failed.json")) and not list(tmp_path.rglob("split.json"))


def test_two_labels_of_the_same_settings_are_one_unit(tmp_path: Path) -> None:
    arms = [{"label": "ppo"}, {"label": "again", "arm": "ppo"}]
    executor, (one, other) = run(tmp_path, {**TWO, "arms": arms})
    assert one.name == other.name and executor.starts[one.name] == 2
    assert [executor.starts[f"{one.name}/seed-{seed}"] for seed in range(3)] == [1, 1, 1]


ROW = {"kept_steps": 0, "return_mean": 7.0, "keep_rate": 1.0}


def test_a_mark_for_each_seed(tmp_path: Path, capsys) -> None:
    spec = read_spec(TWO)
    units = units_of(spec, 3)
    view = StudyView(spec, units, tmp_path)
    view.started(units[0])
    view.progress(units[0], {"rows": [{**ROW, "seed": 0, "env_steps": 5000}]})
    view.ended(units[0]._replace(seeds=(1,)), "out of luck")
    view.refresh()
    printed = capsys.readouterr().out
    assert f"ppo on A-v0 \u2585{FAILED}{WAITING} return 7.0, keep rate 1.000" in printed
    assert "FAILED: A-v0, ppo, seed 1: out of luck" in printed and "25.0% of 6 members" in printed
    view.progress(units[0], {"rows": [{**ROW, "seed": 0, "env_steps": 10_000}]})
    assert "33.3%" in view._status()
    view.stopped(units[0])
    assert view._named() == ""
    view.ended(units[0]._replace(seeds=(0,)), None)
    assert view._cells["ppo", "A-v0"].marks() == DONE + FAILED + WAITING


def test_the_rate_is_that_of_late(monkeypatch) -> None:
    """What came before a pause, and what is trained once more after a failure, is left out."""
    cell, now = Cell(check(read_spec(TWO).arms[0], "A-v0")), [0.0]
    monkeypatch.setattr("sauna.experiments.study.execute.display.time.monotonic", lambda: now[0])
    cell.running.add("unit")

    def trained(at: float, steps: int) -> None:
        now[0] = at
        cell.note({**ROW, "seed": 0, "env_steps": steps}, trained=True)

    trained(0, 1000)
    assert cell.rate() is None
    trained(10, 3000)
    assert cell.rate() == 200
    trained(1000, 4000)
    trained(1010, 5000)
    assert cell.rate() == 100
    trained(1020, 1000)
    trained(1030, 1500)
    assert cell.rate() == 50
    cell.running.clear()
    assert cell.rate() is None


def test_on_a_small_terminal_only_what_trains_is_shown(tmp_path: Path) -> None:
    spec = read_spec({**TWO, "tasks": [f"{letter}-v0" for letter in "ABCDEFGH"]})
    units = units_of(spec, 3)
    view = StudyView(spec, units, tmp_path)
    view._live = SimpleNamespace(console=SimpleNamespace(height=15))
    view.started(units[3])
    shown = view._table()
    assert shown.row_count == 1 and shown.caption == "15 more lines are complete or waiting"
    assert view._table(whole=True).row_count == 16
    view._live = None


def test_a_quiet_view_says_nothing(tmp_path: Path, capsys) -> None:
    spec = read_spec(TWO)
    view = StudyView(spec, units_of(spec, 3), tmp_path, quiet=True)
    view.open()
    view.say("something")
    view.refresh()
    view.close()
    assert capsys.readouterr().out == ""
