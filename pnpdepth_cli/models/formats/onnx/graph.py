"""An ONNX graph as a torch module whose submodules are the graph's nodes, under their own names.

What depends on no input is computed once, here. Arithmetic on shapes is done in passing; every
other node is a submodule, so that the network can be cut at it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.formats.onnx.operators import OPERATORS, Node, Unsupported

_STANDARD = ("", "ai.onnx")
_TO_SHAPES = ("Shape", "Size")
_WHOLE = ("uint16", "uint32", "uint64", "int4", "uint4")
_HALF = ("float16", "bfloat16")


class OnnxNode(nn.Module):
    """One node with its constant inputs; called with the other inputs, in order."""

    def __init__(self, node: Node, inputs: Sequence[Tensor | str | None]) -> None:
        super().__init__()
        self.node = node
        self._run = OPERATORS[node.op]
        self._places: list[str | None] = []  # the constant at each place; "" for what is handed in
        for place, value in enumerate(inputs):
            self._places.append(None if value is None else "")
            if isinstance(value, Tensor):
                self._places[-1] = f"input{place}"
                if value.is_floating_point():
                    constant = nn.Parameter(value, requires_grad=False)
                    self.register_parameter(f"input{place}", constant)
                else:
                    self.register_buffer(f"input{place}", value)

    def forward(self, *handed_in: Tensor) -> Tensor | tuple[Tensor, ...]:
        rest = iter(handed_in)
        given: list[Any] = [
            None if place is None else getattr(self, place) if place else next(rest)
            for place in self._places
        ]
        try:
            return self._run(self.node, given)
        except Unsupported as error:
            raise ModelError(f"ONNX node {self.node.name!r}: {_not_covered(self.node, error)}")  # noqa: B904

    def extra_repr(self) -> str:
        return self.node.op


@dataclass(frozen=True)
class _Step:
    run: OnnxNode
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    done_with: tuple[str, ...]  # values that no later step reads
    on_shapes: bool


class OnnxGraph(nn.Module):
    """An ONNX model as a module: called with the graph's inputs, it returns its outputs.

    One output is a tensor, several are a dict by name. `float32` throughout: half precision
    weights and inputs are widened. ModelError names every operator that is not covered.
    """

    def __init__(self, model: Any, path: Path, outputs: Sequence[str] | None = None) -> None:
        super().__init__()
        graph = model.graph
        opset = max((o.version for o in model.opset_import if o.domain in _STANDARD), default=1)
        constants = {t.name: _tensor(t, path) for t in graph.initializer}
        self.input_names = tuple(i.name for i in graph.input if i.name not in constants)
        self.output_names = tuple(outputs or (o.name for o in graph.output))
        _check_operators(graph.node, path)
        nodes = list(zip(_names(graph.node), graph.node, strict=True))
        steps = self._steps_of(nodes, opset, constants, path)
        self._steps = _with_ends(steps, self.output_names)
        self._constants = {n: constants[n] for n in self.output_names if n in constants}
        for step in self._steps:
            if not step.on_shapes:
                # Not add_module, which refuses the dots that node names have.
                self._modules[step.run.node.name] = step.run

    def _steps_of(
        self, nodes: Iterable[tuple[str, Any]], opset: int, constants: dict[str, Tensor], path: Path
    ) -> list[_Step]:
        shapes: set[str] = set()
        steps = []
        for name, proto in nodes:
            attributes = {a.name: _attribute(a, path) for a in proto.attribute}
            wanted = [output for output in proto.output if output]
            node = Node(
                name=name, op=proto.op_type, opset=opset, outputs=len(wanted), attributes=attributes
            )
            inputs: list[Tensor | str] = [constants.get(n, n) for n in proto.input]
            made = OnnxNode(node, [None if isinstance(n, str) and not n else n for n in inputs])
            handed_in = tuple(n for n in inputs if isinstance(n, str) and n)
            if node.op == "QuantizeLinear" and handed_in:
                raise ModelError(f"ONNX file {path}: {_QUANTISED.format(name=name)}")
            if not handed_in:
                constants.update(_folded(made, proto.output, path))
                continue
            on_shapes = node.op in _TO_SHAPES or all(n in shapes for n in handed_in)
            if on_shapes:
                shapes.update(wanted)
            steps.append(_Step(made, handed_in, tuple(proto.output), (), on_shapes))
        return steps

    def forward(self, *inputs: Tensor) -> Any:
        values: dict[str, Tensor] = dict(zip(self.input_names, inputs, strict=True))
        device = inputs[0].device
        for step in self._steps:
            given = [values[name] for name in step.inputs]
            if not step.on_shapes:
                given = [value.to(device) for value in given]
            result = step.run(*given)
            made = result if isinstance(result, tuple) else (result,)
            values.update(zip(step.outputs, made, strict=False))
            for name in step.done_with:
                del values[name]
        found = {n: values[n] if n in values else self._constants[n] for n in self.output_names}
        return found if len(found) > 1 else found[self.output_names[0]]

    def every_value(self, *inputs: Tensor) -> Iterable[tuple[str, str, Tensor]]:
        """(node, value's name, value) of all nodes in the order in which they run."""
        values: dict[str, Tensor] = dict(zip(self.input_names, inputs, strict=True))
        for step in self._steps:
            result = step.run(*(values[name] for name in step.inputs))
            made = result if isinstance(result, tuple) else (result,)
            values.update(zip(step.outputs, made, strict=False))
            for name, value in zip(step.outputs, made, strict=False):
                yield step.run.node.name, name, value


_QUANTISED = (
    "node {name!r} (QuantizeLinear) rounds what flows through the network, which has no gradient;"
    " use the file with float weights, or one where only weights are quantised"
)


def _folded(made: OnnxNode, outputs: Sequence[str], path: Path) -> dict[str, Tensor]:
    try:
        with torch.no_grad():
            result = made()
    except Unsupported as error:
        raise ModelError(f"ONNX file {path}: {_not_covered(made.node, error)}") from None
    return dict(zip(outputs, result if isinstance(result, tuple) else (result,), strict=False))


def _with_ends(steps: list[_Step], outputs: Sequence[str]) -> list[_Step]:
    """The steps that the outputs need, each with the values nobody reads after it."""
    needed, kept = set(outputs), []
    for step in reversed(steps):
        if needed.intersection(step.outputs):
            # Read for the first time from behind: nothing later wants it.
            last = {n for n in step.inputs if n not in needed}
            unread = {n for n in step.outputs if n and n not in needed}
            needed.update(step.inputs)
            ends = tuple(sorted(last | unread))
            kept.append(_Step(step.run, step.inputs, step.outputs, ends, step.on_shapes))
    return kept[::-1]


def _check_operators(nodes: Iterable[Any], path: Path) -> None:
    unknown: Counter[str] = Counter()
    for proto in nodes:
        standard = proto.domain in _STANDARD
        if not standard or proto.op_type not in {*OPERATORS, "QuantizeLinear"}:
            unknown[proto.op_type if standard else f"{proto.domain}.{proto.op_type}"] += 1
    if unknown:
        named = ", ".join(f"{op} ({count} ×)" for op, count in unknown.items())
        raise ModelError(
            f"ONNX file {path} uses operators that are not covered: {named}; export the network"
            " with others, or bring it as a Python file"
        )


def _names(nodes: Iterable[Any]) -> list[str]:
    """The nodes' names, fit to be named with --layer; operator and output where a node has none."""
    names: list[str] = []
    taken: Counter[str] = Counter()
    for proto in nodes:
        first = next((output for output in proto.output if output), "")
        name = proto.name or f"{proto.op_type}_{first}"
        if name.replace(".", "").isdigit():
            name = f"{proto.op_type}_{name}"
        name = name.translate(str.maketrans("#[]", "___"))
        taken[name] += 1
        names.append(name if taken[name] == 1 else f"{name}_{taken[name]}")
    return names


def _attribute(proto: Any, path: Path) -> Any:
    from onnx import AttributeProto, helper

    if proto.type == AttributeProto.TENSOR:
        return _tensor(proto.t, path)
    if proto.type in (AttributeProto.GRAPH, AttributeProto.GRAPHS):
        return None  # only operators that are refused have one
    value = helper.get_attribute_value(proto)
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return list(value) if proto.type in (AttributeProto.INTS, AttributeProto.FLOATS) else value


def _tensor(proto: Any, path: Path) -> Tensor:
    from onnx import numpy_helper

    try:
        array = numpy_helper.to_array(proto)
        kind = array.dtype.name
        if kind in _HALF:
            array = array.astype("float32")
        elif kind in _WHOLE:
            array = array.astype("int64")
        return torch.tensor(array)
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        raise ModelError(
            f"ONNX file {path}: tensor {proto.name!r} cannot be read ({error})"
        ) from None


def _not_covered(node: Node, error: Unsupported) -> str:
    return f"{node.op} with {error} is not covered"
