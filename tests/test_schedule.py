"""How often a unit is tried, and what is shown of it, without training anything."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from sauna import rundir
from sauna.study.schedule import Executor
from sauna.study.spec import read_spec
from sauna.study.units import Unit, units_of
from sauna.study.view import DONE, FAILED, WAITING, StudyView

TWO = {"tasks": ["A-v0"], "seeds": 3, "steps": 10_000, "rollout_steps": 1000, "minibatches": 10,
       "arms": [{"label": "ppo"}, {"label": "sauna"}]}  # fmt: skip


class Broken(Executor):
    """Every unit ends at once: complete, unless it trains seed 1 or its name is in `crashes`."""

    def __init__(self, folder: Path, view: StudyView, crashes: tuple[str, ...] = ()) -> None:
        super().__init__(folder, 2, view, lambda: False)
        self.starts: Counter[str] = Counter()
        self._left = list(crashes)

    def _start(self, unit: Unit) -> None:
        self.starts[unit.name] += 1

    def _pump(self) -> None:
        for name, unit in list(self._running.items()):
            if name in self._left:
                self._left.remove(name)
            elif 1 not in unit.seeds:
                unit.run(self._folder).mkdir(parents=True)
                rundir.write_json(unit.run(self._folder) / "summary.json", {"complete": True})
            self._end(name, "broken")

    def _tell_to_stop(self) -> None:
        pass

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


def test_a_mark_for_each_seed(tmp_path: Path, capsys) -> None:
    spec = read_spec(TWO)
    units = units_of(spec, 3)
    view = StudyView(spec, units, tmp_path)
    row = {"env_steps": 5000, "kept_steps": 5000, "return_mean": 7.0, "keep_rate": 1.0}
    view.progress(units[0], {"rows": [{**row, "seed": 0}]})
    view.ended(units[0]._replace(seeds=(1,)), "out of luck")
    view.refresh()
    told = capsys.readouterr().out
    assert f"ppo on A-v0 \u2585{FAILED}{WAITING} return 7.0, keep rate 1.000" in told
    assert "FAILED: A-v0, ppo, seed 1: out of luck" in told and "25.0% of 6 members" in told
    view.progress(units[0], {"rows": [{**row, "env_steps": 10_000, "seed": 0}]})
    assert "33.3%" in view._status() and not view._cells["ppo", "A-v0"].is_running()
    view.ended(units[0]._replace(seeds=(0,)), None)
    assert view._cells["ppo", "A-v0"].marks() == DONE + FAILED + WAITING


def test_a_quiet_view_says_nothing(tmp_path: Path, capsys) -> None:
    spec = read_spec(TWO)
    view = StudyView(spec, units_of(spec, 3), tmp_path, quiet=True)
    view.open()
    view.say("something")
    view.refresh()
    view.close()
    assert capsys.readouterr().out == ""
