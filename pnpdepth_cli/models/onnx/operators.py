"""The table of ONNX operators that depth networks use; here those on tensors of any rank.

The functions register themselves with `@operator`, each as the standard defines it
(https://onnx.ai/onnx/operators). Every version of an operator from opset 7 on is covered: an
attribute that later became an input is read as either.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.errors import ModelError

Inputs = list[Tensor]
"""The inputs of a node in order; `optional` reads those that may be absent or None."""

Operator = Callable[["Node", Inputs], "Tensor | tuple[Tensor, ...]"]
"""Function from a node and its inputs to its first output; of Split, to all."""

OPERATORS: dict[str, Operator] = {}
"""Functions by the name of the operator in the standard."""

HOST_INPUTS: dict[str, tuple[int, ...]] = {}
"""Indices of an operator's inputs that are read as Python numbers; they stay on the CPU."""

ONLY: dict[str, int | str] = {
    "antialias": 0, "batch_dims": 0, "exclude_outside": 0, "noop_with_empty_axes": 0,
    "detect_negative": 1, "detect_positive": 1, "keep_aspect_ratio_policy": "stretch",
    "reduction": "none", "training_mode": 0,
}  # fmt: skip
"""Attributes that must have this value, the standard's default, if they are there."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """A node of the graph, without its inputs."""

    op: str
    """Name of the operator."""
    opset: int
    """Version of the standard."""
    outputs: int = 1
    """Number of the outputs that are used."""
    attributes: Mapping[str, object] = field(default_factory=dict)

    def get(self, name: str, default: Any = None) -> Any:
        """Returns the value of an attribute; `default`, the standard's, if the node lacks it."""
        return self.attributes.get(name, default)


def operator(*names: str, host_inputs: tuple[int, ...] = ()) -> Callable[[Operator], Operator]:
    """Returns a decorator that enters a function as that of these operators.

    Args:
        *names: Names of the operators.
        host_inputs: Indices of the inputs that are read as Python numbers, as in `HOST_INPUTS`.
    """

    def enter(function: Operator) -> Operator:
        """Enters the function in both tables, and returns it as it is."""
        for name in names:
            OPERATORS[name] = function
            HOST_INPUTS[name] = host_inputs
        return function

    return enter


def register(functions: Mapping[str, Operator], host_inputs: tuple[int, ...] = ()) -> None:
    """Enters functions as those of operators, as the decorator `operator` does for one.

    Args:
        functions: Functions by the name of the operator.
        host_inputs: Indices of the inputs that are read as Python numbers, as in `HOST_INPUTS`.
    """
    for name, function in functions.items():
        operator(name, host_inputs=host_inputs)(function)


def optional(inputs: Inputs, index: int) -> Tensor | None:
    """Returns an input by its index; None if it is left out."""
    return inputs[index] if index < len(inputs) else None


def whole_numbers(values: Tensor) -> list[int]:
    """Returns the elements of an integer tensor as Python numbers."""
    return [int(value) for value in values.reshape(-1).tolist()]


def numbers_of(node: Node, name: str, inputs: Inputs, index: int) -> list[int]:
    """Returns whole numbers that are an attribute, or from a later version on an input.

    Args:
        node: The node.
        name: Name of the attribute.
        inputs: Inputs of the node.
        index: Index of the input that later took its place.

    Returns:
        The numbers; empty if the node has neither.
    """
    if name not in node.attributes and optional(inputs, index) is not None:
        return whole_numbers(inputs[index])
    numbers: list[int] = node.get(name, [])
    return numbers


_SAME_NAME = (
    "Relu",
    "Sigmoid",
    "Tanh",
    "Erf",
    "Exp",
    "Log",
    "Sqrt",
    "Reciprocal",
    "Abs",
    "Neg",
    "Floor",
    "Ceil",
    "Round",
    "Sign",
    "Sin",
    "Cos",
    "IsNaN",
    "IsInf",
    "Softplus",
    "HardSwish",
    "Mish",
    "Add",
    "Sub",
    "Mul",
    "Greater",
    "Less",
    "MatMul",
    "Where",
)
"""Named as in torch, but for capitals."""


