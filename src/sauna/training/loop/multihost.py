"""Several machines that train together, joined by `jax.distributed`.

Every machine runs the same command, but for its index, and computes its part of the same program.
Machine 0 alone writes the run and decides how far it goes; it broadcasts that, call by call.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import numpy as np

from sauna.system.errors import BadInput


class HostRank(NamedTuple):
    """This machine's rank among those that train together."""

    address: str  # HOST:PORT of rank 0
    hosts: int
    rank: int  # of this one, from 0


SINGLE_HOST = HostRank("", 1, 0)


def read_host_rank(text: str) -> HostRank:
    """Reads `HOST:PORT,COUNT,INDEX`; the empty text is one machine alone.

    Raises:
      BadInput: it is not of that form.
    """
    if not text:
        return SINGLE_HOST
    address, *numbers = text.split(",")
    if len(numbers) != 2 or not all(n.isdecimal() for n in numbers) or ":" not in address:
        raise BadInput(f"distributed: {text!r} is not HOST:PORT,COUNT,INDEX")
    count, index = map(int, numbers)
    if not 0 <= index < count or count < 2:
        raise BadInput(
            f"distributed: index {index} of {count} machines; it counts from 0, and "
            f"takes at least 2"
        )
    return HostRank(address, count, index)


def join(host: HostRank) -> None:
    """Waits until all machines have joined, once. Before anything else is asked of JAX."""
    if host.hosts > 1:
        import jax

        if jax.distributed.is_initialized():
            return
        jax.distributed.initialize(host.address, host.hosts, host.rank)


def leave() -> None:
    """Waits until all machines leave: if one merely ends, JAX aborts the others."""
    import jax

    jax.distributed.shutdown()


def broadcast(host: HostRank, number: int) -> int:
    """Gives rank 0's number to every machine."""
    if host.hosts == 1:
        return number
    from jax.experimental.multihost_utils import broadcast_one_to_all

    return int(broadcast_one_to_all(np.int32(number)))


def all_equal(host: HostRank, text: str) -> bool:
    """Returns whether all machines have the same text."""
    if host.hosts == 1:
        return True
    from jax.experimental.multihost_utils import process_allgather

    digest = np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8)
    return bool((np.asarray(process_allgather(digest)) == digest).all())


def broadcast_arrays(host: HostRank, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Gives rank 0's arrays to every machine."""
    if host.hosts == 1:
        return arrays
    from jax.experimental.multihost_utils import broadcast_one_to_all
    from safetensors.numpy import load, save

    blob = np.frombuffer(save(arrays), np.uint8)
    size = broadcast(host, len(blob))
    buffer = blob if host.rank == 0 else np.zeros(size, np.uint8)
    return load(np.asarray(broadcast_one_to_all(buffer)).tobytes())


def split_over_devices(members: int, envs: int, devices: int) -> tuple[int, int]:
    """Finds over how many devices members are split, and the environments of each member.

    As many as divide evenly; if several ways use as many devices, members go first.
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


def check_split(name: str, members: int, envs: int, devices: int) -> None:
    """Refuses devices of which some would have no work.

    Raises:
      BadInput: the field `name` asked for them.
    """
    over_members, over_envs = split_over_devices(members, envs, devices)
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

    def stopped(self) -> set[str]:
        return set()

    def iteration(self, iteration: int, rows: Any, timing: Any) -> None:
        pass

    def state(self, iteration: int, arrays: Any) -> None:
        pass
