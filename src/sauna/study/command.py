"""`sauna compare` and `sauna study`: train what is missing, then say what was found."""

from __future__ import annotations

import hashlib
import json
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sauna import rundir
from sauna.envs.probe import Probe
from sauna.errors import BadInput, Interrupted
from sauna.placement import look_at, placed
from sauna.presets import algorithm_of, chosen_preset
from sauna.run import check_read_after_settling, settle
from sauna.study.local import LocalExecutor
from sauna.study.measuring import gather_measured, measure
from sauna.study.results import gather, typed
from sauna.study.schedule import Executor
from sauna.study.spec import Spec, check, load_spec, read_spec
from sauna.study.summary import summarize
from sauna.study.units import Unit, most_seeds, seeds_per_unit, units_of
from sauna.study.view import StudyView

SEEDS = 6  # of a comparison, where none are given


def comparison(env: str, arms: tuple[str, ...], settings: Mapping[str, Any]) -> Spec:
    """The study that `sauna compare ENV` runs: its folder is named after its settings.

    Raises:
      BadInput: unknown arms or settings that cannot be used.
    """
    rules = {}
    if "sauna-reference" in arms:  # beside it the others take its rules, so that the filter differs
        rules = {"truncation": "terminate", "budget": "env"}
    algorithm = algorithm_of(chosen_preset(settings))
    own = {"label": algorithm, "arm": "ppo"} if algorithm != "ppo" else {"label": "ppo"}
    entries = [own if arm == "ppo" else {"label": arm} for arm in arms]
    values = {"tasks": [env], "arms": entries, "seeds": SEEDS, **rules, **settings}
    text = json.dumps(values, sort_keys=True, default=list)
    place = "".join(c if c.isalnum() or c in "-." else "-" for c in env)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    name, baseline = f"compare_{place}_{digest}", entries[0]["label"] if entries else ""
    return read_spec({"name": name, "baseline": baseline, **values})


def compare_command(env: str, arms: tuple[str, ...], settings: Mapping[str, Any]) -> str:
    """What a user types to make the same comparison again."""
    flags = "".join(f" {typed(name, value)}" for name, value in settings.items())
    return f"sauna compare {env} --arms {','.join(arms)}{flags}"


def study(
    spec: Spec,
    out: Path,
    command: str,
    jobs: int,
    say: Callable[[str], None],
    on: str = "local",
    address: str = "",
) -> dict[str, Any]:
    """Trains what is missing of `spec` and writes results, summary, report and figures.

    Everything is under `out`: `units/` holds the runs, `NAME/` what was found.

    Args:
      spec: the study.
      out: the folder.
      command: that ran it, for the report.
      jobs: trainings at a time; 0: one per core.
      say: prints a line.
      on: `local`, or `ray`: the Ray cluster at `address`, or a new one on this machine.
      address: of the cluster.

    Returns:
      the summary.

    Raises:
      BadInput: an environment, or the cluster, cannot be used.
      Interrupted: a signal came; running again continues.
    """
    if on == "ray":
        from sauna.study import cluster

        cluster.check(address)
    elif address:
        raise BadInput("address: read with --on ray only")
    _check_runs(spec)
    if on == "local":
        jobs = jobs or (1 if _on_gpu(spec) else cores())
        return _train(LocalExecutor, spec, out, command, jobs, say, command)
    again = f"{command} --on {on}" + (f" --address {address}" if address else "")
    with cluster.connected(address, jobs) as jobs:
        return _train(cluster.RayExecutor, spec, out, command, jobs, say, again)


def _check_runs(spec: Spec) -> None:
    """Checks every run of the study as it would be checked when it starts.

    Raises:
      BadInput: an environment or settings that cannot be used; the arm is named.
    """
    found: dict[tuple[str, ...], Probe] = {}
    for arm in spec.arms:
        for task in arm.tasks:
            config = placed(check(arm, task))
            if spec.measure and config.backend == "device":
                raise BadInput(f"backend: measure needs environments on the host, not {task}")
            key = task, config.env_kwargs, config.backend
            if key not in found:
                found[key] = look_at(config)
            try:
                settled = settle(config, found[key].spaces)
                given = {**arm.given(task, arm.seeds), "drop_rate_from": settled.drop_rate_from}
                check_read_after_settling(found[key].spaces, settled, given)
            except BadInput as error:
                raise BadInput(f"arm {arm.label!r}: {error}") from None


def _on_gpu(spec: Spec) -> bool:
    """Whether some run takes a whole GPU, which others would only slow down."""
    configs = (placed(check(arm, task)) for arm in spec.arms for task in arm.tasks)
    return any(config.backend == "device" and config.device == "gpu" for config in configs)


