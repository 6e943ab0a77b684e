"""A policy's operations as a short Python file that needs numpy and safetensors alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sauna.experiments.share.graph import Graph, Input, Node

WIDTH = 92  # letters of a line up to which a value that is used once is written in its place

# Each operation, as numpy has it; `{0}` is its first input.
OPERATIONS = {
    "Add": "{0} + {1}",
    "ArgMax": "np.argmax({0}, -1, keepdims=True)",
    "Cast": "{0}.astype(np.{to})",
    "Conv": "conv({0}, {1}, {2}, {stride}, {pad})",
    "Div": "{0} / {1}",
    "Exp": "np.exp({0})",
    "Equal": "{0} == {1}",
    "Gemm": "{0} @ {1} + {2}",
    "Greater": "{0} > {1}",
    "LayerNormalization": "norm({0}, {1}, {2}, {epsilon})",
    "MatMul": "{0} @ {1}",
    "Max": "np.maximum({0}, {1})",
    "MaxPool": "pool({0}, {before})",
    "Min": "np.minimum({0}, {1})",
    "Mul": "{0} * {1}",
    "Relu": "np.maximum({0}, 0)",
    "Reshape": "{0}.reshape(-1, {shape})",
    "Sigmoid": "0.5 + 0.5 * np.tanh(0.5 * ({0}))",
    "Slice": "{0}[..., {start}:{end}]",
    "Softplus": "np.logaddexp({0}, 0)",
    "Sub": "{0} - {1}",
    "Tanh": "np.tanh({0})",
    "Transpose": "{0}.transpose({perm})",
    "Where": "np.where({0}, {1}, {2})",
}
HELPERS = {
    "Conv": '''
def conv(x, kernel, bias, stride, pad):
    """A convolution of x [B, C, H, W] with zeros around it; kernel [F, C, K, K]."""
    x = np.pad(x, ((0, 0), (0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[2:], (2, 3))
    products = np.tensordot(windows[:, :, ::stride, ::stride], kernel, ((1, 4, 5), (1, 2, 3)))
    return (products + bias).transpose(0, 3, 1, 2)

''',
    "MaxPool": '''
def pool(x, above, left):
    """The largest of 3 x 3 pixels of x [B, C, H, W], moved by two pixels."""
    x = np.pad(x, ((0, 0), (0, 0), (above, 1), (left, 1)), constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(x, (3, 3), (2, 3))
    return windows[:, :, ::2, ::2].max((-1, -2))

''',
    "LayerNormalization": '''
def norm(x, scale, bias, epsilon):
    """x [B, D] by the mean and the variance of each row, then scaled and shifted."""
    mean, variance = x.mean(-1, keepdims=True), x.var(-1, keepdims=True)
    return (x - mean) / np.sqrt(variance + epsilon) * scale + bias

''',
}
TEMPLATE = '''"""{title}

act({arguments}) gives the most likely action{and_state}.
Needs numpy and safetensors; the numbers are in policy.safetensors, beside this file.
"""

from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

W = load_file(Path(__file__).with_name("policy.safetensors"))

{helpers}
def act({signature}):
    """The action for one observation, or the actions for a batch (one more axis in front)."""
{lines}
'''


def to_numpy(graph: Graph, title: str) -> str:
    """Writes the file; the graph's constants are what has to stand in `policy.safetensors`."""
    helpers = "".join(text for op, text in HELPERS.items() if op in {n.op for n in graph.nodes})
    first, (action, *state) = graph.inputs[0], graph.outputs
    lines = [f"is_one = np.ndim({_place(first)}) == {len(first.shape)}"]
    lines += [f"{i.name} = {_read(i, first)}" for i in graph.inputs]
    lines += _assignments(graph)
    answer = f"{action.value}[0] if is_one else {action.value}"
    lines.append(f"return ({answer}), {state[0].value}" if state else f"return {answer}")
    given = ", ".join(graph.arguments)
    text = "\n".join(f"    {line}" for line in lines)
    title = "".join(c if c.isalnum() or c in " -_.,:/+" else "_" for c in title)  # it ends no text
    return TEMPLATE.format(
        title=title,
        arguments=given,
        signature=given.replace("state", "state=None"),
        and_state=" and the state; at an episode's start give none" * bool(state),
        helpers=helpers,
        lines=text,
    )


def _place(given: Input) -> str:
    return given.argument + "".join(f"[{key!r}]" for key in given.keys)


def _read(given: Input, first: Input) -> str:
    shape = ", ".join(map(str, (-1, *given.shape)))
    if given.argument == "state":
        zeros = f"np.zeros((len({first.name}), {given.shape[0]}), np.float32)"
        return f"{zeros} if state is None else state"
    return f"np.asarray({_place(given)}, np.{given.dtype}).reshape({shape})"


def _assignments(graph: Graph) -> list[str]:
    """One line for each value that is used more than once or whose line would grow too long."""
    uses = [name for node in graph.nodes for name in node.inputs]
    uses += [output.value for output in graph.outputs] * 2  # a name of its own
    known = {name: f'W["{name}"]' for name in graph.constants}
    known |= {i.name: i.name for i in graph.inputs}
    lines = []
    for node in graph.nodes:
        text = _expression(node, known)
        if uses.count(node.output) == 1 and len(text) < WIDTH - 30:
            known[node.output] = text
        else:
            lines.append(f"{node.output} = {text}")
            known[node.output] = node.output
    return lines


def _expression(node: Node, known: Mapping[str, str]) -> str:
    parts = [known[name] for name in node.inputs]
    if node.op == "Concat":
        return f"np.concatenate([{', '.join(parts)}], -1)"
    template = OPERATIONS[node.op]
    is_inside = "({0}" in template  # in the brackets of a call it needs none of its own
    parts = [part if is_inside else _bracketed(part) for part in parts]
    return template.format(*parts, **{k: _written(v) for k, v in node.attributes.items()})


def _bracketed(text: str) -> str:
    """In brackets if an operator stands in it outside of any."""
    depth = 0
    for letter in text:
        depth += (letter in "([") - (letter in ")]")
        if depth == 0 and letter == " ":
            return f"({text})"
    return text


def _written(value: Any) -> str:
    if isinstance(value, tuple | list):
        return ", ".join(map(str, value))
    return str(value)
