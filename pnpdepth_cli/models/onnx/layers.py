"""Convolutions and pooling with every padding of the standard, normalisations, dequantisation."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.onnx import (
    Inputs,
    Node,
    operator,
    optional,
    register,
)
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
    extra = list(node.get("output_padding", [0] * rank))
    full = [
        (n - 1) * s + (k - 1) * d + 1 + e
        for n, s, k, d, e in zip(
            x.shape[2:], stride, weight.shape[2:], dilation, extra, strict=True
        )
    ]
    y: Tensor = _TRANSPOSED[rank](x, weight, None, stride, 0, 0, node.get("group", 1), dilation)
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


def _pooling(node: Node, x: Tensor) -> tuple[list[int], list[int], list[int], Pads, Pads]:
    """Kernel, stride, dilation, pads, and the pads with those that ceil_mode adds at the end."""
    rank = x.ndim - 2
    kernel = list(node.get("kernel_shape"))
    stride = list(node.get("strides", [1] * rank))
    dilation = list(node.get("dilations", [1] * rank))
    pads = _pads(node, x.shape[2:], kernel, stride, dilation)
    if not node.get("ceil_mode", 0):
        return kernel, stride, dilation, pads, pads
    padded = []
    for n, k, s, d, (begin, end) in zip(x.shape[2:], kernel, stride, dilation, pads, strict=True):
        window = (k - 1) * d + 1
        out = math.ceil((n + begin + end - window) / s) + 1
        if (out - 1) * s >= n + begin:  # no window begins in the padding at the end
            out -= 1
        padded.append((begin, max(end, (out - 1) * s + window - n - begin)))
    return kernel, stride, dilation, pads, padded


@operator("MaxPool")
def max_pool(node: Node, inputs: Inputs) -> Tensor:
    if node.outputs > 1:
        raise Unsupported("its second output, the indices")
    x = inputs[0]
    kernel, stride, dilation, _, padded = _pooling(node, x)
    if any(n for pair in padded for n in pair):
        x = F.pad(x, _sides(padded), value=-math.inf)
    return _MAX_POOL[x.ndim - 2](x, kernel, stride, 0, dilation)


@operator("AveragePool")
def average_pool(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    kernel, stride, dilation, pads, padded = _pooling(node, x)
    if x.ndim != 4 or any(d != 1 for d in dilation):
        raise Unsupported("other than two spatial axes, or dilations")
    if not any(n for pair in padded for n in pair):
        return F.avg_pool2d(x, kernel, stride)
    area = math.prod(kernel)
    total = F.avg_pool2d(F.pad(x, _sides(padded)), kernel, stride) * area
    inside = torch.ones_like(x[:1, :1])
    if node.get("count_include_pad", 0):
        inside = F.pad(inside, _sides(pads), value=1.0)
        padded = [(0, g[1] - p[1]) for g, p in zip(padded, pads, strict=True)]
    return total / (F.avg_pool2d(F.pad(inside, _sides(padded)), kernel, stride) * area)


register(
    {
        "GlobalAveragePool": lambda _, i: i[0].mean(list(range(2, i[0].ndim)), keepdim=True),
        "GlobalMaxPool": lambda _, i: i[0].amax(list(range(2, i[0].ndim)), keepdim=True),
        "InstanceNormalization": lambda node, i: F.instance_norm(
            i[0], weight=i[1], bias=i[2], eps=node.get("epsilon", 1e-5)
        ),
        "LRN": lambda node, i: F.local_response_norm(
            i[0],
            node.get("size"),
            node.get("alpha", 1e-4),
            node.get("beta", 0.75),
            node.get("bias", 1.0),
        ),
    }
)


@operator("BatchNormalization")
def batch_norm(node: Node, inputs: Inputs) -> Tensor:
    if node.get("training_mode", 0):
        raise Unsupported("training_mode; export the network in eval mode")
    x, weight, bias, mean, variance = inputs[:5]
    return F.batch_norm(x, mean, variance, weight, bias, eps=node.get("epsilon", 1e-5))


@operator("LayerNormalization")
def layer_norm(node: Node, inputs: Inputs) -> Tensor:
    if node.outputs > 1:
        raise Unsupported("its second and third output")
    x, weight, bias = inputs[0], inputs[1], optional(inputs, 2)
    shape = list(x.shape[node.get("axis", -1) % x.ndim :])
    bias = None if bias is None else bias.expand(shape)
    return F.layer_norm(x, shape, weight.expand(shape), bias, node.get("epsilon", 1e-5))


@operator("GroupNormalization")
def group_norm(node: Node, inputs: Inputs) -> Tensor:
    x, weight, bias = inputs
    groups = node.get("num_groups")
    if node.opset < 21:  # one weight per group
        weight, bias = (v.repeat_interleave(x.shape[1] // groups) for v in (weight, bias))
    return F.group_norm(x, groups, weight, bias, node.get("epsilon", 1e-5))


@operator("DequantizeLinear")
def dequantize(node: Node, inputs: Inputs) -> Tensor:
    x, scale, zero = inputs[0], inputs[1], optional(inputs, 2)
    if node.get("block_size", 0):
        raise Unsupported("blocks")
    if scale.numel() > 1:
        shape = [1] * x.ndim
        shape[node.get("axis", 1)] = -1
        scale = scale.reshape(shape)
        zero = None if zero is None else zero.reshape(shape)
    centred = x.to(scale.dtype) if zero is None else x.to(scale.dtype) - zero.to(scale.dtype)
    return centred * scale
