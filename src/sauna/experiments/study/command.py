"""`sauna compare` and `sauna study`: train what is missing, then say what was found."""

from __future__ import annotations

import os
import shlex
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from sauna.config.controls import with_controls
from sauna.config.presets import (
    COMPARED,
    COMPARED_SEEDS,
    RULE_HELP,
    algorithm_of,
    chosen_preset,
)
from sauna.config.trust import check_trusted, covers, named_code, seal
from sauna.envs.probe import Probe
from sauna.envs.wrapping import wrapping_of
from sauna.experiments.sequential import DESIGN
from sauna.experiments.study.execute.display import StudyView
from sauna.experiments.study.execute.executor import Executor
from sauna.experiments.study.execute.local import LocalExecutor
from sauna.experiments.study.found_runs import (
    check_same_code,
    check_same_start,
    reopen_damaged,
)
from sauna.experiments.study.measuring import gather_measured, items_of, measure
from sauna.experiments.study.notes import before_training
from sauna.experiments.study.own_arms import check_no_rule, control_of_any, with_own_arms
from sauna.experiments.study.results import gather, typed
from sauna.experiments.study.rounds import every_unit, first_look, next_round, round_units, stopped
from sauna.experiments.study.spec import Spec, load_spec, read_spec, resolved
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.text import lines
from sauna.experiments.study.units import (
    Unit,
    digest_of,
    most_seeds,
    seeds_per_unit,
    study_identity,
)
from sauna.system import run_directory
from sauna.system.errors import BadInput, Interrupted
from sauna.system.signals import noted
from sauna.system.working_folder import kept_folder
from sauna.training.display import counted
from sauna.training.prepare import examine, look_at, place


def chosen_arms(
    arms: Sequence[str], rules: Sequence[str], controls: bool, settings: Mapping[str, Any]
) -> tuple[tuple[str, ...], bool]:
    """Returns the arms of a comparison, and whether they play a tournament.

    Args:
      arms: the list that is given, or `all` alone.
      rules: to be compared with ppo instead.
      controls: whether each arm that chooses samples gets its matched random control.
      settings: of every run.

    Raises:
      BadInput: both are given, or `settings` name a rule.
    """
    if rules and tuple(arms) != COMPARED:
        raise BadInput("rules: give --rules or --arms, not both")
    if tuple(arms) == ("all",):
        rules = tuple(RULE_HELP)
    chosen = ("ppo", *rules) if rules else tuple(arms)
    check_no_rule(settings, chosen)
    if controls:
        chosen = with_controls(chosen, settings, control_of_any)
    return chosen, bool(rules)


def comparison(
    env: str, arms: tuple[str, ...], settings: Mapping[str, Any], sequential: bool = False
) -> Spec:
    """Returns the study that `sauna compare ENV` runs: its folder is named after its settings.

    Args:
      env: the task.
      arms: what is trained, names or `module:name` of rules; the first is the baseline.
      settings: of every run.
      sequential: whether seeds are added only where something is open, `seeds` at most.

    Raises:
      BadInput: unknown arms or settings that cannot be used.
    """
    rules = {}
    if "sauna-reference" in arms:  # beside it the others take its rules, so that the filter differs
        rules = {"truncation": "terminate", "budget": "env"}
    algorithm = algorithm_of(chosen_preset({**settings, "env": env}))
    own = {"label": algorithm, "arm": "ppo"} if algorithm != "ppo" else {"label": "ppo"}
    entries, settings = with_own_arms(arms, settings)
    entries = [own if entry == {"label": "ppo"} else entry for entry in entries]
    seeds, design = COMPARED_SEEDS, {}
    if sequential:
        seeds, design = DESIGN[-1].seeds, {"design": "sequential"}
    values = {"tasks": [env], "arms": entries, "seeds": seeds, **design, **rules, **settings}
    spec = read_spec({"name": "compare", **values})
    place = "".join(c if c.isalnum() or c in "-." else "-" for c in env)
    name = f"compare_{place}_{digest_of(study_identity(spec))}"
    return spec._replace(name=name, text={**spec.text, "name": name})


def compare_command(
    env: str,
    arms: Sequence[str],
    settings: Mapping[str, Any],
    out: str | Path,
    rules: Sequence[str] = (),
    controls: bool = True,
) -> str:
    """Returns what a user types to make the same comparison again."""
    chosen = typed("rules", ",".join(rules)) if rules else typed("arms", ",".join(arms))
    flags = "" if controls else " --no-controls"
    flags += "".join(f" {typed(name, value)}" for name, value in settings.items())
    return f"sauna compare {shlex.quote(env)} {chosen}{flags}{_typed_out(out)}"


