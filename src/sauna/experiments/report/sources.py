"""Learning curves of runs that exist: run directories, CSV files, TensorBoard event files."""

from __future__ import annotations

import csv
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sauna.system import run_directory
from sauna.system.errors import BadInput

# Columns of CSV files, and the names that other trainers give them.
STEP_COLUMNS = ("step", "env_steps", "global_step", "timesteps", "total_timesteps")
RETURN_COLUMNS = ("return", "return_mean", "episodic_return", "episode_return", "ep_rew_mean")
# Tags of TensorBoard files: ours, Stable-Baselines3's, CleanRL's, RSL-RL's, Brax's.
TAGS = (
    "return_mean",
    "rollout/ep_rew_mean",
    "charts/episodic_return",
    "Train/mean_reward",
    "eval/episode_reward",
)
TOO_SHORT = "no seed has two points or more"
MAX_EVENT = 1 << 24  # bytes of an event that is read: scalars take less than a hundred


class Curve(NamedTuple):
    """One seed's returns `y` over env steps `x`, `[n]` each; env steps rise.

    `evaluations` are the rows of `metrics.jsonl` that have one.
    """

    x: np.ndarray
    y: np.ndarray
    keep_rate: float | None = None
    evaluations: Sequence[Mapping[str, Any]] = ()


class Source(NamedTuple):
    """The curves of one arm.

    Attributes:
      label: of the arm.
      task: the environment, or "" if the files do not name it.
      arm: that it is an arm of this package, or "".
      path: where it was read.
      config: the run's settings; empty for files of other trainers.
      seeds: a curve for each.
    """

    label: str
    task: str
    arm: str
    path: Path
    config: dict[str, Any]
    seeds: dict[int, Curve]


def read_sources(paths: Sequence[Path], tag: str = "") -> list[Source]:
    """Reads every arm of every path; labels that would be alike get their path's name.

    Args:
      paths: run directories; CSV files with the columns step, return and, if they have them, arm
        and seed; or TensorBoard event files, their folders, or a folder with one such folder for
        each seed.
      tag: of the returns in TensorBoard files; by default the first of `TAGS` that is there.

    Raises:
      BadInput: a path holds nothing of the kind, or two paths are the same.
    """
    found: list[Source] = []
    for path in paths:
        if path.resolve() in [other.path.resolve() for other in found]:
            raise BadInput(f"{path} is given twice")
        found += _read(path, tag)
    labels = [source.label for source in found]
    named = [
        s._replace(label=f"{s.label} ({s.path.name})") if labels.count(s.label) > 1 else s
        for s in found
    ]
    labels = [source.label for source in named]
    return [
        s._replace(label=f"{s.label} {i}") if labels.count(s.label) > 1 else s
        for i, s in enumerate(named, 1)
    ]


def is_source(path: Path) -> bool:
    """Returns whether a path looks like a run, a CSV file or TensorBoard files rather than a
    name."""
    return (
        path.suffix == ".csv"
        or (path / "config.json").is_file()
        or (path.exists() and bool(_event_files(path)))
    )


def _read(path: Path, tag: str) -> list[Source]:
    if (path / "config.json").is_file():
        return _read_run(path)
    if not path.exists():
        raise BadInput(f"{path} does not exist: give run directories, CSV or TensorBoard files")
    if path.is_file() and path.suffix == ".csv":
        return _read_csv(path)
    if files := _event_files(path):
        return [_read_events(path, files, tag)]
    raise BadInput(f"{path} is no run directory, no CSV file and has no TensorBoard files")


def _read_run(run: Path) -> list[Source]:
    """Each arm of a run directory."""
    config = run_directory.read_config(run, needed=("config",))["config"]
    points: dict[str, dict[int, list[dict[str, Any]]]] = {}
    for row in run_directory.rows(run):
        if "return_mean" in row:
            points.setdefault(row["arm"], {}).setdefault(row["seed"], []).append(row)
    if not points:
        raise BadInput(f"{run}: no episode has finished yet")
    return [
        Source(
            arm,
            str(config["env"]),
            arm,
            run,
            config,
            {seed: _of_rows(rows) for seed, rows in seeds.items()},
        )
        for arm, seeds in points.items()
    ]


def _of_rows(rows: list[dict[str, Any]]) -> Curve:
    kept, last = rows[-1].get("kept_steps"), rows[-1]["env_steps"]
    x, y = (np.array([row[name] for row in rows], float) for name in ("env_steps", "return_mean"))
    evaluations = [row for row in rows if "eval_return_mean" in row]
    return Curve(x, y, kept / last if kept is not None and last else None, evaluations)


