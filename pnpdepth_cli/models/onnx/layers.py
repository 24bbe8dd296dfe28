"""Convolutions and pooling with every padding of the standard, normalisations, resizing.

Resize is a weighted sum: along one axis each output element is Σ_k weight[k]·x[index[k]], one
element for nearest, two for linear, four for cubic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.onnx import Inputs, Node, operator, optional, register, whole_numbers
from pnpdepth_cli.models.steps import Unsupported

_CONV = {1: F.conv1d, 2: F.conv2d, 3: F.conv3d}
_TRANSPOSED = {1: F.conv_transpose1d, 2: F.conv_transpose2d, 3: F.conv_transpose3d}
_MAX_POOL = {1: F.max_pool1d, 2: F.max_pool2d, 3: F.max_pool3d}

Pads = list[tuple[int, int]]


def _sides(pads: Pads) -> list[int]:
    """The pads in the order of F.pad: the last axis first."""
    return [n for pair in reversed(pads) for n in pair]


def _pads(
    node: Node, size: Sequence[int], kernel: Sequence[int], stride: Sequence[int],
    dilation: Sequence[int],
) -> Pads:  # fmt: skip
    """(begin, end) per spatial axis; the window is kernel × dilation."""
    rank, auto = len(size), node.get("auto_pad", "NOTSET")
    if auto == "NOTSET":
        flat = node.get("pads", [0] * (2 * rank))
        return list(zip(flat[:rank], flat[rank:], strict=True))
    if auto == "VALID":
        return [(0, 0)] * rank
    pads = []
    for n, k, s, d in zip(size, kernel, stride, dilation, strict=True):
        total = max(0, (math.ceil(n / s) - 1) * s + (k - 1) * d + 1 - n)
        pads.append((total // 2, total - total // 2))
    return pads if auto == "SAME_UPPER" else [(end, begin) for begin, end in pads]


@operator("Conv")
def conv(node: Node, inputs: Inputs) -> Tensor:
    x, weight, bias = inputs[0], inputs[1], optional(inputs, 2)
    if x.dtype == torch.float64:  # computed with a copy of the pixels below each kernel position
        raise Unsupported("double precision")
    rank = x.ndim - 2
    stride, dilation = node.get("strides", [1] * rank), node.get("dilations", [1] * rank)
    pads = _pads(node, x.shape[2:], weight.shape[2:], stride, dilation)
    even = all(begin == end for begin, end in pads)
    if not even:
        x = F.pad(x, _sides(pads))
    padding = [begin for begin, _ in pads] if even else [0] * rank
    return _CONV[rank](x, weight, bias, stride, padding, dilation, node.get("group", 1))


@operator("ConvTranspose")
def conv_transpose(node: Node, inputs: Inputs) -> Tensor:
    x, weight, bias = inputs[0], inputs[1], optional(inputs, 2)
    rank = x.ndim - 2
    stride, dilation = node.get("strides", [1] * rank), node.get("dilations", [1] * rank)
    extra = node.get("output_padding", [0] * rank)
    y: Tensor = _TRANSPOSED[rank](x, weight, None, stride, 0, 0, node.get("group", 1), dilation)
    full = [n + e for n, e in zip(y.shape[2:], extra, strict=True)]
    crops = _pads_of_transposed(node, x, stride, full)
    sides = [(-begin, e - end) for (begin, end), e in zip(crops, extra, strict=True)]
    if any(n for pair in sides for n in pair):
        y = F.pad(y, _sides(sides))
    return y if bias is None else y + bias.reshape(-1, *[1] * rank)


def _pads_of_transposed(node: Node, x: Tensor, stride: Sequence[int], full: Sequence[int]) -> Pads:
    auto, wanted = node.get("auto_pad", "NOTSET"), node.get("output_shape")
    if wanted is None:
        if not auto.startswith("SAME"):
            return _pads(node, x.shape[2:], full, stride, stride)
        wanted = [n * s for n, s in zip(x.shape[2:], stride, strict=True)]
    totals = [size - out for size, out in zip(full, wanted[-len(full) :], strict=True)]
    pads = [(max(0, total) // 2, total - max(0, total) // 2) for total in totals]
    return pads if auto == "SAME_UPPER" else [(end, begin) for begin, end in pads]


def _pooling(node: Node, x: Tensor) -> tuple[dict[str, Any], list[int]]:
    """Arguments of torch's pooling, and the pads that it cannot have, in the order of F.pad."""
    kernel, ones = node.get("kernel_shape"), [1] * (x.ndim - 2)
    stride, dilation = node.get("strides", ones), node.get("dilations", ones)
    pads, ceil = _pads(node, x.shape[2:], kernel, stride, dilation), bool(node.get("ceil_mode", 0))
    called = {"kernel_size": kernel, "stride": stride, "ceil_mode": ceil}
    if all(begin == end <= k // 2 for (begin, end), k in zip(pads, kernel, strict=True)):
        return called | {"padding": [begin for begin, _ in pads]}, []
    if ceil:
        raise Unsupported("ceil_mode and such pads")
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
    x, with_pads = inputs[0], bool(node.get("count_include_pad", 0))
    if x.ndim != 4 or any(d != 1 for d in node.get("dilations", [])):
        raise Unsupported("other than two spatial axes, or dilations")
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
    x, weight, bias = inputs[0], inputs[1], optional(inputs, 2)
    shape = list(x.shape[node.get("axis", -1) % x.ndim :])
    bias = None if bias is None else bias.expand(shape)
    return F.layer_norm(x, shape, weight.expand(shape), bias, node.get("epsilon", 1e-5))


@operator("GroupNormalization")
def group_norm(node: Node, inputs: Inputs) -> Tensor:
    x, weight, bias = inputs
    return F.group_norm(x, node.get("num_groups"), weight, bias, node.get("epsilon", 1e-5))


@operator("Upsample", "Resize", host=(1, 2, 3))
def resize(node: Node, inputs: Inputs) -> Tensor:
    x, scales, sizes = inputs[0], optional(inputs, 2), optional(inputs, 3)
    if "axes" in node.attributes:
        raise Unsupported("axes")
    if sizes is not None and sizes.numel():
        wanted = whole_numbers(sizes)
        return _resize(x, node, [size / n for size, n in zip(wanted, x.shape, strict=True)], wanted)
    if node.op == "Upsample" or node.opset < 11:
        factors = node.get("scales") if len(inputs) < 2 else inputs[1].tolist()
        mode = {"bilinear": "linear"}.get(node.get("mode"), node.get("mode", "nearest"))
        more = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        node = replace(node, attributes={"mode": mode, **more})
    elif scales is None:
        raise Unsupported("neither scales nor sizes")
    else:
        factors = scales.tolist()
    wanted = [math.floor(n * factor) for n, factor in zip(x.shape, factors, strict=True)]
    return _resize(x, node, factors, wanted)


def _resize(x: Tensor, node: Node, factors: list[float], sizes: list[int]) -> Tensor:
    fast = _by_torch(x, node, factors, sizes)
    if fast is not None:
        return fast
    for axis, (size, factor) in enumerate(zip(sizes, factors, strict=True)):
        if factor != 1:
            x = _along(x, axis, *_taps(node, x.shape[axis], size, factor))
    return x


def _by_torch(x: Tensor, node: Node, factors: list[float], sizes: list[int]) -> Tensor | None:
    """The result of torch's own resize if it computes the same; else None."""
    exact = all(n * f == s for n, f, s in zip(x.shape, factors, sizes, strict=True))
    is_image = x.ndim == 4 and list(x.shape[:2]) == sizes[:2] and exact
    if not is_image or not x.is_floating_point():
        return None
    size, mode = (sizes[2], sizes[3]), node.get("mode", "nearest")
    coordinates = node.get("coordinate_transformation_mode", "half_pixel")
    whole = all(f >= 1 and f == int(f) for f in factors)
    if mode == "nearest" and whole and node.get("nearest_mode") == "floor":
        return F.interpolate(x, size) if coordinates == "asymmetric" else None
    corners = coordinates == "align_corners"
    half = coordinates in ("half_pixel", "pytorch_half_pixel") and min(size) > 1
    if mode == "linear" and (half or corners):
        return F.interpolate(x, size, mode="bilinear", align_corners=corners)
    return None


def _along(x: Tensor, axis: int, index: Tensor, weight: Tensor) -> Tensor:
    """Σ_k weight (n, k) · x taken at index (n, k) along the axis."""
    shape = [1] * x.ndim
    shape[axis] = -1
    columns = zip(index.to(x.device).unbind(1), weight.to(x).unbind(1), strict=True)
    return torch.stack([x.index_select(axis, i) * w.reshape(shape) for i, w in columns]).sum(
        0, dtype=x.dtype
    )


def _taps(node: Node, size: int, out: int, factor: float) -> tuple[Tensor, Tensor]:
    """Indices and weights (out, k) of the input's elements that make up each of the output's.

    Args:
        node: The Resize or Upsample.
        size: Number of the input's elements along the axis.
        out: Number of the output's.
        factor: Scale of the axis: about out / size.
    """
    mode = node.get("mode", "nearest")
    coordinates = node.get("coordinate_transformation_mode", "half_pixel")
    position = _coordinates(coordinates, size, out, factor)
    if mode == "nearest":
        index = _ROUNDING[node.get("nearest_mode", "round_prefer_floor")](position).long()
        return index.clamp(0, size - 1)[:, None], torch.ones(out, 1)
    if mode not in ("linear", "cubic"):
        raise Unsupported(f"mode {mode}")
    reach = 1 if mode == "linear" else 2
    index = position.floor().long()[:, None] + torch.arange(1 - reach, reach + 1)
    distance = (index - position[:, None]).abs()
    a = node.get("cubic_coeff_a", -0.75)
    weight = (1 - distance).clamp_min(0) if mode == "linear" else _cubic(distance, a)
    return index.clamp(0, size - 1), weight


def _coordinates(mode: str, size: int, out: int, factor: float) -> Tensor:
    """The input coordinates of the output's elements; in float32 as runtimes compute them.

    A factor that stands for a ratio of sizes is taken as that, lest a half becomes less than one.
    """
    o = torch.arange(out, dtype=torch.float32)
    scale = torch.tensor(factor, dtype=torch.float32)
    if mode == "asymmetric":
        return o * size / out if factor == out / size else o / scale
    if mode == "align_corners":
        return o * (size - 1) / (out - 1) if out > 1 else torch.zeros(out)
    if mode == "tf_half_pixel_for_nn":
        return (o + 0.5) / scale
    if mode == "pytorch_half_pixel" and out == 1:
        return torch.zeros(out)
    if mode in ("half_pixel", "pytorch_half_pixel"):
        return (o + 0.5) / scale - 0.5
    raise Unsupported(f"coordinate_transformation_mode {mode}")


_ROUNDING: dict[str, Callable[[Tensor], Tensor]] = {
    "round_prefer_floor": lambda p: (p - 0.5).ceil(),
    "round_prefer_ceil": lambda p: (p + 0.5).floor(),
    "floor": torch.floor,
    "ceil": torch.ceil,
}


def _cubic(t: Tensor, a: float) -> Tensor:
    """The cubic convolution kernel at distances t (Keys 1981)."""
    near = ((a + 2) * t - (a + 3)) * t * t + 1
    far = ((a * t - 5 * a) * t + 8 * a) * t - 4 * a
    return torch.where(t <= 1, near, torch.where(t < 2, far, torch.zeros_like(t)))
