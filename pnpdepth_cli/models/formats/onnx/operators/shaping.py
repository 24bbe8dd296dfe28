"""Operators that change the shape, type or order of elements, or make constants."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.formats.onnx.operators.table import (
    Inputs,
    Node,
    Unsupported,
    operator,
    optional,
    register,
    whole_numbers,
)

TYPES = {
    1: torch.float32, 2: torch.uint8, 3: torch.int8, 5: torch.int16, 6: torch.int32,
    7: torch.int64, 9: torch.bool, 10: torch.float32, 11: torch.float64, 16: torch.float32,
}  # fmt: skip
"""TensorProto.DataType; half precision is computed in float32."""


def _axes(node: Node, inputs: Inputs) -> list[int] | None:
    axes = node.get("axes")
    if axes is None and optional(inputs, 1) is not None:
        axes = whole_numbers(inputs[1])
    return None if axes is None else list(axes)


register(
    {
        "Shape": lambda node, i: torch.tensor(
            i[0].shape[node.get("start", 0) : node.get("end")], dtype=torch.int64
        ),
        "Size": lambda _, i: torch.tensor(i[0].numel()),
        "Transpose": lambda node, i: i[0].permute(node.get("perm", [*range(i[0].ndim)][::-1])),
        "Concat": lambda node, i: torch.cat(i, node.get("axis", 1)),
        "CastLike": lambda _, i: i[0].to(i[1].dtype),
        "Dropout": lambda _, i: i[0].clone(),
    }
)
register(
    {
        "Tile": lambda _, i: i[0].repeat(whole_numbers(i[1])),
        "Squeeze": lambda node, i: i[0].squeeze(_axes(node, i) or [*range(i[0].ndim)]),
        "Trilu": lambda node, i: (torch.triu if node.get("upper", 1) else torch.tril)(
            i[0], 0 if optional(i, 1) is None else whole_numbers(i[1])[0]
        ),
    },
    host=(1,),
)


@operator("Reshape", host=(1,))
def reshape(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    wanted = node.get("shape") if len(inputs) < 2 else whole_numbers(inputs[1])
    if not node.get("allowzero", 0):
        wanted = [x.shape[i] if n == 0 else n for i, n in enumerate(wanted)]
    return x.reshape(wanted)


@operator("Flatten")
def flatten(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    axis = node.get("axis", 1)
    axis = axis + x.ndim if axis < 0 else axis
    return x.reshape(math.prod(x.shape[:axis]), -1)


@operator("Unsqueeze", host=(1,))
def unsqueeze(node: Node, inputs: Inputs) -> Tensor:
    x, axes = inputs[0], _axes(node, inputs)
    assert axes is not None
    rank = x.ndim + len(axes)
    for axis in sorted(a % rank for a in axes):
        x = x.unsqueeze(axis)
    return x


@operator("Expand", host=(1,))
def expand(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    wanted = whole_numbers(inputs[1])
    rank = max(x.ndim, len(wanted))
    own = [1] * (rank - x.ndim) + list(x.shape)
    wanted = [1] * (rank - len(wanted)) + wanted
    return x.expand([n if w == 1 else w for n, w in zip(own, wanted, strict=True)])


@operator("Split", host=(1,))
def split(node: Node, inputs: Inputs) -> tuple[Tensor, ...]:
    x, axis = inputs[0], node.get("axis", 0)
    sizes = node.get("split")
    if sizes is None and optional(inputs, 1) is not None:
        sizes = whole_numbers(inputs[1])
    if sizes is None:
        parts, total = node.get("num_outputs", node.outputs), x.shape[axis]
        each = math.ceil(total / parts)
        sizes = [min(each, total - each * i) for i in range(parts)]
    return torch.split(x, sizes, axis)


@operator("Pad", host=(1, 2, 3))
def pad(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    mode = node.get("mode", "constant")
    flat = node.get("pads", node.get("paddings"))
    value = node.get("value", 0.0)
    if flat is None:
        flat = whole_numbers(inputs[1])
        value = 0.0 if optional(inputs, 2) is None else inputs[2].item()
    axes = whole_numbers(inputs[3]) if optional(inputs, 3) is not None else list(range(x.ndim))
    pairs = list(zip(flat[: len(axes)], flat[len(axes) :], strict=True))
    sides = dict(zip((a % x.ndim for a in axes), pairs, strict=True))
    if mode == "constant":
        each = [sides.get(axis, (0, 0)) for axis in reversed(range(x.ndim))]
        return F.pad(x, [n for pair in each for n in pair], value=value)
    for axis, (begin, end) in sides.items():
        if begin or end:
            x = x.index_select(axis, _padded_indices(mode, x.shape[axis], begin, end).to(x.device))
    return x


def _padded_indices(mode: str, size: int, begin: int, end: int) -> Tensor:
    """The index of the input element for each element of the padded axis."""
    index = torch.arange(-begin, size + end)
    if mode == "edge":
        return index.clamp(0, size - 1)
    if mode == "wrap":
        return index.remainder(size)
    if mode != "reflect":
        raise Unsupported(f"mode {mode}")
    if size == 1:
        return torch.zeros_like(index)
    around = index.remainder(2 * size - 2)
    return torch.minimum(around, 2 * size - 2 - around)


@operator("DepthToSpace")
def depth_to_space(node: Node, inputs: Inputs) -> Tensor:
    x, b = inputs[0], node.get("blocksize")
    n, c, h, w = x.shape
    if node.get("mode", "DCR") == "CRD":
        return F.pixel_shuffle(x, b)
    x = x.reshape(n, b, b, c // b**2, h, w).permute(0, 3, 4, 1, 5, 2)
    return x.reshape(n, c // b**2, h * b, w * b)


@operator("SpaceToDepth")
def space_to_depth(node: Node, inputs: Inputs) -> Tensor:
    x, b = inputs[0], node.get("blocksize")
    n, c, h, w = x.shape
    x = x.reshape(n, c, h // b, b, w // b, b).permute(0, 3, 5, 1, 2, 4)
    return x.reshape(n, c * b * b, h // b, w // b)


@operator("Cast")
def cast(node: Node, inputs: Inputs) -> Tensor:
    kind = node.get("to")
    if kind not in TYPES:
        raise Unsupported(f"data type {kind}")
    return inputs[0].to(TYPES[kind])


@operator("Constant")
def constant(node: Node, inputs: Inputs) -> Tensor:
    for name in ("value", "value_float", "value_floats", "value_int", "value_ints"):
        if name in node.attributes:
            value = node.attributes[name]
            return value if isinstance(value, Tensor) else torch.tensor(value)
    raise Unsupported("a constant of text or of a sparse tensor")


@operator("ConstantOfShape", host=(0,))
def constant_of_shape(node: Node, inputs: Inputs) -> Tensor:
    value: Tensor = node.get("value", torch.zeros(1))
    return value.reshape(()).expand(whole_numbers(inputs[0])).clone()


@operator("Range", host=(0, 1, 2))
def number_range(node: Node, inputs: Inputs) -> Tensor:
    start, limit, delta = (v.reshape(()).item() for v in inputs)
    return torch.arange(start, limit, delta, dtype=inputs[0].dtype, device=inputs[0].device)
