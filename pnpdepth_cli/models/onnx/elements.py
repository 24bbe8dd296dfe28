"""Operators on the elements of tensors: shape, type, order, parts, and constants."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.onnx import (
    Inputs,
    Node,
    operator,
    optional,
    register,
    stated,
    whole_numbers,
)
from pnpdepth_cli.models.steps import Unsupported

TYPES = {
    1: torch.float32, 2: torch.uint8, 3: torch.int8, 5: torch.int16, 6: torch.int32,
    7: torch.int64, 9: torch.bool, 10: torch.float32, 11: torch.float64, 16: torch.float32,
}  # fmt: skip
"""TensorProto.DataType; half precision is computed in float32."""


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
        "Squeeze": lambda node, i: i[0].squeeze(stated(node, "axes", i, 1) or [*range(i[0].ndim)]),
    },
    host=(1,),
)


@operator("Reshape", host=(1,))
def reshape(node: Node, inputs: Inputs) -> Tensor:
    x, wanted = inputs[0], stated(node, "shape", inputs, 1)
    assert wanted is not None
    if not node.get("allowzero", 0):
        wanted = [x.shape[i] if n == 0 else n for i, n in enumerate(wanted)]
    return x.reshape(wanted)


@operator("Unsqueeze", host=(1,))
def unsqueeze(node: Node, inputs: Inputs) -> Tensor:
    x, axes = inputs[0], stated(node, "axes", inputs, 1)
    assert axes is not None
    rank = x.ndim + len(axes)
    for axis in sorted(a % rank for a in axes):
        x = x.unsqueeze(axis)
    return x


@operator("Expand", host=(1,))
def expand(node: Node, inputs: Inputs) -> Tensor:
    x, wanted = inputs[0], whole_numbers(inputs[1])
    wanted = [1] * (x.ndim - len(wanted)) + wanted
    own = [1] * (len(wanted) - x.ndim) + list(x.shape)
    return x.expand([n if w == 1 else w for n, w in zip(own, wanted, strict=True)])


@operator("Split", host=(1,))
def split(node: Node, inputs: Inputs) -> tuple[Tensor, ...]:
    x, axis = inputs[0], node.get("axis", 0)
    sizes = stated(node, "split", inputs, 1)
    if sizes is None:
        parts, total = node.get("num_outputs", node.outputs), x.shape[axis]
        each = math.ceil(total / parts)
        sizes = [min(each, total - each * i) for i in range(parts)]
    return torch.split(x, sizes, axis)


@operator("Pad", host=(1, 2))
def pad(node: Node, inputs: Inputs) -> Tensor:
    x, mode = inputs[0], node.get("mode", "constant")
    if optional(inputs, 3) is not None:
        raise Unsupported("axes")
    flat = stated(node, "pads", inputs, 1)
    assert flat is not None
    sides = list(zip(flat[: x.ndim], flat[x.ndim :], strict=True))
    if mode == "constant":
        value = node.get("value", 0.0) if optional(inputs, 2) is None else inputs[2].item()
        return F.pad(x, [n for pair in reversed(sides) for n in pair], value=value)
    for axis, (begin, end) in enumerate(sides):
        if begin or end:
            index = _indices_of_padding(mode, x.shape[axis], begin, end)
            x = x.index_select(axis, index.to(x.device))
    return x


def _indices_of_padding(mode: str, size: int, begin: int, end: int) -> Tensor:
    """The index of the input element for each element of the padded axis."""
    index = torch.arange(-begin, size + end)
    if mode == "edge":
        return index.clamp(0, size - 1)
    if mode != "reflect" or size <= max(begin, end):
        raise Unsupported(f"mode {mode} of {size} element(s)")
    index = index.abs()
    return torch.minimum(index, 2 * size - 2 - index)


@operator("DepthToSpace")
def depth_to_space(node: Node, inputs: Inputs) -> Tensor:
    x, b = inputs[0], node.get("blocksize")
    n, c, h, w = x.shape
    if node.get("mode", "DCR") == "CRD":
        return F.pixel_shuffle(x, b)
    x = x.reshape(n, b, b, c // b**2, h, w).permute(0, 3, 4, 1, 5, 2)
    return x.reshape(n, c // b**2, h * b, w * b)


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


@operator("Slice", host=(1, 2, 3, 4))
def slice_(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    starts, ends, axes, steps = (
        stated(node, name, inputs, n)
        for n, name in enumerate(("starts", "ends", "axes", "steps"), 1)
    )
    assert starts is not None
    assert ends is not None
    axes, steps = axes or [*range(len(starts))], steps or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        size = x.shape[axis]
        # With a negative step, an end before the first element includes that element.
        kept = range(*slice(start, None if step < 0 and end < -size else end, step).indices(size))
        if step > 0:
            x = x[(slice(None),) * (axis % x.ndim) + (slice(kept.start, kept.stop, step),)]
        else:
            x = x.index_select(axis, torch.tensor(list(kept), dtype=torch.long, device=x.device))
    return x


@operator("Gather")
def gather(node: Node, inputs: Inputs) -> Tensor:
    x, axis = inputs[0], node.get("axis", 0) % inputs[0].ndim
    index = _from_start(inputs[1], x.shape[axis])
    picked = x.index_select(axis, index.reshape(-1).to(x.device))
    return picked.reshape((*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]))


def _from_start(index: Tensor, size: int) -> Tensor:
    """The index with negative elements counted from the start, too."""
    return torch.where(index < 0, index + size, index).long()