def _read_csv(path: Path) -> list[Source]:
    """The arms (all is one without a column `arm`) and seeds of a CSV file, without # lines."""
    points: dict[str, dict[int, list[tuple[float, float]]]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # Excel's begins with a mark
            reader = csv.DictReader(line for line in file if not line.startswith("#"))
            names = reader.fieldnames or []
            step, value = _column(path, names, STEP_COLUMNS), _column(path, names, RETURN_COLUMNS)
            for number, row in enumerate(reader, 1):
                if row[value]:
                    seed, point = _point(path, number, row, step, value)
                    arm = row.get("arm") or path.stem
                    points.setdefault(arm, {}).setdefault(seed, []).append(point)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{path}: cannot be read ({error})") from error
    if not points:
        raise BadInput(f"{path}: no row has a return")
    curves = {arm: found for arm, own in points.items() if (found := _curves(own))}
    if not curves:
        raise BadInput(f"{path}: {TOO_SHORT}")
    return [Source(arm, "", "", path, {}, found) for arm, found in curves.items()]


def _column(path: Path, names: Any, known: tuple[str, ...]) -> str:
    found = [name for name in known if name in names]
    if not found:
        raise BadInput(f"{path}: needs a column {known[0]!r} (or {', '.join(known[1:])})")
    return found[0]


def _point(
    path: Path, number: int, row: Mapping[str, str], step: str, value: str
) -> tuple[int, tuple[float, float]]:
    try:
        return int(row.get("seed") or 0), (float(row[step]), float(row[value]))
    except (TypeError, ValueError):
        raise BadInput(f"{path}: row {number} has something that is no number") from None


def _curves(points: Mapping[int, list[tuple[float, float]]]) -> dict[int, Curve]:
    """Curves from points in any order, of seeds that have two; several at one step are averaged."""
    curves = {}
    for seed, found in sorted(points.items()):
        at: dict[float, list[float]] = {}
        for step, value in found:
            if math.isfinite(step) and math.isfinite(value):
                at.setdefault(step, []).append(value)
        x = sorted(at)
        if len(x) > 1:
            curves[seed] = Curve(np.array(x), np.array([np.mean(at[step]) for step in x]))
    return curves


def _event_files(path: Path) -> list[list[Path]]:
    """TensorBoard's files, a list for each seed."""
    if path.is_file():
        return [[path]] if "tfevents" in path.name else []
    own = sorted(path.glob("*tfevents*"))
    if own:
        return [own]
    return [files for folder in sorted(path.glob("*")) if (files := [*folder.glob("*tfevents*")])]


def _read_events(path: Path, seeds: list[list[Path]], tag: str) -> Source:
    """The seeds of TensorBoard files, counted from 0."""
    points: dict[int, list[tuple[float, float]]] = {}
    for seed, files in enumerate(seeds):
        scalars: dict[str, list[tuple[float, float]]] = {}
        for file in files:
            for name, step, value in read_scalars(file):
                scalars.setdefault(name, []).append((step, value))
        chosen = next((name for name in ((tag,) if tag else TAGS) if name in scalars), None)
        if chosen is None:
            known = ", ".join(sorted(scalars)[:10]) or "none"
            wanted = repr(tag) if tag else "that this program knows the returns by"
            raise BadInput(f"{path}: has no tag {wanted} (tags: {known}); give --tag")
        points[seed] = scalars[chosen]
    if not (curves := _curves(points)):
        raise BadInput(f"{path}: {TOO_SHORT}")
    return Source(path.stem if path.is_file() else path.name, "", "", path, {}, curves)


def read_scalars(file: Path) -> Iterator[tuple[str, float, float]]:
    """Yields `(tag, step, value)` of an event file; an unfinished last event is left out.

    A file is a row of records: length (8 bytes), its checksum (4), the event, its checksum (4).

    Raises:
      BadInput: tensorboardX is not installed, or the file is no event file.
    """
    try:
        from google.protobuf.message import DecodeError
        from tensorboardX.proto.event_pb2 import Event
    except ImportError as error:
        text = "TensorBoard files need `pip install sauna-rl[tensorboard]`"
        raise BadInput(text) from error
    with file.open("rb") as stream:
        while len(head := stream.read(12)) == 12:
            (length,) = struct.unpack("<Q", head[:8])
            data = stream.read(length + 4) if length <= MAX_EVENT else b""
            if length > MAX_EVENT:
                raise BadInput(f"{file} is no TensorBoard file, or is damaged")
            if len(data) < length + 4:
                return
            try:
                event = Event.FromString(data[:-4])
            except DecodeError as error:
                raise BadInput(f"{file} is no TensorBoard file, or is damaged") from error
            for value in event.summary.value:
                if value.HasField("simple_value"):
                    yield value.tag, float(event.step), float(value.simple_value)
                elif value.HasField("tensor") and len(value.tensor.float_val) == 1:
                    yield value.tag, float(event.step), float(value.tensor.float_val[0])