def _function_named(name: str) -> Callable[..., Tensor]:
    """Returns the function of torch, or else of torch.nn.functional, of this name in lower case."""
    function: Callable[..., Tensor] | None = getattr(torch, name.lower(), None)
    if function is None:
        function = getattr(F, name.lower())
    return function


def _divide(dividend: Tensor, divisor: Tensor) -> Tensor:
    """Returns the quotient, of whole numbers rounded towards 0."""
    if dividend.is_floating_point():
        return dividend / divisor
    return torch.div(dividend, divisor, rounding_mode="trunc")


_PLAIN: dict[str, Callable[..., Tensor]] = {
    **{name: _function_named(name) for name in _SAME_NAME},
    "Equal": torch.eq, "GreaterOrEqual": torch.ge, "LessOrEqual": torch.le, "Div": _divide,
    "And": torch.logical_and, "Or": torch.logical_or, "Not": torch.logical_not,
    "Identity": torch.clone, "Dropout": lambda x, *_: x.clone(),
    "PRelu": lambda x, slope: torch.where(x < 0, x * slope, x),
    "Pow": lambda base, exponent: torch.pow(base, exponent).to(base.dtype),
    "Max": lambda *inputs: functools.reduce(torch.maximum, inputs),
    "Min": lambda *inputs: functools.reduce(torch.minimum, inputs),
    "Sum": lambda *inputs: functools.reduce(torch.add, inputs),
}  # fmt: skip
"""Functions of the inputs alone."""


def _without_node(function: Callable[..., Tensor]) -> Operator:
    """Returns a function of the inputs alone as one of node and inputs."""
    return lambda _, inputs: function(*inputs)


register({name: _without_node(function) for name, function in _PLAIN.items()})
register(
    {
        "Mod": lambda node, i: (torch.fmod if node.get("fmod", 0) else torch.remainder)(i[0], i[1]),
        "LeakyRelu": lambda node, i: F.leaky_relu(i[0], node.get("alpha", 0.01)),
        "Elu": lambda node, i: F.elu(i[0], node.get("alpha", 1.0)),
        "Einsum": lambda node, i: torch.einsum(node.get("equation"), *i),
        "HardSigmoid": lambda node, i: torch.add(
            torch.mul(i[0], node.get("alpha", 0.2)), node.get("beta", 0.5)
        ).clamp(0, 1),
        "Gelu": lambda node, i: F.gelu(i[0], approximate=node.get("approximate", "none")),
    }
)


