"""Training a run to its end: afresh, or from its newest good checkpoint."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.presets import BEFORE
from sauna.config.settings import Config, fields_with, to_json
from sauna.envs.spaces import difference, read_spaces
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput
from sauna.system.logs import check_logs, cut_logs, damage_of
from sauna.training.coordinator import Callback, CallbackRaised, Coordinator
from sauna.training.display import Display
from sauna.training.extension import GOES_FURTHER
from sauna.training.initial import load_initial
from sauna.training.run import Run, check_call, disk_errors
from sauna.training.tracking.trackers import chosen, last_steps


def train_run(
    run: Run,
    display: Display,
    *,
    resume: bool,
    inexact: bool = False,
    callback: Callback | None = None,
    draw: Callable[[Path], Path | None] | None = None,
    until: int | None = None,
) -> bool:
    """Trains a run to its end; returns when everything is written.

    Args:
      callback: sees each row of `metrics.jsonl`; its member stops if it returns True.
      draw: draws a figure of the run at its end, for its trackers, too.
      until: the iteration at whose start the run pauses, with its state saved; None: at its end.

    Returns:
      False if it was complete already, so that nothing was done.

    Raises:
      BadInput: a setting cannot be used after all, as a worker found; a new run is removed again.
      Interrupted: a signal came; the state is saved.
      SaunaError: something failed; the last good checkpoint is on disk.
      Exception: what the callback raised.
    """
    raised = None
    try:
        check_call(run.config, inexact, callback)
        with disk_errors(run.path):
            return _train(run, display, resume, inexact, callback, draw, until)
    except BadInput:
        if not resume:  # what a worker found to be one before the first row: nothing is created
            run_directory.discard(run.path, run.made)
        raise
    except CallbackRaised as error:
        raised = error.error
    finally:
        run.lock.close()
    raise raised  # here, where it gets no other context than the user's


def _train(
    run: Run,
    display: Display,
    resume: bool,
    inexact: bool,
    callback: Callback | None,
    draw: Callable[[Path], Path | None] | None,
    until: int | None,
) -> bool:
    loaded, tracked = None, {}
    if resume:
        if run_directory.is_complete(run.path) and _is_whole(run, display):
            display.say(f"{run.path} is complete; nothing to do")
            return False
        loaded = _load(run, display)
        tracked = last_steps(run_directory.rows(run.path)) if chosen(run.config) else {}
        cut_logs(run.path, loaded.manifest["logs"] if loaded else {})
    initial = load_initial(run.path, run.config) if loaded is None else {}
    more = inexact, tracked, callback, draw, until
    with Coordinator(run, display, loaded, initial, *more) as coordinator:
        coordinator.run()
    return True


def _is_whole(run: Run, display: Display) -> bool:
    """Whether the rows of a complete run are those that were written; what is not is named."""
    damage = damage_of(run.path)
    if damage is not None:
        display.say(f"warning: {damage}; the run is continued from before that")
    return damage is None


def _load(run: Run, display: Display) -> checkpoint.Checkpoint | None:
    """Loads the newest checkpoint that is good, of this run, and whose rows are all there.

    Raises:
      BadInput: a checkpoint is of another run or environment; each field that differs is named.
      BadCheckpoint: there are checkpoints, but none can be used.
    """
    ours = run.manifest()

    def check(manifest: dict[str, Any]) -> None:
        _check_same(run.path, ours, manifest, run.extended)
        check_logs(run.path, manifest)

    loaded = checkpoint.load_newest(run.path / "checkpoints", display.say, check)
    before = loaded.manifest.get("versions", {}) if loaded else {}
    changed = [
        f"{name} {before[name]} -> {ours['versions'].get(name)}"
        for name in before
        if before[name] != ours["versions"].get(name)
    ]
    if changed:
        display.say(
            f"warning: other versions than when the checkpoint was saved "
            f"({', '.join(changed)}): the rest may differ in its last bits"
        )
    return going_on(loaded, ours["config"]) if loaded else None


def going_on(loaded: checkpoint.Checkpoint, config: Mapping[str, Any]) -> checkpoint.Checkpoint:
    """Lets members go on that were stopped early, if the run goes further than it did then.

    That is if it has more steps, or another rule to stop.
    """
    before = {**to_json(Config()), **loaded.manifest["config"]}
    if all(before[name] == config[name] for name in GOES_FURTHER):
        return loaded
    arrays = {
        name: np.zeros_like(array) if name.endswith("/evaluation/since_best") else array
        for name, array in loaded.arrays.items()
        if not name.endswith("/counters/stopped")
    }
    return loaded._replace(arrays=arrays)


def _check_same(
    path: Path,
    ours: dict[str, Any],
    manifest: dict[str, Any],
    extended: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Refuses a checkpoint that another config or environment wrote.

    Args:
      extended: the values that fields had before the run was extended.

    Raises:
      BadInput: with every field that differs.
    """
    stored = {**to_json(Config()), **BEFORE, **manifest["config"]}
    free = (*fields_with("resumable"), "out")
    differing = [
        f"{name} is {stored[name]!r}, not {value!r}"
        for name, value in ours["config"].items()
        if name not in free
        and stored[name] != value
        and not any(before.get(name) == stored[name] for before in extended if name in before)
    ]
    try:
        spaces = difference(read_spaces(manifest["spaces"]), read_spaces(ours["spaces"]))
    except (TypeError, ValueError):
        spaces = "cannot be read"
    if spaces:
        differing.append(f"spaces differ: {spaces}")
    for name in ("arms", "members"):
        if manifest[name] != json.loads(json.dumps(ours[name])):
            differing.append(f"{name} differ")
    if differing:
        raise BadInput(
            f"{path}: its checkpoint is of another run or environment: {'; '.join(differing)}"
        )
