"""What a policy computes, written down as a list of operations that ONNX and numpy both have.

An operation has the name and the meaning of ONNX's. Every value has a leading batch axis `B`. In
place of ONNX's attributes some have plainer ones; `onnx_file` turns them back.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

ARGUMENTS = ("observation", "action_mask", "state")


class Input(NamedTuple):
    """One array that the environment gives.

    Attributes:
      keys: where it stands in a Dict or Tuple, `("arm", "angles")`; empty: the whole observation.
      shape: of one, without the batch axis.
      dtype: of numpy, as the environment's space has it.
      argument: what it is a part of, one of `ARGUMENTS`.
    """

    name: str
    keys: tuple[Any, ...]
    shape: tuple[int, ...]
    dtype: str
    argument: str = "observation"


class Node(NamedTuple):
    """One operation: `output = op(*inputs)`."""

    op: str
    inputs: tuple[str, ...]
    attributes: dict[str, Any]
    output: str


class Output(NamedTuple):
    """What the caller gets: `value` under a name; `shape` and `dtype` of one."""

    name: str
    value: str
    shape: tuple[int, ...]
    dtype: str


class Graph:
    """Inputs, constants, operations in the order in which they are computed, and outputs."""

    def __init__(self) -> None:
        self.inputs: list[Input] = []
        self.constants: dict[str, np.ndarray] = {}
        self.nodes: list[Node] = []
        self.outputs: list[Output] = []

    def input(
        self,
        name: str,
        keys: tuple[Any, ...],
        shape: tuple[int, ...],
        dtype: Any,
        argument: str = "observation",
    ) -> str:
        """Adds an array that the caller gives; returns its name."""
        self.inputs.append(Input(name, keys, shape, np.dtype(dtype).name, argument))
        return name

    def name_of(self, keys: tuple[Any, ...]) -> str:
        """Names the next part of the observation, which stands at `keys`."""
        return f"observation_{len(self.inputs)}" if keys else "observation"

    @property
    def arguments(self) -> list[str]:
        """What the caller gives, in order: the observation, a mask, a state."""
        given = {part.argument for part in self.inputs}
        return [name for name in ARGUMENTS if name in given]

    def constant(self, name: str, array: Any) -> str:
        """Adds a constant array under a name that no other one has; returns the name."""
        assert name not in self.constants, name
        self.constants[name] = np.ascontiguousarray(array)
        return name

    def add(self, op: str, *inputs: str, **attributes: Any) -> str:
        """Adds an operation; returns the name of what it gives."""
        output = f"x{len(self.nodes)}"
        self.nodes.append(Node(op, inputs, attributes, output))
        return output

    def output(self, name: str, value: str, shape: tuple[int, ...], dtype: Any) -> None:
        """Says what the caller gets."""
        self.outputs.append(Output(name, value, shape, np.dtype(dtype).name))
