"""Row 3: a changed or shortened checkpoint is named and kept, and the one before it is used."""

from __future__ import annotations

import random
import time
from pathlib import Path

import numpy as np

from faults.canned import BACKENDS, record
from faults.result import Result, Tally, assert_held
from helpers import equal
from sauna.system import checkpoint

OLD, NEW = 3, 4


def _save_two(folder: Path, env: str) -> dict[int, dict[str, np.ndarray]]:
    """Two checkpoints of a real training."""
    states = record(env).states
    for iteration in (OLD, NEW):
        manifest = {
            "config": {"gamma": 0.99, "adam_epsilon": 1e-5},
            "members": ["ppo/0"],
            "logs": {"metrics.jsonl": 100 * iteration},
        }
        checkpoint.save_checkpoint(folder, iteration, states[iteration], manifest, 2)
    return states


def experiment(flips: int, seed: int, place: Path) -> Result:
    """Flips a bit of the newest checkpoint, or cuts one of its files to any length.

    On each backend; with every length where `flips` is large, with 50 of each file otherwise. A
    flip inside the manifest's JSON that leaves every value as it was (`1e-05` and `1E-05`) changes
    nothing and is counted apart. `worst`: seconds of the slowest load.
    """
    tally = Tally()
    for backend in BACKENDS:
        _spoil(backend, flips, random.Random(seed), place / backend, tally)
    return tally.result()


def _spoil(backend: str, flips: int, rng: random.Random, place: Path, tally: Tally) -> None:
    states = _save_two(place, BACKENDS[backend])
    newest = place / f"{NEW:08d}"
    whole = {path: path.read_bytes() for path in newest.iterdir()}
    bits = [(path, bit) for path, data in whole.items() for bit in range(8 * len(data))]
    for path, bit in [rng.choice(bits) for _ in range(flips)]:
        changed = bytearray(whole[path])
        changed[bit // 8] ^= 1 << bit % 8
        _judge(path, bytes(changed), whole, states, tally, f"bit {bit}")
        tally.count("bit flips")
    for path, data in whole.items():
        lengths = range(len(data))
        for length in lengths if flips >= 10_000 else rng.sample(lengths, 50):
            _judge(path, data[:length], whole, states, tally, f"cut to {length} bytes")
            tally.count("truncations")


def _judge(
    path: Path,
    changed: bytes,
    whole: dict[Path, bytes],
    states: dict[int, dict[str, np.ndarray]],
    tally: Tally,
    what: str,
) -> None:
    path.write_bytes(changed)
    tally.tried += 1
    said: list[str] = []
    clock = time.perf_counter()
    found = checkpoint.load_newest(path.parent.parent, said.append)
    tally.took(time.perf_counter() - clock)
    if found is None or path.read_bytes() != changed:
        tally.lose(f"{path.name}, {what}: nothing was loaded, or the bad file was touched")
    else:
        iteration = found.manifest["iteration"]
        if not equal(found.arrays, states[iteration]):
            tally.miss(f"{path.name}, {what}: loaded, with other numbers")
        elif iteration == NEW and not _means_the_same(path, changed, whole[path]):
            tally.miss(f"{path.name}, {what}: loaded without a word")
        elif iteration == NEW:
            tally.count("changed nothing that is read")
        elif len(said) != 1 or path.parent.name not in said[0]:
            tally.miss(f"{path.name}, {what}: said {said}")
    path.write_bytes(whole[path])


def _means_the_same(path: Path, changed: bytes, whole: bytes) -> bool:
    from sauna.system.safe_read import parse_object

    return path.name == "manifest.json" and parse_object(changed) == parse_object(whole)


def test_every_flip_and_every_truncation_is_noticed(tmp_path: Path) -> None:
    tally = Tally()
    _spoil("host", 300, random.Random(0), tmp_path, tally)
    assert_held(tally.result(), 300)
