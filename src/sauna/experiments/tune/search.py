"""The search: batch after batch, ask Optuna, train in lockstep, tell it how the trials ended.

batches/0003/batch.json     the numbers of its trials
batches/0003/run            an ordinary run, whose arms are the trials
batches/0003/trial-14       the same of one trial, of a batch whose run failed

On a cluster trials are trained otherwise: see `on_cluster.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sauna.experiments.tune import storage
from sauna.experiments.tune.batch import Tuning, prepared_batch, train
from sauna.experiments.tune.plan import Plan
from sauna.experiments.tune.space import Space, settings_of, start_of
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.system.safe_write import own_folder
from sauna.training.prepare import Prepared

if TYPE_CHECKING:
    from optuna import Trial
    from optuna.trial import FrozenTrial

BATCHES = "batches"
SETTINGS, ERROR, STEPS, PRUNED = "settings", "error", "env_steps", "pruned_at"  # Optuna's notes


def arm_of(number: int) -> str:
    """Names the arm of a trial."""
    return f"trial-{number}"


class Search:
    """Trials of a plan in a folder."""

    def __init__(self, tuning: Tuning) -> None:
        plan, start, folder, self._display, self._accept = tuning
        self._plan, self._start, self._folder = plan, start, folder
        self._space: Space = plan.space
        self._forget_half_asked()
        self.study, self._storage = storage.open_study(folder, plan)

    def run(self) -> None:
        """Trains every trial of the plan that has not ended.

        Raises:
          Interrupted: a signal came; running again continues.
          SaunaError: the disk failed, or the code of the environment has changed.
        """
        number, first = 0, 0
        while first < self._plan.trials:
            place = own_folder(self._folder / BATCHES / f"{number:04d}")
            note = place / "batch.json"
            if not note.is_file():
                last = min(first + self._plan.lockstep, self._plan.trials)
                journal = {"journal": storage.size_of(self._folder)}
                run_directory.write_json(place / "asking.json", journal)
                run_directory.write_json(note, {"trials": self._ask(range(first, last))})
            trials = run_directory.read_config_file(note)["trials"]
            if is_open := [n for n in trials if self._is_open(n)]:
                self._train(place, is_open)
                self._display().say(self._so_far(first + len(trials)))
            number, first = number + 1, first + len(trials)

    def _so_far(self, ended: int) -> str:
        """Says how many trials have ended, and which is the best."""
        text = f"{ended} of {self._plan.trials} trials have ended"
        done = [t for t in self.study.get_trials(deepcopy=False) if t.state.name == "COMPLETE"]
        if not done:
            return text
        best = max(done, key=lambda trial: trial.value)
        return f"{text}; best so far: trial {best.number}, return {best.value:.4g}"

    def _forget_half_asked(self) -> None:
        """Takes back what was asked for a batch that was not whole: it is asked for again."""
        for path in (self._folder / BATCHES).glob("*/asking.json"):
            if not (path.parent / "batch.json").is_file():
                storage.cut(self._folder, run_directory.read_config_file(path)["journal"])

    def ended(self) -> list[dict[str, Any]]:
        """Lists the trials as JSON values, in the order in which they were asked for."""
        return [_as_json(trial) for trial in self.study.get_trials(deepcopy=False)]

    def importance(self) -> dict[str, float]:
        """Shares of the searched settings in what makes a trial good; see `storage.importance`."""
        return storage.importance(self.study)

    def _is_open(self, number: int) -> bool:
        return not self.study.get_trials(deepcopy=False)[number].state.is_finished()

    def _ask(self, numbers: range) -> list[int]:
        """Asks for trials that share what shapes the program; it is the first good one's."""
        fixed: dict[str, Any] = {}
        for number in numbers:
            starts = number == 0
            given = start_of(self._space, self._start.config) if starts else fixed
            trial = storage.ask(self.study, self._plan, self._space, number, given, starts)
            settings = settings_of(trial.params, self._start.config)
            try:
                self._prepared({number: settings}, self._folder)
            except BadInput as error:
                self._fail(trial, str(error))
                continue
            trial.set_user_attr(SETTINGS, settings)
            fixed = {
                name: trial.params[name] for name, one in self._space.items() if one.shapes_program
            }
        return list(numbers)

    def _again(self, number: int) -> Trial:
        return storage.again(self.study, self._storage, number)

    def _prepared(self, settings: Mapping[int, Mapping[str, Any]], out: Path) -> Prepared:
        plan = self._plan
        whole = {arm_of(number): {**plan.settings, **own} for number, own in settings.items()}
        return prepared_batch(whole, plan.seeds, self._start, out)

    def _train(self, place: Path, numbers: list[int]) -> None:
        """Trains the open trials of a batch; one by one if they failed together."""
        split = place / "split.json"
        if not split.exists():
            error = self._train_together(place / "run", numbers)
            if error is None:
                return
            if len(numbers) == 1:
                self._fail(self._again(numbers[0]), error, place / "run")
                return
            run_directory.write_json(split, {"error": error})
        for number in numbers:
            path = place / arm_of(number)
            error = self._train_together(path, [number])
            if error is not None:
                self._fail(self._again(number), error, path)

    def _train_together(self, path: Path, numbers: list[int]) -> str | None:
        """Trains trials as one run and tells how they ended; returns why they failed, or None."""
        trials = {number: self._again(number) for number in numbers}
        settings = {n: trial.user_attrs[SETTINGS] for n, trial in trials.items()}
        prepared = self._prepared(settings, path)
        watch = Watch(trials, self._plan, prepared)
        for row in run_directory.rows(path):  # of a run that goes on: its scores count
            watch(row)
        if not run_directory.is_complete(path):
            try:
                train(prepared, self._display(), watch, self._accept)
            except BadInput:
                raise
            except SaunaError as error:
                if isinstance(error.__cause__, OSError):  # of our disk, not of a trial
                    raise
                return str(error)
        self._tell(path, trials, watch.metric)
        return None

    def _tell(self, path: Path, trials: Mapping[int, Trial], metric: str) -> None:
        members = run_directory.read_config_file(path / "summary.json")["members"].values()
        for number, trial in trials.items():
            own = [member for member in members if member["arm"] == arm_of(number)]
            steps = sum(m["env_steps"] + m.get("eval_env_steps", 0) for m in own)
            self._end(trial, [member[metric] for member in own if metric in member], steps)

    def _end(self, trial: Trial, scores: list[float], steps: int) -> None:
        """Tells how a trial ended: pruned, or with the scores of its members that have one."""
        from optuna.trial import TrialState

        trial.set_user_attr(STEPS, steps)
        if PRUNED in trial.user_attrs:
            self.study.tell(trial, state=TrialState.PRUNED)
        elif len(scores) < len(self._plan.seeds):
            self._fail(trial, "no episode has ended, so there is no return")
        else:
            self.study.tell(trial, float(np.mean(scores)))

    def _fail(self, trial: Trial, error: str, path: Path | None = None) -> None:
        """Tells that a trial failed; `path` has the runs in which it did, if it was trained."""
        from optuna.trial import TrialState

        trial.set_user_attr(ERROR, error)
        if path is not None:
            trial.set_user_attr(STEPS, steps_below(path))
        self.study.tell(trial, state=TrialState.FAIL)


