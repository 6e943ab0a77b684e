"""Recorded episodes as a Parquet file: one row per env step.

| column | |
|---|---|
| `episode`, `step`, `seed` | int64 |
| `observation` | list; a Dict or Tuple is flattened, a picture is its bytes |
| `action` | what the environment took: int64 if it is Discrete, else a list |
| `reward` | float64 |
| `terminated`, `truncated` | bool |
| `final_observation` | list, in the last row of an episode: where it ended |
| `action_mask` | list of int8, 1 for a valid choice, if the policy acts by masks |
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sauna.envs.shapes import mask_in, one_of
from sauna.envs.spaces import Spaces, observation_reader, read_spaces
from sauna.system.errors import BadInput, one_line
from sauna.system.safe_read import Untrusted, open_file, parse_object
from sauna.system.safe_write import replacing
from sauna.training.data.episodes import Add, Recorded, Stored, check_installed, check_same
from sauna.training.data.masks import COLUMN, read_masks, with_every_action, with_masks

NEEDED = ("episode", "observation", "action", "reward", "terminated")
KEY = b"sauna"  # of the file's metadata: how it was recorded, and the spaces


@contextmanager
def parquet_writer(path: Path, env: Any, about: Mapping[str, Any]) -> Iterator[Add]:
    """A function that adds an episode to a new file, which is there at the end.

    Args:
      env: whose spaces are read.
      about: JSON values that say how the episodes were played.

    Raises:
      BadInput: the file is there, or pyarrow is not.
    """
    check_installed("to: a Parquet file", "parquet", "pyarrow")
    if path.exists() or not path.parent.is_dir():
        raise BadInput(f"to: {path} is there already, or its folder is not")
    from pyarrow import parquet

    space = mask_in(env.observation_space)[1]
    reader = observation_reader(space)
    with replacing(path) as part:
        file, number = None, 0

        def add(episode: Recorded) -> None:
            nonlocal file, number
            table = _table(episode, number, space, reader)
            if file is None:
                described = {KEY: json.dumps(about).encode()}
                file = parquet.ParquetWriter(part, table.schema.with_metadata(described))
            file.write_table(table)
            number += 1

        try:
            yield add
        finally:
            if file is not None:
                file.close()


def _table(episode: Recorded, number: int, space: Any, reader: Any) -> Any:
    import pyarrow

    length = len(episode.reward)
    rows = [reader(one_of(space, episode.observation, i)).ravel() for i in range(length + 1)]
    seen = np.stack(rows)
    lists = pyarrow.list_(pyarrow.from_numpy_dtype(seen.dtype))
    last, ends = np.arange(length) == length - 1, [None] * (length - 1)
    masks = {} if episode.mask is None else {COLUMN: _lists(episode.mask[:-1])}
    return pyarrow.table(
        {
            "episode": np.full(length, number),
            "step": np.arange(length),
            "seed": np.full(length, episode.seed),
            "observation": _lists(seen[:-1]),
            "action": episode.action if episode.action.ndim == 1 else _lists(episode.action),
            "reward": episode.reward,
            "terminated": last & episode.terminated,
            "truncated": last & episode.truncated,
            "final_observation": pyarrow.array([*ends, seen[-1].tolist()], lists),
            **masks,
        }
    )


def _lists(rows: np.ndarray) -> Any:
    """`[L, ...]` as L lists of one length."""
    import pyarrow

    flat = pyarrow.array(rows.reshape(-1))
    return pyarrow.FixedSizeListArray.from_arrays(flat, rows[0].size)


def read_parquet(path: Path, name: str, spaces: Spaces, env: str) -> Iterator[Stored]:
    """The episodes of a file, of `sauna record` or any with the same columns.

    `step`, `seed`, `truncated` and `final_observation` may be missing, and `action_mask` where no
    mask is acted by. Rows of an episode follow one another.

    Raises:
      BadInput: there is no such file, it is not Parquet, a column is missing or has holes, or it
        was recorded in other spaces.
    """
    check_installed(name, "parquet", "pyarrow")
    from pyarrow import ArrowException, parquet

    try:
        with open_file(path) as file:
            table = parquet.read_table(file)
    except Untrusted as error:
        raise BadInput(f"{name}: {error}") from error
    except (ArrowException, OSError) as error:
        raise BadInput(f"{name} is no Parquet file: {one_line(error)}") from error
    if missing := [column for column in NEEDED if column not in table.column_names]:
        raise BadInput(f"{name} has no column {missing[0]!r} (needed: {', '.join(NEEDED)})")
    _check_spaces(table.schema.metadata, name, spaces, env)
    columns = {column: _rows(table, column, name) for column in NEEDED}
    seen = columns["observation"].reshape((-1, *_shape_of(columns, spaces)))
    last = np.append(columns["episode"][1:] != columns["episode"][:-1], True)
    finals = _finals(table, name)
    given = _rows(table, COLUMN, name) if spaces.mask and COLUMN in table.column_names else None
    masks = read_masks(given, len(seen), spaces, name)
    for first, end in pairwise([0, *(np.flatnonzero(last) + 1).tolist()]):
        own = seen[first:end]
        final = None if finals is None else finals[end - 1]
        final = own[-1] if final is None else np.asarray(final, seen.dtype)
        yield Stored(
            with_masks(own, None if masks is None else masks[first:end], spaces),
            with_every_action(final.reshape(own.shape[1:]), spaces),
            columns["action"][first:end],
            columns["reward"][first:end],
            bool(columns["terminated"][end - 1]),
        )


def _shape_of(columns: Mapping[str, np.ndarray], spaces: Spaces) -> tuple[int, ...]:
    """The shape of an observation but for its mask: the environment's, if a row fits it."""
    width, shape = columns["observation"].shape[1:], tuple(spaces.observation_shape)
    return shape if width == (int(np.prod(shape)),) else width


def _check_spaces(metadata: Any, name: str, spaces: Spaces, env: str) -> None:
    if KEY not in (metadata or {}):
        return
    try:
        theirs = read_spaces(parse_object(metadata[KEY])["spaces"])
    except (Untrusted, TypeError, ValueError, LookupError) as error:
        raise BadInput(f"{name}: its spaces cannot be read: {error}") from error
    check_same(theirs, spaces, name, env)


def _rows(table: Any, column: str, name: str) -> np.ndarray:
    """A column as an array `[L]`, or `[L, W]` of lists of one length.

    Raises:
      BadInput: it has holes, or lists of several lengths.
    """
    import pyarrow

    found = table[column].combine_chunks()
    if isinstance(found, pyarrow.ChunkedArray):  # older pyarrow, or a table of no rows
        found = pyarrow.concat_arrays(found.chunks) if found.num_chunks else found
    is_list = pyarrow.types.is_list(found.type) or pyarrow.types.is_fixed_size_list(found.type)
    flat = found.flatten() if is_list else found
    if isinstance(flat, list) or found.null_count or flat.null_count:
        raise BadInput(f"{name}: column {column!r} has holes")
    if not (pyarrow.types.is_primitive(flat.type) and len(found)):
        raise BadInput(f"{name}: column {column!r} is of type {found.type}, or empty")
    array = flat.to_numpy(zero_copy_only=False)
    if not is_list:
        return array
    lengths = np.unique(pyarrow.compute.list_value_length(found).to_numpy(zero_copy_only=False))
    if len(lengths) > 1:
        raise BadInput(f"{name}: column {column!r} has lists of several lengths")
    return array.reshape(len(found), -1)


def _finals(table: Any, name: str) -> list[Any] | None:
    return (
        table["final_observation"].to_pylist()
        if "final_observation" in table.column_names
        else None
    )