def _train(
    executor: type[Executor],
    spec: Spec,
    out: Path,
    command: str,
    jobs: int,
    say: Callable[[str], None],
    again: str,
) -> dict[str, Any]:
    """The study on one kind of executor; `again` is the command that continues it there."""
    place, folder = out / spec.name, out / "units"
    units = units_of(spec, _unit_size(spec, place, jobs))
    folder.mkdir(exist_ok=True)
    held = rundir.lock(folder)
    view = StudyView(spec, units, folder)
    say(f"{spec.name}: {len(spec.arms)} arms, {len(spec.tasks)} tasks, "
        f"{sum(len(unit.seeds) for unit in units)} members; writing to {place}")  # fmt: skip
    with _signals() as noted:
        view.open()
        try:
            executor(folder, jobs, view, lambda: bool(noted)).run(units)
            view.close()
            if spec.measure:
                measure(spec, units, folder, place, min(jobs, cores()), say, lambda: bool(noted))
        finally:
            view.close()
            held.close()
    summary = write(spec, units, folder, place, command)
    if noted:
        name = signal.Signals(noted[0]).name
        raise Interrupted(noted[0], f"stopped by {name}; continue with: {again}")
    return summary


def _unit_size(spec: Spec, place: Path, jobs: int) -> int:
    """Seeds per unit: as when the study began, so that its units are found again.

    Raises:
      BadInput: the folder holds another study of this name, or cannot be made.
    """
    path = place / "study.json"
    if path.is_file():
        stored = json.loads(path.read_text())
        if stored["study"] != spec.text:
            raise BadInput(f"study: {place} holds another study of this name; give --out")
        return int(stored["seeds_per_unit"])
    size = most_seeds(spec) if _on_gpu(spec) else seeds_per_unit(spec, jobs)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"out: cannot make {place}: {error.strerror}") from error
    rundir.write_json(path, {"study": spec.text, "seeds_per_unit": size})
    return size


def write(spec: Spec, units: list[Unit], folder: Path, place: Path, command: str) -> dict[str, Any]:
    """Gathers what there is and writes `results.json`, `summary.json`, the report and figures."""
    from sauna.study import dial, noise, torso
    from sauna.study.figures import NOTHING
    from sauna.study.report import write_report

    results = gather(spec, units, folder, command)
    summary = summarize(results)
    extra = NOTHING
    if spec.measure:
        measured = gather_measured(spec, units, folder, place, results)
        rundir.write_json(place / f"{spec.measure}.json", measured)
        study = {"noise": noise, "dial": dial, "torso": torso}[spec.measure]
        summary["measured"] = study.verdicts(measured)
        extra = torso.extra(measured, place) if study is torso else study.extra(measured)
    rundir.write_json(place / "results.json", results)
    rundir.write_json(place / "summary.json", summary)
    write_report(results, summary, place, extra)
    return summary


@contextmanager
def _signals() -> Iterator[list[int]]:
    """The signals that asked to stop; the second one stops at once."""
    noted: list[int] = []

    def note(number: int, frame: Any) -> None:
        if noted:
            raise Interrupted(number, "stopped at once; running again continues")
        noted.append(number)

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, note) for number in numbers]
    try:
        yield noted
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def lines(summary: Mapping[str, Any]) -> list[str]:
    """The table and the verdicts, as text."""
    head = ["task", "arm", "seeds", "final return, IQM", "area, IQM", "mean +- std", "keep rate",
            "env steps", "P(better)"]  # fmt: skip
    rows = [head, *(_row(row) for row in summary["table"])]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    table = ["  ".join(f"{text:<{w}}" for text, w in zip(row, widths, strict=True)) for row in rows]
    said = [*(v["text"] for v in summary["verdicts"]), *summary.get("measured", [])]
    return [*(line.rstrip() for line in table), "", *said]


def _row(row: Mapping[str, Any]) -> list[str]:
    failed = f" ({row['failed']} failed)" if row["failed"] else ""
    mean, std = _number(row["final_mean"]), _number(row["final_std"])
    return [
        row["task"], row["label"], f"{row['seeds']}{failed}", _interval(row["final_iqm"]),
        _interval(row["area_iqm"]), f"{mean} +- {std}", _number(row["keep_rate"], 3),
        _number(row["env_steps"], 0), _interval(row["improvement"], 2),
    ]  # fmt: skip


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def _interval(values: list[float | None] | None, digits: int = 1) -> str:
    if values is None or values[0] is None:
        return "-"
    value, low, high = (_number(v, digits) for v in values)
    return value if low == "-" else f"{value} [{low}, {high}]"


def cores() -> int:
    return os.cpu_count() or 1


__all__ = ["comparison", "cores", "lines", "load_spec", "study", "write"]
