"""A policy's operations as an ONNX model."""

from __future__ import annotations

from typing import Any

import numpy as np

from sauna.experiments.share.graph import Graph, Node
from sauna.system.errors import BadInput

OPSET, IR_VERSION = 17, 8  # of 2022: what runs on a device is often older than what made the file


def to_onnx(graph: Graph, description: str) -> bytes:
    """Writes the model; the first axis of every input and output is the batch, of any size.

    Raises:
      BadInput: onnx is not installed.
    """
    try:
        from onnx import checker, helper, numpy_helper
    except ImportError as error:
        raise BadInput(f"onnx: {error}; pip install 'sauna-rl[onnx]'") from error

    shapes: list[Any] = []
    nodes = [_node(node, graph, shapes) for node in graph.nodes]
    nodes += [helper.make_node("Identity", [o.value], [o.name]) for o in graph.outputs]
    used = {name for node in nodes for name in node.input}
    constants = {**graph.constants, **dict(shapes)}
    model = helper.make_model(
        helper.make_graph(
            nodes,
            "policy",
            [_value(i.name, i.shape, i.dtype) for i in graph.inputs],
            [_value(o.name, o.shape, o.dtype) for o in graph.outputs],
            [numpy_helper.from_array(a, name) for name, a in constants.items() if name in used],
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="sauna",
        doc_string=description,
    )
    checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _value(name: str, shape: tuple[int, ...], dtype: str) -> Any:
    from onnx import helper

    kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    return helper.make_tensor_value_info(name, kind, ["batch", *shape])


def _node(node: Node, graph: Graph, shapes: list[Any]) -> Any:
    """ONNX's form of an operation; what it takes as further inputs is added to `shapes`."""
    from onnx import helper

    inputs, attributes = list(node.inputs), dict(node.attributes)

    def further(array: Any) -> None:
        name = f"{node.output}_{len(inputs)}"
        shapes.append((name, np.asarray(array, np.int64)))
        inputs.append(name)

    if node.op == "Cast":
        attributes["to"] = helper.np_dtype_to_tensor_dtype(np.dtype(attributes["to"]))
    elif node.op == "Reshape":
        further((-1, *attributes.pop("shape")))
    elif node.op == "Slice":
        for one in (attributes.pop("start"), attributes.pop("end"), -1):
            further([one])
    elif node.op == "Conv":
        stride, pad = attributes["stride"], attributes["pad"]
        attributes = {"strides": [stride] * 2, "pads": [pad] * 4}
    elif node.op == "MaxPool":
        pads = [*attributes["before"], 1, 1]
        attributes = {"kernel_shape": [3, 3], "strides": [2, 2], "pads": pads}
    elif node.op == "LayerNormalization":
        attributes["axis"] = -1
    elif node.op == "ArgMax":
        attributes = {"axis": -1, "keepdims": 1}
    elif node.op == "Concat":
        attributes["axis"] = -1
    return helper.make_node(node.op, inputs, [node.output], **attributes)
