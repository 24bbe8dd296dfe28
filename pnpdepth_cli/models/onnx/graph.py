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
from torch import Tensor, nn

from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.onnx import (  # noqa: F401  (each file registers its operators)
    HOST_INPUTS,
    ONLY,
    OPERATORS,
    Node,
    layers,
    operators,
)
from pnpdepth_cli.models.steps import SizeLimit, Step, Steps, Unsupported, Value, hold

if TYPE_CHECKING:
    from onnx import AttributeProto, ModelProto, NodeProto, TensorProto

_STANDARD = ("", "ai.onnx")
_TO_SHAPES = ("Shape", "Size")
_MODULE_ATTRIBUTES = frozenset(vars(nn.Module()))
"""Such as `training`, which torch itself sets; no submodule can have such a name."""

_CONSTANT_ELEMENTS, _CONSTANT_GROWTH, _CONSTANTS = 1 << 24, 4, 4
"""One computed constant may have so many elements, or so many times those stored in the file; all
of them together so many times as many as one."""

_WORK = 1 << 32
"""Elements that may be read, and products summed, for all computed constants: seconds."""


class OnnxNode(nn.Module):
    """One node with its constant inputs; called with the other inputs, in order.

    Args:
        node: Operator and attributes.
        inputs: Constants of its inputs, "" or any text for one that the call gives, None for one
            that is left out.
    """

    def __init__(self, node: Node, inputs: Sequence[Tensor | str | None]) -> None:
        super().__init__()
        self.node = node
        host = HOST_INPUTS.get(node.op, ())
        # Of each input the constant itself if it stays on the CPU, else the name of its buffer;
        # "" if the call gives it, None if it is left out.
        self._inputs: list[Tensor | str | None] = []
        for index, value in enumerate(inputs):
            name = f"input{index}"
            if not isinstance(value, Tensor):
                self._inputs.append(None if value is None else "")
            elif index in host:
                self._inputs.append(value)
            else:
                self._inputs.append(name)
                hold(self, name, value)
        self.handed_in_on_host = tuple(
            index in host for index, value in enumerate(self._inputs) if value == ""
        )

    def forward(self, *handed_in: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Returns the node's output, or its outputs."""
        rest = iter(handed_in)
        inputs: list[Any] = [
            value if not isinstance(value, str) else getattr(self, value) if value else next(rest)
            for value in self._inputs
        ]
        try:
            _check_covered(self.node)
            return OPERATORS[self.node.op](self.node, inputs)
        except Unsupported as error:
            reason = f"{self.node.op} with {error} is not covered"
            raise ModelError(f"ONNX node {self.node.name!r}: {reason}") from None


class OnnxGraph(nn.Module):
    """An ONNX model as a module: called with the graph's inputs, it returns its output.

    Args:
        model: The onnx.ModelProto with one output, its nodes in order.
        path: File of the model, for messages.

    Raises:
        ModelError: An operator is not covered; the message names every one.
    """

    def __init__(self, model: ModelProto, path: Path) -> None:
        super().__init__()
        graph = model.graph
        _check_operators(graph.node, path)
        opset = max((o.version for o in model.opset_import if o.domain in _STANDARD), default=1)
        constants = {t.name: _tensor(t, path) for t in graph.initializer}
        self.input_names = tuple(i.name for i in graph.input if i.name not in constants)
        (self.output_name,) = (output.name for output in graph.output)
        self._stored = sum(constant.numel() for constant in constants.values())
        nodes = zip(_names(graph.node), graph.node, strict=True)
        self._steps = Steps(
            self._steps_of(nodes, opset, constants, path), [self.output_name],
            kind="ONNX node", stored=self._stored,
        )  # fmt: skip
        if self.output_name in constants:
            raise ModelError(f"ONNX file {path}: its output depends on no input")

    def _steps_of(
        self,
        nodes: Iterable[tuple[str, NodeProto]],
        opset: int,
        constants: dict[str, Tensor],
        path: Path,
    ) -> list[Step]:
        shapes, given = set[str](), {*self.input_names}
        steps = []
        largest = max(_CONSTANT_ELEMENTS, _CONSTANT_GROWTH * self._stored)
        limit = SizeLimit(largest, in_all=_CONSTANTS * largest, work=_WORK)
        for name, proto in nodes:
            attributes = {a.name: _attribute(a, path) for a in proto.attribute}
            used = sum(bool(output) for output in proto.output)
            node = Node(
                name=name, op=proto.op_type, opset=opset, outputs=used, attributes=attributes
            )
            inputs: list[Tensor | str] = [constants.get(n, n) for n in proto.input]
            module = OnnxNode(node, [None if isinstance(n, str) and not n else n for n in inputs])
            handed_in = tuple(n for n in inputs if isinstance(n, str) and n)
            if not given.issuperset(handed_in):
                raise ModelError(
                    f"ONNX file {path}: node {name!r} reads a value that nothing before it gives"
                )
            given.update(proto.output)
            if not handed_in:
                constants.update(_fold(module, proto.output, limit, path))
                continue
            on_shapes = node.op in _TO_SHAPES or all(n in shapes for n in handed_in)
            if on_shapes:
                shapes.update(filter(None, proto.output))
            else:
                # Not add_module, which refuses the dots that node names have.
                self._modules[name] = module
            steps.append(
                Step(
                    run=functools.partial(self._run, module, on_shapes),
                    arguments=[Value(n) for n in handed_in],
                    outputs=proto.output,
                    name=name,
                )
            )
        return steps

    def forward(self, *inputs: Tensor) -> Tensor:
        """Returns the output."""
        values: dict[str, object] = dict(zip(self.input_names, inputs, strict=True))
        self._device = inputs[0].device
        self._steps.run(values, tuple(one.shape for one in inputs))
        output = values[self.output_name]
        assert isinstance(output, Tensor)
        return output

    def _run(self, module: OnnxNode, on_shapes: bool, *inputs: Tensor) -> Sequence[Tensor]:
        """The node's outputs. Arithmetic on shapes stays on the CPU."""
        if not on_shapes:
            inputs = tuple(
                value.to("cpu" if on_host else self._device)
                for value, on_host in zip(inputs, module.handed_in_on_host, strict=True)
            )
        result = module(*inputs)
        return result if isinstance(result, tuple) else (result,)


def _fold(
    module: OnnxNode, outputs: Sequence[str], limit: SizeLimit, path: Path
) -> dict[str, Tensor]:
    """The outputs of a node that has only constant inputs."""
    try:
        with torch.no_grad(), limit:
            result = module()
    except ModelError as error:
        raise ModelError(f"ONNX file {path}: {error}") from None
    except (RuntimeError, ValueError, TypeError, IndexError, OverflowError) as error:
        raise ModelError(
            f"ONNX file {path}: node {module.node.name!r} ({module.node.op}) cannot be computed:"
            f" {describe(error)[:160]}"
        ) from None
    return dict(zip(outputs, result if isinstance(result, tuple) else (result,), strict=False))


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


def _check_covered(node: Node) -> None:
    """Unsupported for an attribute or an output that the functions of operators do not know."""
    if node.outputs > 1 and node.op != "Split":
        raise Unsupported("more than its first output")
    for name, only in ONLY.items():
        if node.get(name, only) != only:
            raise Unsupported(f"{name} {node.get(name)!r}")


def _names(nodes: Iterable[NodeProto]) -> list[str]:
    """Unique names of the nodes for --layer; a node without a name has operator and output."""
    names: list[str] = []
    taken: Counter[str] = Counter()
    for proto in nodes:
        first = next((output for output in proto.output if output), "")
        name = proto.name or f"{proto.op_type}_{first}"
        if name.replace(".", "").isdigit():
            name = f"{proto.op_type}_{name}"
        name = name.translate(str.maketrans("#[]", "___"))
        name = f"{name}_" if name in _MODULE_ATTRIBUTES else name
        taken[name] += 1
        names.append(name if taken[name] == 1 else f"{name}_{taken[name]}")
    return names


def _attribute(proto: AttributeProto, path: Path) -> Any:
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
