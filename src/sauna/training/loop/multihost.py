"""Several machines that train together, joined by `jax.distributed`.

Every machine runs the same command, but for its index, and computes its part of the same program.
Machine 0 alone writes the run and decides how far it goes; the others are told, call by call.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import numpy as np

from sauna.system.errors import BadInput


class Place(NamedTuple):
    """Where this machine stands among the others."""

    address: str  # HOST:PORT of machine 0
    machines: int
    number: int  # of this one, from 0


ALONE = Place("", 1, 0)


def read_place(text: str) -> Place:
    """`HOST:PORT,COUNT,INDEX`; the empty text is one machine alone.

    Raises:
      BadInput: it is not of that form.
    """
    if not text:
        return ALONE
    address, *numbers = text.split(",")
    if len(numbers) != 2 or not all(n.isdecimal() for n in numbers) or ":" not in address:
        raise BadInput(f"distributed: {text!r} is not HOST:PORT,COUNT,INDEX")
    count, index = map(int, numbers)
    if not 0 <= index < count or count < 2:
        raise BadInput(
            f"distributed: index {index} of {count} machines; it counts from 0, and "
            f"takes at least 2"
        )
    return Place(address, count, index)


def join(place: Place) -> None:
    """Waits until all machines are there, once. Before anything else is asked of JAX."""
    if place.machines > 1:
        import jax

        if jax.distributed.is_initialized():
            return
        jax.distributed.initialize(place.address, place.machines, place.number)


def leave() -> None:
    """Waits until all machines leave: where one merely ends, JAX aborts the others."""
    import jax

    jax.distributed.shutdown()


def tell(place: Place, number: int) -> int:
    """What machine 0 says, on every machine."""
    if place.machines == 1:
        return number
    from jax.experimental.multihost_utils import broadcast_one_to_all

    return int(broadcast_one_to_all(np.int32(number)))


def same(place: Place, text: str) -> bool:
    """Whether all machines say the same."""
    if place.machines == 1:
        return True
    from jax.experimental.multihost_utils import process_allgather

    own = np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8)
    return bool((np.asarray(process_allgather(own)) == own).all())


def share(place: Place, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Machine 0's arrays, on every machine."""
    if place.machines == 1:
        return arrays
    from jax.experimental.multihost_utils import broadcast_one_to_all
    from safetensors.numpy import load, save

    blob = np.frombuffer(save(arrays), np.uint8)
    size = tell(place, len(blob))
    room = blob if place.number == 0 else np.zeros(size, np.uint8)
    return load(np.asarray(broadcast_one_to_all(room)).tobytes())


def shared_over(members: int, envs: int, devices: int) -> tuple[int, int]:
    """Over how many devices members are shared, and the environments of each: as many as divide.

    Where several ways use as many devices, members go first.
    """
    return max(
        (
            (a, b)
            for a in range(1, devices + 1)
            for b in range(1, devices // a + 1)
            if members % a == 0 and envs % b == 0
        ),
        key=lambda ways: (ways[0] * ways[1], ways[0]),
    )


def check_shared(name: str, members: int, envs: int, devices: int) -> None:
    """Refuses devices of which some would be idle.

    Raises:
      BadInput: the field `name` asked for them.
    """
    over_members, over_envs = shared_over(members, envs, devices)
    if over_members * over_envs < devices:
        raise BadInput(
            f"{name}: {members} members of {envs} environments cannot be shared evenly "
            f"over {devices} devices"
        )


class Follower:
    """The reporter of a machine that writes nothing."""

    def __init__(self, say: Any) -> None:
        self._say = say

    def phase(self, text: str) -> None:
        self._say(text)

    def allowance(self, iteration: int) -> int:
        return 1  # machine 0 says how many

    def iteration(self, iteration: int, rows: Any, timing: Any) -> None:
        pass

    def state(self, iteration: int, arrays: Any) -> None:
        pass
