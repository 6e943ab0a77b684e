"""A search on a cluster: the trials of a batch are units, which are trained at the same time.

    batches/0003/units/trial-14/run   the run of one trial

Optuna proposes trials and takes their scores on this machine alone, batch by batch, so the trials
are those of a search that trains here. What a trial scores on its way arrives a moment later than
here: one that is pruned has taken a few more env steps when it stops.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sauna.experiments.study.execute import ray_cluster
from sauna.experiments.study.execute.display import StudyView
from sauna.experiments.study.found_runs import check_same_code, reopen_damaged
from sauna.experiments.study.spec import Arm, Spec
from sauna.experiments.study.units import Unit, parts
from sauna.experiments.tune.batch import Tuning
from sauna.experiments.tune.fresh import LEFT
from sauna.experiments.tune.search import PRUNED, SETTINGS, Search, Watch, arm_of, steps_below
from sauna.system import run_directory
from sauna.system.errors import Interrupted
from sauna.system.safe_write import own_folder
from sauna.system.signals import noted

if TYPE_CHECKING:
    from optuna import Trial

UNITS = "units"


class ClusterSearch(Search):
    """Trials of a plan that are trained on a Ray cluster.

    Args:
      tuning: see `Tuning`.
      jobs: trials at a time; 0: one per core.
      address: of the cluster; empty: a Ray of our own.
      say: is called with each line of the output.
    """

    def __init__(self, tuning: Tuning, jobs: int, address: str, say: Callable[[str], None]) -> None:
        super().__init__(tuning)
        self._jobs, self._address, self._say = jobs, address, say

    def run(self) -> None:
        """As `Search.run`.

        Raises:
          BadInput: the cluster cannot be used.
          Interrupted, SaunaError: as `Search.run`.
        """
        with ray_cluster.connected(self._address, self._jobs) as self._jobs:
            if self._jobs > (lockstep := self._plan.lockstep):
                self._say(f"note: {self._jobs} trials fit at a time; --lockstep is {lockstep}")
            super().run()

    def _train(self, place: Path, numbers: list[int]) -> None:
        """Trains the open trials of a batch, a unit each, and tells how they ended."""
        folder = own_folder(place / UNITS)
        trials = {number: self._again(number) for number in numbers}
        settings = {n: trial.user_attrs[SETTINGS] for n, trial in trials.items()}
        prepared = self._prepared(settings, folder)
        spec = self._spec(settings, prepared.config.checkpoint_every)
        units = [_unit(arm, self._plan.env) for arm in spec.arms]
        check_same_code(units, folder, self._accept, self._say)
        reopen_damaged(units, folder, self._say)
        watch = Watch(trials, self._plan, prepared)
        pruned = {arm_of(n) for n, trial in trials.items() if PRUNED in trial.user_attrs}
        self._run(units, folder, TrialsView(spec, units, folder, watch, pruned))
        for trial, unit in zip(trials.values(), units, strict=True):
            self._tell_unit(trial, unit, folder, watch.metric)

    def _spec(self, settings: Mapping[int, Mapping[str, Any]], checkpoint_every: int) -> Spec:
        """Makes a study of the trials, whose arms are named after them."""
        plan, arm = self._plan, self._start.config.arm[0]
        common = {name: value for name, value in plan.settings.items() if name not in LEFT}
        common |= {"checkpoint_every": checkpoint_every}
        arms = [
            Arm(arm_of(number), arm, {**common, **own}, (plan.env,), plan.seeds, None)
            for number, own in settings.items()
        ]
        return Spec("trials", arms[0].label, arms, {})

    def _run(self, units: list[Unit], folder: Path, view: TrialsView) -> None:
        """Trains units to their ends, or until they are pruned.

        Raises:
          Interrupted: a signal came; what ran is saved.
          SaunaError: the cluster was lost.
        """
        view.open()
        try:
            with noted() as came:
                how = (folder, self._jobs, view, lambda: bool(came), view.is_pruned)
                ray_cluster.RayExecutor(*how).run(units)
        finally:
            view.close()
        if came:
            raise Interrupted(came[0], "stopped")

    def _tell_unit(self, trial: Trial, unit: Unit, folder: Path, metric: str) -> None:
        runs = parts(unit, folder)
        errors = [error for part in runs if (error := part.error(folder)) is not None]
        if errors:
            self._fail(trial, errors[0], folder / unit.name)
            return
        scores = [
            member[metric]
            for part in runs
            if part.is_complete(folder)
            for member in _members(part.run(folder))
            if metric in member
        ]
        self._end(trial, scores, steps_below(folder / unit.name))


class TrialsView(StudyView):
    """Shows the trials of a batch, and reports what they score on their way.

    Args:
      spec, units, folder: see `StudyView`.
      watch: sees the rows of the trials.
      pruned: labels of the trials that are pruned already; those that `watch` stops are added.
    """

    def __init__(
        self, spec: Spec, units: list[Unit], folder: Path, watch: Watch, pruned: set[str]
    ) -> None:
        super().__init__(spec, units, folder)
        self._folder, self._watch, self._pruned = folder, watch, pruned

    def is_pruned(self, unit: Unit) -> bool:
        """Whether the unit's trial is pruned: it is not to be trained any further."""
        return unit.label in self._pruned

    def started(self, unit: Unit) -> None:
        super().started(unit)
        self._report(unit, run_directory.rows(unit.run(self._folder)))  # nobody may have seen them

    def progress(self, unit: Unit, message: dict[str, Any]) -> None:
        super().progress(unit, message)
        self._report(unit, message.get("rows", []))

    def _report(self, unit: Unit, rows: Iterable[Mapping[str, Any]]) -> None:
        if "/" in unit.name:  # its seeds are trained one by one, after a failure
            return
        for row in rows:
            if self._watch({**row, "arm": unit.label}) and not self.is_pruned(unit):
                self._pruned.add(unit.label)
                self.say(f"{unit.label} is pruned at {row['env_steps']:,} env steps")


def _unit(arm: Arm, task: str) -> Unit:
    return Unit(arm.label, task, arm.label, arm.seeds, arm.overrides(task, arm.seeds))


def _members(run: Path) -> Iterable[Mapping[str, Any]]:
    summary = run_directory.read_config_file(run / "summary.json")
    return list(summary["members"].values())
