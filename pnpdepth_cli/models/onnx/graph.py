"""An ONNX graph as a torch module whose submodules are the graph's nodes, under their own names.

What depends on no input is computed once, when the module is made. Arithmetic on shapes is no
layer; every other node is a submodule, so that the network can be cut at it.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.fx.node import Argument

from pnpdepth_cli.errors import ModelError, wrap_user_errors
from pnpdepth_cli.models.file_graph import FileGraph, Operation, SizeLimit, Unsupported
from pnpdepth_cli.models.onnx import layers  # noqa: F401  (it registers its operators)
from pnpdepth_cli.models.onnx.operators import HOST_INPUTS, ONLY, OPERATORS, Node

if TYPE_CHECKING:
    from onnx import AttributeProto, ModelProto, NodeProto, TensorProto

_STANDARD = ("", "ai.onnx")
_TO_SHAPES = ("Shape", "Size")
_CONSTANT_ELEMENTS, _CONSTANT_GROWTH, _CONSTANTS = 1 << 24, 4, 4
"""One computed constant may have so many elements, or so many times those stored in the file; all
of them together so many times as many as one."""

_WORK = 1 << 32
"""Elements that may be read, and products summed, for all computed constants: seconds."""


def onnx_graph(model: ModelProto, path: Path) -> FileGraph:
    """Returns an ONNX model as a module: called with the graph's inputs, it returns its output.

    Args:
        model: The onnx.ModelProto with one output, its nodes in order.
        path: File of the model, for messages.

    Raises:
        ModelError: An operator is not covered; the message names every one.
    """
    _check_operators(model.graph.node, path)
    graph, opset = FileGraph(), opset_of(model)
    constants = {tensor.name: _tensor(tensor, path) for tensor in model.graph.initializer}
    stored = sum(constant.numel() for constant in constants.values())
    largest = max(_CONSTANT_ELEMENTS, _CONSTANT_GROWTH * stored)
    limit = SizeLimit(largest, in_all=_CONSTANTS * largest, work=_WORK)
    for value in model.graph.input:
        if value.name not in constants:
            graph.add_input(value.name)
    shapes = set[str]()
    for name, proto in zip(_names(model.graph.node), model.graph.node, strict=True):
        # The operator and its inputs, of which one may be left out.
        attributes = {a.name: _attribute(a, path) for a in proto.attribute}
        used = sum(bool(output) for output in proto.output)
        node = Node(op=proto.op_type, opset=opset, outputs=used, attributes=attributes)
        title = f"ONNX file {path}: node {name!r}: {node.op}"
        operation = Operation(title, functools.partial(_compute, node))
        handed_in = [n for n in proto.input if n and n not in constants]
        if not graph.values.keys() >= {*handed_in}:
            raise ModelError(f"{title} reads a value that nothing before it gives")
        # What only constants go into is computed now.
        if not handed_in:
            with torch.no_grad(), limit, wrap_user_errors(title):
                result = operation(*map(constants.get, proto.input))
            results = result if isinstance(result, tuple) else (result,)
            constants.update(zip(proto.output, results, strict=False))
            continue
        on_shapes = node.op in _TO_SHAPES or shapes.issuperset(handed_in)
        shapes.update(filter(None, proto.output if on_shapes else ()))
        # Constants become weights, but for those that stay on the CPU.
        inputs: list[Argument] = []
        for index, n in enumerate(proto.input):
            if n in constants and (on_shapes or index in HOST_INPUTS[node.op]):
                inputs.append(constants[n])
            elif n in constants and n not in graph.values:
                inputs.append(graph.add_tensor(n, constants[n]))
            else:
                inputs.append(graph.values.get(n))
        outputs = proto.output if node.op == "Split" else proto.output[0]
        graph.add_operation(name, operation, inputs, {}, outputs, is_layer=not on_shapes)
    output = model.graph.output[0].name
    if output in constants:
        raise ModelError(f"ONNX file {path}: its output depends on no input")
    graph.set_outputs([output])
    return graph


def _compute(node: Node, *inputs: Tensor | None) -> Tensor | tuple[Tensor, ...]:
    """The node's outputs. Arithmetic on shapes stays on the CPU."""
    if node.outputs > 1 and node.op != "Split":
        raise Unsupported("more than its first output")
    for name, only in ONLY.items():
        if node.get(name, only) != only:
            raise Unsupported(f"{name} {node.get(name)!r}")
    devices = [value.device for value in inputs if value is not None and not value.is_cpu]
    moved: list[Any] = []
    for index, value in enumerate(inputs):
        device = "cpu" if index in HOST_INPUTS[node.op] or not devices else devices[0]
        moved.append(value if value is None else value.to(device))
    return OPERATORS[node.op](node, moved)


def opset_of(model: ModelProto) -> int:
    """Returns the version of the standard's operators."""
    return max((o.version for o in model.opset_import if o.domain in _STANDARD), default=1)


def _check_operators(nodes: Sequence[NodeProto], path: Path) -> None:
    unknown: Counter[str] = Counter()
    for proto in nodes:
        standard = proto.domain in _STANDARD
        if not standard or proto.op_type not in OPERATORS:
            unknown[proto.op_type if standard else f"{proto.domain}.{proto.op_type}"] += 1
    if unknown:
        listed = ", ".join(f"{op} ({count} ×)" for op, count in unknown.items())
        raise ModelError(
            f"ONNX file {path} uses operators that are not covered: {listed}; export the network"
            " with others, or bring it as a Python file"
        )


def _names(nodes: Iterable[NodeProto]) -> list[str]:
    """Names of the nodes for --layer; a node without a name has operator and output."""
    names: list[str] = []
    for proto in nodes:
        first = next((output for output in proto.output if output), "")
        name = proto.name or f"{proto.op_type}_{first}"
        if name.replace(".", "").isdigit():
            name = f"{proto.op_type}_{name}"
        names.append(name.translate(str.maketrans("#[]", "___")))
    return names


def _attribute(proto: AttributeProto, path: Path) -> object:
    from onnx import AttributeProto, helper

    if proto.type == AttributeProto.TENSOR:
        return _tensor(proto.t, path)
    value = helper.get_attribute_value(proto)
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return list(value) if proto.type in (AttributeProto.INTS, AttributeProto.FLOATS) else value


def _tensor(proto: TensorProto, path: Path) -> Tensor:
    from onnx import numpy_helper

    if proto.data_type in (proto.FLOAT16, proto.BFLOAT16):
        raise ModelError(f"ONNX file {path} is in half precision; export the network in float32")
    try:
        return torch.tensor(numpy_helper.to_array(proto))
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        raise ModelError(
            f"ONNX file {path}: tensor {proto.name!r} cannot be read ({error})"
        ) from None
