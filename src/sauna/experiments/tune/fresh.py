"""Further seeds: the finalists are chosen among, and what was found stands beside the preset.

The best of many scores is partly luck. The finalists, the best trials, are trained with further
seeds, of which the best mean counts. What that leaves is tried on seeds that nobody has seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sauna.config.presets import plain, resolve_run
from sauna.config.settings import Config
from sauna.experiments.study.command import study
from sauna.experiments.study.notes import before_training
from sauna.experiments.study.spec import Spec, read_spec
from sauna.experiments.study.units import digest_of, study_identity
from sauna.experiments.tune.plan import Plan
from sauna.system import run_directory
from sauna.system.errors import BadInput

TUNED, START = "tuned", "start"
LEFT = ("env", "arm", "processes", "out", "track", "track_project")  # of settings


def arm_of(number: int) -> str:
    """Names the arm of a finalist."""
    return f"trial {number}"


def fresh_spec(plan: Plan, found: Mapping[str, Any]) -> Spec:
    """Makes the study of the fresh seeds: the preset first, then the start and what was found.

    What has the same settings as one before it is left out, and a preset that cannot be trained
    with the steps of a trial; see `unfit_preset`.

    Args:
      found: the settings that were found, of the searched ones.
    """
    entries = {
        **({} if unfit_preset(plan) else {f"preset {plan.preset}": plan.default}),
        START: plan.settings,
        TUNED: {**plan.settings, **found},
    }
    return _spec(plan, "fresh", entries, plan.fresh_seeds)


def finalists_spec(plan: Plan, trials: Sequence[Mapping[str, Any]]) -> Spec:
    """Makes the study of the finalists, as `Search.ended` lists them."""
    entries = {arm_of(t["number"]): {**plan.settings, **t["settings"]} for t in trials}
    return _spec(plan, "finalists", entries, plan.finalist_seeds)


def _spec(
    plan: Plan, name: str, entries: Mapping[str, Mapping[str, Any]], seeds: Sequence[int]
) -> Spec:
    """Makes a study of settings by their labels; equal ones are left out, but for the first."""
    arms: list[dict[str, Any]] = []
    seen: list[Config] = []
    for label, settings in entries.items():
        config = resolve_run({**settings, "seeds": list(seeds)}).config
        if config not in seen:
            seen.append(config)
            own = {key: value for key, value in settings.items() if key not in LEFT}
            arms.append({"label": label, "arm": config.arm[0], **own})
    values = {"tasks": [plan.env], "seeds": list(seeds), "arms": arms}
    spec = read_spec({"name": name, **values})
    name = f"{name}_{digest_of(study_identity(spec))}"
    return spec._replace(name=name, text={**spec.text, "name": name})


def finalists_of(plan: Plan, trials: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Lists the complete trials of the highest scores, the best first."""
    done = [trial for trial in trials if trial["state"] == "complete"]
    return sorted(done, key=lambda trial: -trial["return"])[: plan.finalists]


def best_of(
    plan: Plan, trials: Sequence[Mapping[str, Any]], folder: Path
) -> tuple[Mapping[str, Any] | None, dict[str, Any]]:
    """Finds the best trial: of the finalists that with the best mean on their further seeds.

    Before these are trained, it is the one of the highest score.

    Returns:
      the trial, or None if none is complete, and what the further seeds gave, if they did.
    """
    finalists = finalists_of(plan, trials)
    if len(finalists) < 2:
        return next(iter(finalists), None), {}
    read = _read(finalists_spec(plan, finalists), folder)
    means = {row["label"]: row["final_mean"] for row in read["table"]} if read else {}
    known = [t for t in finalists if means.get(arm_of(t["number"])) is not None]
    if len(known) < len(means) or not known:
        return finalists[0], {}
    return max(known, key=lambda trial: means[arm_of(trial["number"])]), read


def unfit_preset(plan: Plan) -> str:
    """Says why the preset cannot be trained with the steps of a trial; empty if it can."""
    try:
        resolve_run({**plan.default, "seeds": plan.fresh_seeds or [0]})
    except BadInput as error:
        return (
            f"preset {plan.preset} cannot be trained with {plan.steps:,} env steps ({error}); "
            f"what is found is compared with the start alone"
        )
    return ""


def try_finalists(
    plan: Plan, trials: Sequence[Mapping[str, Any]], folder: Path, command: str, **place: Any
) -> None:
    """Trains the finalists with further seeds, as far as that is missing.

    Args:
      **place: see `study`: `jobs`, `on`, `address`, `quiet`, `accept_changed_code`.

    Raises:
      BadInput, Interrupted: as `study`.
    """
    finalists = finalists_of(plan, trials)
    if len(finalists) > 1:
        study(finalists_spec(plan, finalists), folder, command, notes=_no_notes, **place)


def evaluate(
    plan: Plan, found: Mapping[str, Any], folder: Path, command: str, **place: Any
) -> None:
    """Trains what was found on fresh seeds, as far as that is missing; see `try_finalists`.

    Raises:
      BadInput, Interrupted: as `study`.
    """
    notes = partial(before_training, seeds="fresh_seeds")
    study(fresh_spec(plan, found), folder, command, notes=notes, **place)


def _no_notes(spec: Spec) -> list[str]:
    """Says nothing: the best mean of the finalists decides, and no test of a difference."""
    return []


def read_fresh(plan: Plan, found: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Reads what the fresh seeds have come to; empty if they were not trained."""
    return _read(fresh_spec(plan, found), folder)


def _read(spec: Spec, folder: Path) -> dict[str, Any]:
    path = folder / spec.name / "summary.json"
    if not path.is_file():
        return {}
    summary = run_directory.read_config_file(path)
    kept = {name: summary[name] for name in ("table", "verdicts")}
    return {"report": f"{spec.name}/report.html", **kept}


def verdict(fresh: Mapping[str, Any]) -> dict[str, Any]:
    """Says what the fresh seeds say of what was found: whether it is believed, and why.

    It is believed if its probability of improvement over the preset on the same seeds is at least
    one half, or over the start if the preset cannot be trained for so few steps.
    """
    if not fresh:
        return {"believed": None, "text": "not tried on fresh seeds"}
    rows = {row["label"]: row for row in fresh["table"]}
    against = next(iter(rows.values()))
    tuned = rows.get(TUNED)
    if tuned is None:
        same = START if START in rows else against["label"]
        return {"believed": False, "text": f"what was found is the {same} itself"}
    chance, low, high = tuned["improvement"] or [None] * 3
    if chance is None or None in (tuned["final_mean"], against["final_mean"]):
        return {"believed": None, "text": "the trainings on fresh seeds did not all end"}
    return {
        "believed": chance >= 0.5,
        "text": (
            f"mean final return on fresh seeds: {tuned['final_mean']:.4g} against "
            f"{against['final_mean']:.4g} of {against['label']}; probability of improvement "
            f"{chance:.2f} [{low:.2f}, {high:.2f}]"
        ),
    }


def tuned_settings(plan: Plan, found: Mapping[str, Any]) -> dict[str, Any]:
    """Lists the settings of a run with what was found, as `sauna train --config` reads them."""
    return plain({"arm": ["ppo"], **plan.settings, **found})
