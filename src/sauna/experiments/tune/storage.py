"""Optuna's study of a tuning: its file, its sampler, its pruner.

The file `optuna.journal` is a journal of JSON lines, which `optuna-dashboard` reads. The sampler of
a trial is seeded by the trial's number, so that a tuning which was interrupted asks for the same
values.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sauna.experiments.tune.plan import Plan
from sauna.experiments.tune.space import Space
from sauna.system.errors import BadInput

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler
    from optuna.storages import BaseStorage

FILE = "optuna.journal"
NAME = "sauna"
STARTUP = 10  # trials that are drawn at random before TPE models anything
REPORTS = 20  # equal parts of the budget at whose ends a trial reports its score
PRUNED_AFTER = REPORTS // 3  # reports before which no trial is pruned
PRUNED_AMONG = 5  # complete trials before which none is


def check_installed() -> None:
    """Refuses to tune without Optuna.

    Raises:
      BadInput: it is not installed.
    """
    if importlib.util.find_spec("optuna") is None:
        raise BadInput("tune: needs `pip install 'sauna-rl[tune]'`")


def open_study(folder: Path, plan: Plan) -> tuple[Study, BaseStorage]:
    """Opens the study of a tuning, or makes it; returns it and where it is stored."""
    import optuna
    from optuna.storages.journal import JournalFileBackend, JournalStorage

    cut(folder)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with quiet():
        storage = JournalStorage(JournalFileBackend(str(folder / FILE)))
        study = optuna.create_study(
            storage=storage,
            study_name=NAME,
            direction="maximize",
            load_if_exists=True,
            pruner=_pruner(plan.pruner),
        )
    return study, storage


def size_of(folder: Path) -> int:
    """Counts the bytes of the journal."""
    return (folder / FILE).stat().st_size


def cut(folder: Path, size: int | None = None) -> None:
    """Cuts the journal back to `size` bytes, and to its last whole line.

    A kill may leave a line unfinished, behind which nothing could be written.
    """
    path = folder / FILE
    if not path.is_file():
        return
    text = path.read_bytes()[:size]
    with path.open("r+b") as file:
        file.truncate(text.rfind(b"\n") + 1)


def _pruner(name: str) -> BasePruner:
    from optuna import pruners

    if name == "median":
        return pruners.MedianPruner(n_startup_trials=PRUNED_AMONG, n_warmup_steps=PRUNED_AFTER)
    if name == "hyperband":
        return pruners.HyperbandPruner(min_resource=PRUNED_AFTER, max_resource=REPORTS)
    return pruners.NopPruner()


def _sampler(plan: Plan, number: int) -> BaseSampler:
    from optuna import samplers

    seed = int(np.random.SeedSequence([plan.seeds[0], number]).generate_state(1)[0])
    if plan.search == "random":
        return samplers.RandomSampler(seed=seed)
    return samplers.TPESampler(seed=seed, n_startup_trials=STARTUP, multivariate=True)


def ask(
    study: Study, plan: Plan, space: Space, number: int, fixed: Mapping[str, Any], queued: bool
) -> Trial:
    """Asks for trial `number`, the next one.

    Args:
      fixed: values that are not to be chosen.
      queued: they are in Optuna's queue, as what somebody wants to see tried.
    """
    import optuna

    with quiet():
        study.sampler = _sampler(plan, number)
        if queued:
            study.enqueue_trial(dict(fixed))
        elif fixed:
            study.sampler = optuna.samplers.PartialFixedSampler(dict(fixed), study.sampler)
        trial = study.ask({name: one.distribution() for name, one in space.items()})
    assert trial.number == number
    return trial


def again(study: Study, storage: BaseStorage, number: int) -> Trial:
    """Returns a trial that was asked for, by this process or by one before it."""
    import optuna

    stored = storage.get_study_id_from_name(NAME)
    with quiet():
        return optuna.Trial(study, storage.get_trial_id_from_study_id_trial_number(stored, number))


def importance(study: Study) -> dict[str, float]:
    """Computes the importance of each setting over the complete trials, by Optuna's PED-ANOVA.

    Returns:
      shares that sum to 1, the largest first; nothing of fewer than `STARTUP` trials.
    """
    import optuna

    done = study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))
    if len(done) < STARTUP:
        return {}
    with quiet(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of many trials that are equally good
        return {
            name: float(x) for name, x in optuna.importance.get_param_importances(study).items()
        }


@contextmanager
def quiet() -> Iterator[None]:
    """Hides Optuna's warnings of what it calls experimental: its multivariate TPE and the like."""
    from optuna.exceptions import ExperimentalWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        yield