def study_command(name: str, out: str | Path, text: Mapping[str, Any] | None = None) -> str:
    """Returns what a user types to run the study again; another one has to trust code it names.

    Args:
      text: what the study was read from.
    """
    trust = " --trust" if named_code(text or {}) else ""
    return f"sauna study {shlex.quote(name)}{_typed_out(out)}{trust}"


def _typed_out(out: str | Path) -> str:
    return f" {typed('out', out)}" if str(out) != "runs" else ""


def study(
    spec: Spec,
    out: Path,
    command: str,
    jobs: int,
    on: str = "local",
    address: str = "",
    quiet: bool = False,
    accept_changed_code: bool = False,
    notes: Callable[[Spec], list[str]] = before_training,
) -> dict[str, Any]:
    """Trains what is missing of `spec` and writes results, summary, report and figures.

    Everything is under `out`: `units/` holds the runs, `NAME/` what was found.

    Args:
      spec: the study.
      out: the folder.
      command: that ran it, for the report.
      jobs: trainings at a time; 0: one per core.
      on: `local`, or `ray`: the Ray cluster at `address`, or a new one on this machine.
      address: of the cluster.
      quiet: show nothing.
      accept_changed_code: take runs of before as they are, even if their code is not what it was.
      notes: lists the lines that are printed before anything is trained.

    Returns:
      the summary.

    Raises:
      BadInput: an environment, the cluster or the folder cannot be used, another study works there,
        or another of this name did.
      Interrupted: a signal came; running again continues.
    """
    if jobs < 0:
        raise BadInput("processes: must be a whole number of at least 0")
    if on == "ray":
        from sauna.experiments.study.execute import ray_cluster

        ray_cluster.check(address)
    elif address:
        raise BadInput("address: read with --on ray only")
    out = Path.cwd() / out  # an environment may go elsewhere
    with kept_folder():
        _check_runs(spec)
    if on == "local":
        jobs = jobs or (1 if _on_gpu(spec) else cores())
        how = jobs, command, quiet, accept_changed_code, notes
        return _train(LocalExecutor, spec, out, command, *how)
    again = f"{command} --on {on}" + (f" --address {address}" if address else "")
    with ray_cluster.connected(address, jobs) as jobs:
        how = jobs, again, quiet, accept_changed_code, notes
        return _train(ray_cluster.RayExecutor, spec, out, command, *how)


def _check_runs(spec: Spec) -> None:
    """Checks every run of the study as it would be checked when it starts.

    Raises:
      BadInput: an environment or settings that cannot be used; the arm is named.
    """
    found: dict[tuple[Any, ...], Probe] = {}
    for arm in spec.arms:
        for task in arm.tasks:
            placed = place(resolved(arm, task))
            config = placed.config
            if spec.measure and config.backend == "device":
                raise BadInput(f"backend: measure needs environments on the host, not {task}")
            key = task, config.env_kwargs, config.backend, wrapping_of(config)
            if key not in found:
                found[key] = look_at(config)
            try:
                prepared = examine(placed, arm.overrides(task, arm.seeds), found[key])
                if spec.measurement:
                    spec.measurement.check_spaces(prepared.config, prepared.spaces)
            except BadInput as error:
                raise BadInput(f"arm {arm.label!r}: {error}") from None


def _on_gpu(spec: Spec) -> bool:
    """Whether some run takes a whole GPU, which others would only slow down."""
    configs = (place(resolved(arm, task)).config for arm in spec.arms for task in arm.tasks)
    return any(config.device == "gpu" for config in configs)


def _train(
    executor: type[Executor],
    spec: Spec,
    out: Path,
    command: str,
    jobs: int,
    again: str,
    quiet: bool,
    accept_changed_code: bool,
    notes: Callable[[Spec], list[str]],
) -> dict[str, Any]:
    """The study on one kind of executor; `again` is the command that continues it there."""
    place, folder = out / spec.name, out / "units"
    size = _unit_size(spec, place, jobs)
    with _locked(folder):
        _note(spec, place, size)
        say = _silent if quiet else partial(print, flush=True)
        units = every_unit(spec, size)
        check_same_code(units, folder, accept_changed_code, say)
        check_same_start(units, folder)
        reopen_damaged(units, folder, say)
        say(_opening(spec, place))
        for note in notes(spec):
            say(note)
        with noted() as came:

            def run(part: Spec, units: list[Unit]) -> None:
                view = StudyView(part, units, folder, quiet)
                view.open()
                try:
                    executor(folder, jobs, view, lambda: bool(came)).run(units)
                    view.close()
                    if part.measure:
                        stopping, few = lambda: bool(came), min(jobs, cores())
                        measure(part, units, folder, place, few, view.say, stopping)
                finally:
                    view.close()

            if spec.looks:
                units = _run_looks(spec, size, folder, run, say, came)
            else:
                run(spec, units)
    summary = write(spec, units, folder, place, command)
    if came:
        name = signal.Signals(came[0]).name
        raise Interrupted(came[0], f"stopped by {name}; continue with: {again}")
    return summary


