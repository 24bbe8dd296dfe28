"""Indexing: parts of a tensor are taken out or replaced."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.formats.onnx.operators.table import (
    Inputs,
    Node,
    Unsupported,
    operator,
    optional,
    whole_numbers,
)


@operator("Slice", host=(1, 2, 3, 4))
def slice_(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    if len(inputs) == 1:
        starts, ends, axes, steps = node.get("starts"), node.get("ends"), node.get("axes"), None
    else:
        starts, ends = whole_numbers(inputs[1]), whole_numbers(inputs[2])
        axes, steps = (
            None if optional(inputs, n) is None else whole_numbers(inputs[n]) for n in (3, 4)
        )
    axes = axes if axes is not None else range(len(starts))
    steps = steps if steps is not None else [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        size = x.shape[axis]
        kept = range(*slice(start, _backwards_end(end, size, step), step).indices(size))
        if step > 0:
            x = x[(slice(None),) * (axis % x.ndim) + (slice(kept.start, kept.stop, step),)]
        else:
            x = x.index_select(axis, torch.tensor(list(kept), dtype=torch.long, device=x.device))
    return x


def _backwards_end(end: int, size: int, step: int) -> int | None:
    """With a negative step, an end before the first element includes that element."""
    return None if step < 0 and end < -size else end


@operator("Gather")
def gather(node: Node, inputs: Inputs) -> Tensor:
    x, index = inputs[0], inputs[1].long()
    axis = node.get("axis", 0) % x.ndim
    size = x.shape[axis]
    flat = torch.where(index < 0, index + size, index).reshape(-1).to(x.device)
    picked = x.index_select(axis, flat)
    return picked.reshape((*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]))


@operator("GatherElements")
def gather_elements(node: Node, inputs: Inputs) -> Tensor:
    x, index, axis = inputs[0], inputs[1].long(), node.get("axis", 0)
    return x.gather(axis, torch.where(index < 0, index + x.shape[axis], index))


@operator("GatherND")
def gather_nd(node: Node, inputs: Inputs) -> Tensor:
    if node.get("batch_dims", 0):
        raise Unsupported("batch_dims")
    return inputs[0][tuple(inputs[1].long().unbind(-1))]


@operator("ScatterND")
def scatter_nd(node: Node, inputs: Inputs) -> Tensor:
    if node.get("reduction", "none") not in ("none", "add"):
        raise Unsupported(f"reduction {node.get('reduction')}")
    index = tuple(inputs[1].long().unbind(-1))
    return inputs[0].index_put(index, inputs[2], accumulate=node.get("reduction") == "add")


@operator("ScatterElements")
def scatter_elements(node: Node, inputs: Inputs) -> Tensor:
    if node.get("reduction", "none") != "none":
        raise Unsupported(f"reduction {node.get('reduction')}")
    x, index, axis = inputs[0], inputs[1].long(), node.get("axis", 0)
    return x.scatter(axis, torch.where(index < 0, index + x.shape[axis], index), inputs[2])


@operator("OneHot", host=(1,))
def one_hot(node: Node, inputs: Inputs) -> Tensor:
    index, count, values = inputs[0].long(), whole_numbers(inputs[1])[0], inputs[2]
    hot = F.one_hot(index.remainder(count), count).bool()
    axis = node.get("axis", -1)
    return torch.where(hot, values[1], values[0]).movedim(-1, axis)


@operator("TopK", host=(1,))
def top_k(node: Node, inputs: Inputs) -> tuple[Tensor, ...]:
    k = node.get("k") if len(inputs) < 2 else whole_numbers(inputs[1])[0]
    largest = inputs[0].topk(
        k, node.get("axis", -1), bool(node.get("largest", 1)), bool(node.get("sorted", 1))
    )
    return largest.values, largest.indices


@operator("GridSample")
def grid_sample(node: Node, inputs: Inputs) -> Tensor:
    mode = {"linear": "bilinear", "cubic": "bicubic"}.get(node.get("mode", "bilinear"))
    return F.grid_sample(
        inputs[0],
        inputs[1],
        mode=mode or node.get("mode", "bilinear"),
        padding_mode=node.get("padding_mode", "zeros"),
        align_corners=bool(node.get("align_corners", 0)),
    )