@operator("Clip")
def clip(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input within limits, which are inputs from opset 11 on, each or none."""
    has_limits_as_inputs = node.opset >= 11
    low = optional(inputs, 1) if has_limits_as_inputs else node.get("min")
    high = optional(inputs, 2) if has_limits_as_inputs else node.get("max")
    if low is None and high is None:
        return inputs[0]
    return torch.clamp(inputs[0], low, high)


@operator("Softmax", "LogSoftmax")
def softmax(node: Node, inputs: Inputs) -> Tensor:
    """Returns the softmax, or its logarithm, over an axis.

    Before opset 13, it is over that axis and all behind it, as if they were one.
    """
    x = inputs[0]
    function = torch.softmax if node.op == "Softmax" else torch.log_softmax
    if node.opset >= 13:
        return function(x, node.get("axis", -1))
    axis = node.get("axis", 1) % x.ndim
    return function(x.flatten(axis), axis).reshape(x.shape)


@operator("Gemm")
def gemm(node: Node, inputs: Inputs) -> Tensor:
    """Returns α·A·B + β·C, the letters of the standard; A and B may have to be transposed first."""
    a = inputs[0]
    b = inputs[1]
    c = optional(inputs, 2)
    a = a.T if node.get("transA", 0) else a
    b = b.T if node.get("transB", 0) else b
    product: Tensor = node.get("alpha", 1.0) * (a @ b)
    return product if c is None else product + node.get("beta", 1.0) * c


def _product(x: Tensor, axes: list[int], keep: bool) -> Tensor:
    """Returns the product over the axes, which torch takes one at a time."""
    # From the last one, so that axes before it keep their numbers.
    for axis in sorted((axis % x.ndim for axis in axes), reverse=True):
        x = x.prod(axis, keepdim=keep, dtype=x.dtype)
    return x


_REDUCTIONS: dict[str, Callable[[Tensor, list[int], bool], Tensor]] = {
    "ReduceMean": lambda x, axes, keep: x.mean(axes, keepdim=keep),
    "ReduceSum": lambda x, axes, keep: x.sum(axes, keepdim=keep, dtype=x.dtype),
    "ReduceMax": lambda x, axes, keep: x.amax(axes, keepdim=keep),
    "ReduceMin": lambda x, axes, keep: x.amin(axes, keepdim=keep),
    "ReduceL2": lambda x, axes, keep: x.square().sum(axes, keepdim=keep).sqrt(),
    "ReduceProd": _product,
}
"""Functions of a tensor, the axes, and whether these stay as axes of length 1."""


@operator(*_REDUCTIONS, host_inputs=(1,))
def reduce(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input reduced over the stated axes, or over all."""
    axes = numbers_of(node, "axes", inputs, 1) or list(range(inputs[0].ndim))
    return _REDUCTIONS[node.op](inputs[0], axes, bool(node.get("keepdims", 1)))


# ------------------------------------------------------------------ shapes and parts

TYPES = {
    1: torch.float32, 2: torch.uint8, 3: torch.int8, 5: torch.int16, 6: torch.int32,
    7: torch.int64, 9: torch.bool, 11: torch.float64,
}  # fmt: skip
"""Types of elements by the number in TensorProto.DataType."""


register(
    {
        "Shape": lambda node, i: torch.tensor(
            i[0].shape[node.get("start", 0) : node.get("end")], dtype=torch.int64
        ),
        "Transpose": lambda node, i: i[0].permute(node.get("perm", [*range(i[0].ndim)][::-1])),
        "Concat": lambda node, i: torch.cat(i, node.get("axis", 1)),
        "Flatten": lambda node, i: i[0].reshape(math.prod(i[0].shape[: node.get("axis", 1)]), -1),
        "GatherND": lambda _, i: i[0][tuple(i[1].long().unbind(-1))],
        "ScatterND": lambda _, i: i[0].index_put(tuple(i[1].long().unbind(-1)), i[2]),
        "GatherElements": lambda node, i: i[0].gather(
            node.get("axis", 0), _from_start(i[1], i[0].shape[node.get("axis", 0)])
        ),
    }
)
register(
    {
        "Tile": lambda _, i: i[0].repeat(whole_numbers(i[1])),
        "Expand": lambda _, i: i[0].expand(torch.broadcast_shapes(i[0].shape, whole_numbers(i[1]))),  # type: ignore[no-untyped-call]
        "Squeeze": lambda node, i: i[0].squeeze(
            numbers_of(node, "axes", i, 1) or [*range(i[0].ndim)]
        ),
    },
    host_inputs=(1,),
)


@operator("Reshape", host_inputs=(1,))
def reshape(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input in a shape in which one side may be −1, and 0 stands for its own side."""
    x = inputs[0]
    shape = numbers_of(node, "shape", inputs, 1)
    if not node.get("allowzero", 0):
        shape = [x.shape[axis] if side == 0 else side for axis, side in enumerate(shape)]
    return x.reshape(shape)


@operator("Unsqueeze", host_inputs=(1,))
def unsqueeze(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input with axes of length 1, which have these numbers in the result."""
    x = inputs[0]
    axes = numbers_of(node, "axes", inputs, 1)
    rank = x.ndim + len(axes)
    for axis in sorted(axis % rank for axis in axes):
        x = x.unsqueeze(axis)
    return x


@operator("Split", host_inputs=(1,))
def split(node: Node, inputs: Inputs) -> tuple[Tensor, ...]:
    """Returns the input in parts of stated lengths along an axis, or in equal ones."""
    x = inputs[0]
    axis = node.get("axis", 0)
    equal_length = math.ceil(x.shape[axis] / node.get("num_outputs", node.outputs))
    return torch.split(x, numbers_of(node, "split", inputs, 1) or equal_length, axis)


_PAD_MODES = {"edge": "replicate", "reflect": "reflect"}
"""Modes of torch's pad by the standard's."""


@operator("Pad", host_inputs=(1, 2))
def pad(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input with elements added at both ends of its axes, or cut off where negative.

    Raises:
        ModelError: Only some axes are named, or elements are copied along others than the last two.
    """
    x = inputs[0]
    mode = node.get("mode", "constant")
    if optional(inputs, 3) is not None:
        raise ModelError("axes")
    # The standard has the beginnings of all axes, then their ends. torch has both of the last axis,
    # then of the one before.
    numbers = numbers_of(node, "pads", inputs, 1)
    pairs = list(zip(numbers[: x.ndim], numbers[x.ndim :], strict=True))
    last_first = [number for pair in reversed(pairs) for number in pair]
    if mode == "constant":
        value = node.get("value", 0.0) if optional(inputs, 2) is None else inputs[2].item()
        return F.pad(x, last_first, value=value)
    # torch copies elements only behind axes of batch and channels, which must stay as they are.
    if mode not in _PAD_MODES or x.ndim < 3 or any(last_first[-4:]):
        raise ModelError(f"mode {mode} of {x.ndim} axes")
    return F.pad(x, last_first[:-4], _PAD_MODES[mode])


@operator("DepthToSpace")
def depth_to_space(node: Node, inputs: Inputs) -> Tensor:
    """Returns (b, c·side², h, w) as (b, c, h·side, w·side), each pixel's channels as a block."""
    x = inputs[0]
    side = node.get("blocksize")
    if node.get("mode", "DCR") == "DCR":  # torch has the channels of a block the other way round
        blocks = x.reshape(x.shape[0], side**2, -1, *x.shape[2:])
        x = blocks.transpose(1, 2).reshape(x.shape)
    return F.pixel_shuffle(x, side)


@operator("Cast")
def cast(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input in another type. Raises ModelError if that is not covered."""
    kind = node.get("to")
    if kind not in TYPES:
        raise ModelError(f"data type {kind}")
    return inputs[0].to(TYPES[kind])


@operator("Constant")
def constant(node: Node, inputs: Inputs) -> Tensor:
    """Returns the node's only attribute, whatever its name, as a tensor."""
    (value,) = node.attributes.values()
    return torch.as_tensor(value)


@operator("ConstantOfShape", host_inputs=(0,))
def constant_of_shape(node: Node, inputs: Inputs) -> Tensor:
    """Returns a tensor whose shape is the input, filled with one value, by default 0."""
    value: Tensor = node.get("value", torch.zeros(1))
    return value.reshape(()).expand(whole_numbers(inputs[0])).clone()


@operator("Range", host_inputs=(0, 1, 2))
def number_range(node: Node, inputs: Inputs) -> Tensor:
    """Returns the numbers (n,) from a start to below a limit, with a step: the three inputs."""
    start, limit, delta = (number.reshape(()).item() for number in inputs)
    return torch.arange(start, limit, delta, dtype=inputs[0].dtype, device=inputs[0].device)


@operator("Slice", host_inputs=(1, 2, 3, 4))
def slice_(node: Node, inputs: Inputs) -> Tensor:
    """Returns a part of the input: from start to end with a step, along each of some axes."""
    x = inputs[0]
    starts = numbers_of(node, "starts", inputs, 1)
    ends = numbers_of(node, "ends", inputs, 2)
    axes = numbers_of(node, "axes", inputs, 3) or list(range(len(starts)))
    steps = numbers_of(node, "steps", inputs, 4) or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        size = x.shape[axis]
        # With a negative step, an end before the first element includes that element.
        includes_first = step < 0 and end < -size
        kept = range(*slice(start, None if includes_first else end, step).indices(size))
        if step > 0:
            axes_before = (slice(None),) * (axis % x.ndim)
            x = x[(*axes_before, slice(kept.start, kept.stop, step))]
        else:
            # torch's own slices have no negative step.
            x = x.index_select(axis, torch.tensor(list(kept), dtype=torch.long, device=x.device))
    return x


@operator("Gather")
def gather(node: Node, inputs: Inputs) -> Tensor:
    """Returns entries of the input along an axis, chosen by an index of any shape.

    The axes of the index take the place of that axis.
    """
    x = inputs[0]
    axis = node.get("axis", 0) % x.ndim
    index = _from_start(inputs[1], x.shape[axis])
    picked = x.index_select(axis, index.reshape(-1).to(x.device))
    return picked.reshape((*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]))


def _from_start(index: Tensor, size: int) -> Tensor:
    """Returns an index in 0…size − 1, of one whose negative elements count from the end."""
    return torch.where(index < 0, index + size, index).long()