def _run_looks(
    spec: Spec,
    size: int,
    folder: Path,
    run: Callable[[Spec, list[Unit]], None],
    say: Callable[[str], None],
    came: list[int],
) -> list[Unit]:
    """Trains look by look until everything is decided, or a signal came; all units until then."""
    found = next_round(spec, size, folder)
    while found.waiting is not None and not came:
        seeds, arms = spec.looks[found.look].seeds, len(found.waiting.arms)
        up_to = f"{counted(arms, 'arm')} up to {counted(seeds, 'seed')}"
        say(f"look {found.look + 1} of {len(spec.looks)}: {up_to}")
        run(found.waiting, round_units(found))
        before, found = found, next_round(spec, size, folder)
        for text in stopped(before.replays, found.replays):
            say(text)
    return found.units


def _silent(text: str) -> None:
    pass


def _opening(spec: Spec, place: Path) -> str:
    members = sum(len(arm.seeds) * len(arm.tasks) for arm in spec.arms)
    most = "at most " if spec.looks else ""
    return (
        f"{spec.name}: {counted(len(spec.arms), 'arm')}, {counted(len(spec.tasks), 'task')}, "
        f"{most}{counted(members, 'member')}; writing to {place}"
    )


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Makes and locks the folder of units: one study at a time."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"out: cannot make {folder}: {error.strerror}") from error
    with run_directory.lock(folder):
        yield


def _unit_size(spec: Spec, place: Path, jobs: int) -> int:
    """Seeds per unit: as when the study began, so that its units are found again.

    Raises:
      BadInput: the folder holds another study of this name.
    """
    path = place / "study.json"
    if place.exists() and not place.is_dir():
        raise BadInput(f"out: {place} is no folder")
    if path.is_file():
        stored = run_directory.read_config_file(path)
        text, size = stored.get("study"), stored.get("seeds_per_unit")
        if not isinstance(text, dict) or not isinstance(size, int) or size < 1:
            raise BadInput(f"out: {path} is not what a study writes")
        if not covers(spec.text, text) or not _is_same(text, spec):
            raise BadInput(
                f"study: {place} holds another study of this name; remove it (the runs in units/ "
                f"stay) or give --out"
            )
        return size
    return most_seeds(spec) if _on_gpu(spec) else seeds_per_unit(first_look(spec), jobs)


def _note(spec: Spec, place: Path, size: int) -> None:
    """Makes the study's folder and notes what the study is."""
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"out: cannot make {place}: {error.strerror}") from error
    run_directory.write_json(
        place / "study.json", {"study": spec.text, "seeds_per_unit": size, "seal": seal(spec.text)}
    )


def check_study(text: Mapping[str, Any], out: Path, trust: bool) -> None:
    """Refuses code that a study's file names, unless this user has run it before.

    Raises:
      BadInput: with everything that is named.
    """
    path = out / str(text["name"]) / "study.json"
    stored = run_directory.read_config_file(path) if path.is_file() else {}
    check_trusted(text, f"study {text['name']!r}", stored.get("seal"), trust)


def _is_same(text: Mapping[str, Any], spec: Spec) -> bool:
    """Whether a study reads as `spec`, however its values are written."""
    try:
        return study_identity(read_spec(text)) == study_identity(spec)
    except BadInput:
        return False


def write(spec: Spec, units: list[Unit], folder: Path, place: Path, command: str) -> dict[str, Any]:
    """Gathers what there is and writes `results.json`, `summary.json`, the report and figures."""
    from sauna.experiments.report.figures import NOTHING
    from sauna.experiments.study.report import write_report

    results = gather(spec, units, folder, command)
    summary = summarize(results)
    section = NOTHING
    if measurement := spec.measurement:
        measured = gather_measured(spec, units, folder, place, results)
        run_directory.write_json(place / f"{measurement.name}.json", measured)
        section = measurement.report(measured, place)
        summary["measured"] = list(section.answers)
        summary["not_measured"] = sum(
            not item.is_done for item in items_of(spec, units, folder, place)
        )
    run_directory.write_json(place / "results.json", results)
    run_directory.write_json(place / "summary.json", summary)
    write_report(results, summary, place, section)
    return summary


def cores() -> int:
    return os.cpu_count() or 1


__all__ = ["comparison", "cores", "lines", "load_spec", "study", "write"]
