"""Convolutions and pooling with every padding of the standard, normalisations, resizing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.errors import ModelError, wrap_user_errors
from pnpdepth_cli.models.onnx.operators import (
    Inputs,
    Node,
    operator,
    optional,
    register,
    whole_numbers,
)

_RESIZE = ("mode", "coordinate_transformation_mode", "nearest_mode", "cubic_coeff_a")
_MAX_POOL = {1: F.max_pool1d, 2: F.max_pool2d, 3: F.max_pool3d}

Pads = list[tuple[int, int]]


def _sides(pads: Pads) -> list[int]:
    """The pads in the order of F.pad: the last axis first."""
    return [n for pair in reversed(pads) for n in pair]


class _KernelWindow(NamedTuple):
    """How a kernel moves over an image, of each spatial axis."""

    stride: list[int]
    dilation: list[int]
    pads: Pads
    """(begin, end) of each axis."""


def _window(node: Node, x: Tensor, kernel: Sequence[int]) -> _KernelWindow:
    """The window of a node."""
    rank = x.ndim - 2
    auto = node.get("auto_pad", "NOTSET")
    stride = node.get("strides", [1] * rank)
    dilation = node.get("dilations", [1] * rank)
    if auto in ("NOTSET", "VALID"):
        flat = [0] * (2 * rank)
        if auto == "NOTSET":
            flat = node.get("pads", flat)
        return _KernelWindow(stride, dilation, list(zip(flat[:rank], flat[rank:], strict=True)))
    sizes = zip(x.shape[2:], kernel, stride, dilation, strict=True)
    totals = [(math.ceil(n / s) - 1) * s + (k - 1) * d + 1 - n for n, k, s, d in sizes]
    return _KernelWindow(stride, dilation, _halves(node, totals))


def _halves(node: Node, totals: Sequence[int]) -> Pads:
    """(begin, end) of so many pixels per axis; an odd one lies at the end for SAME_UPPER only."""
    pairs = [(max(0, n) // 2, max(0, n) - max(0, n) // 2) for n in totals]
    return pairs if node.get("auto_pad") == "SAME_UPPER" else [(end, begin) for begin, end in pairs]


@operator("Conv")
def conv(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    weight = inputs[1]
    bias = optional(inputs, 2)
    if x.dtype == torch.float64:  # computed with a copy of the pixels below each kernel position
        raise ModelError("double precision")
    stride, dilation, pads = _window(node, x, weight.shape[2:])
    padding = [begin for begin, _ in pads]
    none = [0] * len(pads)
    if any(begin != end for begin, end in pads):
        x = F.pad(x, _sides(pads))
        padding = none
    group = node.get("group", 1)
    return torch.convolution(x, weight, bias, stride, padding, dilation, False, none, group)


@operator("ConvTranspose")
def conv_transpose(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    weight = inputs[1]
    bias = optional(inputs, 2)
    stride, dilation, pads = _window(node, x, weight.shape[2:])
    none = [0] * len(pads)
    group = node.get("group", 1)
    extra = node.get("output_padding", none)
    y = torch.convolution(x, weight, bias, stride, none, dilation, True, extra, group)
    # The result without its pads, which may be stated by its shape.
    sizes = y.shape[2:]
    wanted = node.get("output_shape")
    if wanted is None and node.get("auto_pad", "NOTSET").startswith("SAME"):
        wanted = [n * s for n, s in zip(x.shape[2:], stride, strict=True)]
    if wanted is not None:
        spatial = wanted[-len(sizes) :]
        pads = _halves(node, [n - w for n, w in zip(sizes, spatial, strict=True)])
    kept = [slice(begin, n - end) for n, (begin, end) in zip(sizes, pads, strict=True)]
    return y[(slice(None), slice(None), *kept)]


def _pooling(node: Node, x: Tensor) -> tuple[dict[str, Any], list[int]]:
    """Arguments of torch's pooling, and the pads that it cannot have, in the order of F.pad."""
    kernel = node.get("kernel_shape")
    ceil = bool(node.get("ceil_mode", 0))
    stride, _, pads = _window(node, x, kernel)
    called = {"kernel_size": kernel, "stride": stride, "ceil_mode": ceil}
    if all(begin == end <= k // 2 for (begin, end), k in zip(pads, kernel, strict=True)):
        return called | {"padding": [begin for begin, _ in pads]}, []
    if ceil:
        raise ModelError("ceil_mode and such pads")
    return called, _sides(pads)


@operator("MaxPool")
def max_pool(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    called, sides = _pooling(node, x)
    x = F.pad(x, sides, value=-math.inf) if sides else x
    pool: Callable[..., Tensor] = _MAX_POOL[x.ndim - 2]
    return pool(x, dilation=node.get("dilations", 1), **called)


@operator("AveragePool")
def average_pool(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    with_pads = bool(node.get("count_include_pad", 0))
    if x.ndim != 4 or any(d != 1 for d in node.get("dilations", [])):
        raise ModelError("other than two spatial axes, or dilations")
    called, sides = _pooling(node, x)
    mean = F.avg_pool2d(F.pad(x, sides), count_include_pad=with_pads, **called)
    if with_pads or not sides:
        return mean
    return mean / F.avg_pool2d(F.pad(torch.ones_like(x[:1, :1]), sides), **called)


register(
    {
        "GlobalAveragePool": lambda _, i: i[0].mean(list(range(2, i[0].ndim)), keepdim=True),
        "GlobalMaxPool": lambda _, i: i[0].amax(list(range(2, i[0].ndim)), keepdim=True),
        "InstanceNormalization": lambda node, i: F.instance_norm(
            i[0], weight=i[1], bias=i[2], eps=node.get("epsilon", 1e-5)
        ),
    }
)


@operator("BatchNormalization")
def batch_norm(node: Node, inputs: Inputs) -> Tensor:
    x, weight, bias, mean, variance = inputs[:5]
    return F.batch_norm(x, mean, variance, weight, bias, eps=node.get("epsilon", 1e-5))


@operator("LayerNormalization")
def layer_norm(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    weight = inputs[1]
    bias = optional(inputs, 2)
    shape = list(x.shape[node.get("axis", -1) % x.ndim :])
    bias = None if bias is None else bias.expand(shape)
    return F.layer_norm(x, shape, weight.expand(shape), bias, node.get("epsilon", 1e-5))


@operator("GroupNormalization")
def group_norm(node: Node, inputs: Inputs) -> Tensor:
    x, weight, bias = inputs
    return F.group_norm(x, node.get("num_groups"), weight, bias, node.get("epsilon", 1e-5))


@operator("Upsample", "Resize", host=(1, 2, 3))
def resize(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    scales = optional(inputs, 2)
    sizes = optional(inputs, 3)
    if "axes" in node.attributes:
        raise ModelError("axes")
    wanted = [] if sizes is None else whole_numbers(sizes)
    if wanted:
        factors = [size / n for size, n in zip(wanted, x.shape, strict=True)]
    elif node.op == "Upsample" or node.opset < 11:
        factors = node.get("scales") if len(inputs) < 2 else inputs[1].tolist()
        mode = {"bilinear": "linear"}.get(node.get("mode"), node.get("mode", "nearest"))
        more = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        node = replace(node, attributes={"mode": mode, **more})
    elif scales is None:
        raise ModelError("neither scales nor sizes")
    else:
        factors = scales.tolist()
    wanted = wanted or [math.floor(n * f) for n, f in zip(x.shape, factors, strict=True)]
    # By torch's own resize where it computes the same.
    fast = _by_torch(x, node, factors, wanted)
    if fast is not None:
        return fast
    for axis, (size, factor) in enumerate(zip(wanted, factors, strict=True)):
        if factor != 1:
            x = _along(x, axis, _weights(node, x.shape[axis], size, factor))
    return x


def _by_torch(x: Tensor, node: Node, factors: list[float], sizes: list[int]) -> Tensor | None:
    """The result of torch's own resize if it computes the same; else None."""
    exact = all(n * f == s for n, f, s in zip(x.shape, factors, sizes, strict=True))
    if x.ndim != 4 or list(x.shape[:2]) != sizes[:2] or not exact or not x.is_floating_point():
        return None
    size = (sizes[2], sizes[3])
    mode = node.get("mode", "nearest")
    coordinates = node.get("coordinate_transformation_mode", "half_pixel")
    whole = all(f >= 1 and f == int(f) for f in factors)
    if mode == "nearest" and whole and node.get("nearest_mode") == "floor":
        return F.interpolate(x, size) if coordinates == "asymmetric" else None
    corners = coordinates == "align_corners"
    half = coordinates in ("half_pixel", "pytorch_half_pixel") and min(size) > 1
    if mode == "linear" and (half or corners):
        return F.interpolate(x, size, mode="bilinear", align_corners=corners)
    return None


def _along(x: Tensor, axis: int, weights: Tensor) -> Tensor:
    """Σ_k weights[n, k] · x[k] along the axis, of the elements whose weight is not 0."""
    shape = [1] * x.ndim
    shape[axis] = -1
    most = int(weights.ne(0).sum(1).max())
    index = weights.abs().topk(most, dim=1).indices
    columns = zip(index.to(x.device).T, weights.gather(1, index).to(x).T, strict=True)
    return torch.stack([x.index_select(axis, i) * w.reshape(shape) for i, w in columns]).sum(
        0, dtype=x.dtype
    )


def _weights(node: Node, size: int, out: int, factor: float) -> Tensor:
    """The weights (out, size) of an axis: what onnxruntime makes of the identity matrix."""
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    if node.get("coordinate_transformation_mode") == "tf_crop_and_resize":
        raise ModelError("a region of interest")
    torch.empty(out, size, device="meta")  # which a `SizeLimit` refuses if it is too large
    # One node, that resizes each row of the identity matrix, to a size or by a factor.
    attributes = {name: node.get(name) for name in _RESIZE if name in node.attributes}
    stated = ["none", "by"]
    by = np.array([out, size])
    if factor != out / size:
        stated = ["by"]
        by = np.array([factor, 1], np.float32)
    none = np.zeros(0, np.float32)
    graph = helper.make_graph(
        [helper.make_node("Resize", ["x", "none", *stated], ["y"], **attributes)],
        "resize",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [size, size])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [out, size])],
        [numpy_helper.from_array(by, "by"), numpy_helper.from_array(none, "none")],
    )
    # Its result is the weights.
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 12)], ir_version=8)
    with wrap_user_errors(f"{node.op} of onnxruntime"):
        session = onnxruntime.InferenceSession(
            model.SerializeToString(), providers=["CPUExecutionProvider"]
        )
        return torch.from_numpy(session.run(None, {"x": np.eye(size, dtype=np.float32)})[0])
