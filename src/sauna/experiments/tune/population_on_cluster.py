"""A population on a cluster: between two exchanges its members are units, trained at the same time.

    population/units/member-3/run   the run of one member

An exchange happens on this machine, when all members have reached its iteration. It changes the
newest checkpoints of the members that copy, and never one that is copied. So one that a kill has
cut is made again, the same. The members' numbers are those of a population on one machine.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sauna.config.stored import read_stored
from sauna.experiments.study.execute import ray_cluster, ray_files
from sauna.experiments.study.execute.display import StudyView
from sauna.experiments.study.execute.executor import never
from sauna.experiments.study.found_runs import check_same_code
from sauna.experiments.study.spec import Arm, Spec
from sauna.experiments.study.units import Unit
from sauna.experiments.tune.batch import Tuning
from sauna.experiments.tune.fresh import LEFT
from sauna.experiments.tune.population import (
    UNITS,
    Population,
    aligned,
    arm_of,
    copied,
    exchanges_in,
    settings_in,
    with_settings,
)
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, Interrupted, SaunaError
from sauna.system.safe_write import own_folder
from sauna.system.signals import noted
from sauna.training.prepare import Prepared


class ClusterPopulation(Population):
    """A population of a plan whose members train on a Ray cluster; see `ClusterSearch`."""

    def __init__(self, tuning: Tuning, jobs: int, address: str, say: Callable[[str], None]) -> None:
        super().__init__(tuning)
        self._jobs, self._address, self._say = jobs, address, say
        self._units_folder, self._arm = self._folder / UNITS, self._start.config.arm[0]

    def run(self) -> None:
        """As `Population.run`, and it raises BadInput if the cluster cannot be used."""
        with ray_cluster.connected(self._address, self._jobs) as self._jobs:
            super().run()

    def _check_begun(self) -> None:
        if self._run.is_dir():
            raise BadInput("on: this population was begun on this machine; leave out --on ray")

    def _begin(self, first: Prepared) -> int:
        own_folder(self._units_folder)
        every, plan = first.config.checkpoint_every, self._plan
        common = {name: value for name, value in plan.settings.items() if name not in LEFT}
        common |= {"checkpoint_every": every}
        arms = [
            Arm(arm_of(number), self._arm, {**common, **own}, (plan.env,), plan.seeds, None)
            for number, own in enumerate(self._first())
        ]
        self._spec = Spec("population", arms[0].label, arms, {})
        self._units = [
            Unit(a.label, plan.env, a.label, a.seeds, a.overrides(plan.env, a.seeds)) for a in arms
        ]
        check_same_code(self._units, self._units_folder, self._accept, self._say)
        return self._reached()

    def _reached(self) -> int:
        """The iteration that all members have reached.

        Raises:
          SaunaError: a member has lost what it copied, and the others have gone on since.
        """
        reached = []
        for path in self._runs():
            (path.parent / "failed.json").unlink(missing_ok=True)  # it is tried again
            if not ray_files.checkpoints(path.parent):
                shutil.rmtree(path, ignore_errors=True)  # its config may be of a later exchange
            reached.append(aligned(path, self._say, {}))
        for one in exchanges_in(self._folder.parent):
            if reached[one["member"]] < one["iteration"] < max(reached):
                raise SaunaError(
                    f"{arm_of(one['member'])} has lost its checkpoint of the exchange at iteration "
                    f"{one['iteration']}; remove {self._folder} to train the population anew"
                )
        return min(reached)

    def _runs(self) -> list[Path]:
        return [self._units_folder / arm_of(n) / "run" for n in range(self._plan.trials)]

    def _train(self, first: Prepared, until: int | None) -> None:
        """Trains every member to iteration `until`, or to its end.

        Raises:
          Interrupted: a signal came; what ran is saved.
          SaunaError: a member failed again and again, or the cluster was lost.
        """
        pause = {} if until is None else {"until": until}
        units = [u._replace(settings={**u.settings, **pause}) for u in self._units]

        def is_there(unit: Unit) -> bool:
            kept = ray_files.checkpoints(self._units_folder / unit.name)
            return bool(kept) and int(kept[-1]) >= (until or 0)

        view = StudyView(self._spec, units, self._units_folder)
        view.open()
        try:
            with noted() as came:
                how = (self._units_folder, self._jobs, view, lambda: bool(came))
                enough = never if until is None else is_there
                ray_cluster.RayExecutor(*how, enough).run(units)
        finally:
            view.close()
        if came:
            raise Interrupted(came[0], "stopped")
        for unit in units:
            if error := unit.error(self._units_folder):
                raise SaunaError(f"{unit.label}: {error}")

    def _exchange(self, iteration: int) -> None:
        """Changes the checkpoints of those that copy, unless a member has gone on since."""
        runs = self._runs()
        newest = [checkpoint.load_newest(path / "checkpoints", self._say) for path in runs]
        found = [one for one in newest if one is not None]
        assert len(found) == len(runs)
        if any(one.manifest["iteration"] > iteration for one in found):
            return
        stored = [read_stored(one.manifest) for one in found]
        scores = [self._score(run_directory.rows(path), iteration) for path in runs]
        settings = [settings_in(run, self._arm, self._space) for run in stored]
        made = self._decided(scores, settings, iteration)
        self._log(made, iteration)
        name = f"{self._arm}/{self._plan.seeds[0]}"
        for one in made:
            learned = copied(found[one.source].arrays, name, name)
            arrays = {**found[one.member].arrays, **learned}
            changed = with_settings(stored[one.member], self._arm, one.settings)
            self._save(found[one.member], arrays, changed, runs[one.member])

    def ended(self) -> list[dict[str, Any]]:
        """As `Population.ended`."""
        found = []
        for number, (path, settings) in enumerate(zip(self._runs(), self._first(), strict=True)):
            if (path / "config.json").is_file():
                run = read_stored(run_directory.read_config(path))
                settings = settings_in(run, self._arm, self._space)
            state = "complete" if run_directory.is_complete(path) else "running"
            one = self._as_json(number, settings, run_directory.rows(path))
            found.append(one | {"state": state})
        return found