class Watch:
    """Reports the score of each trial at equal parts of the budget, and stops what is pruned.

    Args:
      trials: by their numbers.
      plan: has their seeds, over which a score is the mean.
      prepared: their run.
    """

    def __init__(self, trials: Mapping[int, Trial], plan: Plan, prepared: Prepared) -> None:
        self._trials = {arm_of(number): trial for number, trial in trials.items()}
        self._seeds, self._steps = plan.seeds, prepared.config.steps
        evaluated = prepared.config.eval_every > 0
        self.metric = "eval_return_mean" if evaluated else "return_mean"
        self._scores: dict[str, dict[int, float]] = {arm: {} for arm in self._trials}
        self._reached: dict[str, dict[int, int]] = {arm: {} for arm in self._trials}

    def __call__(self, row: Mapping[str, Any]) -> bool:
        """Sees a row of the run; returns whether its member is to stop."""
        arm, seed = row["arm"], row["seed"]
        if arm not in self._trials:  # it had ended before the tuning was stopped
            return False
        trial, steps = self._trials[arm], row["env_steps"]
        if PRUNED in trial.user_attrs:
            return bool(steps >= trial.user_attrs[PRUNED])
        self._reached[arm][seed] = steps
        if self.metric in row:
            self._scores[arm][seed] = row[self.metric]
        least = min(self._reached[arm].get(seed, 0) for seed in self._seeds)
        if len(self._scores[arm]) < len(self._seeds) or least < steps:
            return False
        return self._report(trial, steps, float(np.mean([*self._scores[arm].values()])))

    def _report(self, trial: Trial, steps: int, score: float) -> bool:
        stored = trial.study.get_trials(deepcopy=False)[trial.number]
        known = stored.intermediate_values
        due = [n for n in range(1, steps * storage.REPORTS // self._steps + 1) if n not in known]
        for number in due:
            trial.report(score, number)
        if not due or max(due) == storage.REPORTS or not trial.should_prune():
            return False
        trial.set_user_attr(PRUNED, steps)
        return True


def steps_of(run: Path) -> int:
    """Counts the env steps of a run, those of its evaluations included."""
    last = {row["member"]: row["env_steps"] for row in run_directory.rows(run)}
    evaluated = {
        row["member"]: row["eval_env_steps"]
        for row in run_directory.rows(run)
        if "eval_env_steps" in row
    }
    return sum(last.values()) + sum(evaluated.values())


def steps_below(folder: Path) -> int:
    """Counts the env steps of all runs in a folder: also what a failure made be trained again."""
    return sum(steps_of(path.parent) for path in sorted(folder.rglob("metrics.jsonl")))


def _as_json(trial: FrozenTrial) -> dict[str, Any]:
    notes = trial.user_attrs
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "return": trial.value,
        "env_steps": notes.get(STEPS, 0),
        "searched": dict(trial.params),
        "settings": notes.get(SETTINGS, {}),
        "curve": [[n / storage.REPORTS, v] for n, v in sorted(trial.intermediate_values.items())],
        **({"error": notes[ERROR]} if ERROR in notes else {}),
    }
