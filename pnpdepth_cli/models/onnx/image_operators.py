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
"""Attributes of Resize on which the weights of one axis depend."""
_RESIZE_OPSET = 12
"""Version of the standard in which onnxruntime is asked for these weights."""
_IR_VERSION = 8
"""Version of the file format; onnx's default is its newest, which an old onnxruntime refuses."""
_MAX_POOL = {1: F.max_pool1d, 2: F.max_pool2d, 3: F.max_pool3d}
"""Functions by the number of spatial axes."""

Pads = list[tuple[int, int]]
"""Pixels that are added at the (beginning, end) of each spatial axis."""


def _in_torch_order(pads: Pads) -> list[int]:
    """Returns the pads as F.pad takes them: both of the last axis first."""
    return [pixels for pair in reversed(pads) for pixels in pair]


class _KernelWindow(NamedTuple):
    """How a kernel moves over an image, one entry for each spatial axis."""

    stride: list[int]
    dilation: list[int]
    pads: Pads


def _window(node: Node, x: Tensor, kernel: Sequence[int]) -> _KernelWindow:
    """Returns how the kernel of a node moves over its input.

    Args:
        node: A convolution or pooling.
        x: Input (b, c, spatial axes).
        kernel: Pixels of the kernel along each spatial axis.
    """
    rank = x.ndim - 2
    auto_pad = node.get("auto_pad", "NOTSET")
    stride = node.get("strides", [1] * rank)
    dilation = node.get("dilations", [1] * rank)
    if auto_pad in ("NOTSET", "VALID"):
        # The beginnings of all axes, then their ends.
        numbers = [0] * (2 * rank)
        if auto_pad == "NOTSET":
            numbers = node.get("pads", numbers)
        pads = list(zip(numbers[:rank], numbers[rank:], strict=True))
        return _KernelWindow(stride, dilation, pads)
    # SAME: so many pixels that there are ⌈length / stride⌉ positions of the kernel.
    missing = []
    for length, taps, step, spread in zip(x.shape[2:], kernel, stride, dilation, strict=True):
        last_position = (math.ceil(length / step) - 1) * step
        reach = (taps - 1) * spread + 1
        missing.append(last_position + reach - length)
    return _KernelWindow(stride, dilation, _halves(node, missing))


def _halves(node: Node, totals: Sequence[int]) -> Pads:
    """Returns pads of so many pixels in all for each axis, none where that is negative.

    Of an odd number, the larger half lies at the end for SAME_UPPER, else at the beginning.
    """
    pads = []
    for total in totals:
        smaller = max(0, total) // 2
        larger = max(0, total) - smaller
        if node.get("auto_pad") == "SAME_UPPER":
            pads.append((smaller, larger))
        else:
            pads.append((larger, smaller))
    return pads


@operator("Conv")
def conv(node: Node, inputs: Inputs) -> Tensor:
    """Returns the convolution of an image with a weight (out, c / groups, kernel), and its bias."""
    x = inputs[0]
    weight = inputs[1]
    bias = optional(inputs, 2)
    # torch would copy the pixels below each kernel position.
    if x.dtype == torch.float64:
        raise ModelError("double precision")
    stride, dilation, pads = _window(node, x, weight.shape[2:])
    # torch pads both ends of an axis alike; unlike ends are padded before.
    zeros = [0] * len(pads)
    padding = [begin for begin, _ in pads]
    if any(begin != end for begin, end in pads):
        x = F.pad(x, _in_torch_order(pads))
        padding = zeros
    groups = node.get("group", 1)
    return torch.convolution(
        x, weight, bias, stride, padding, dilation,
        transposed=False, output_padding=zeros, groups=groups,
    )  # fmt: skip


@operator("ConvTranspose")
def conv_transpose(node: Node, inputs: Inputs) -> Tensor:
    """Returns the transposed convolution of an image with a weight (c, out / groups, kernel).

    Its pads are pixels that are cut off the result.
    """
    x = inputs[0]
    weight = inputs[1]
    bias = optional(inputs, 2)
    stride, dilation, pads = _window(node, x, weight.shape[2:])
    zeros = [0] * len(pads)
    whole = torch.convolution(
        x, weight, bias, stride, zeros, dilation,
        transposed=True,
        output_padding=node.get("output_padding", zeros),
        groups=node.get("group", 1),
    )  # fmt: skip
    # The result without its pads, which may follow from the shape that it should have.
    sides = whole.shape[2:]
    wanted_shape = node.get("output_shape")
    if wanted_shape is None and node.get("auto_pad", "NOTSET").startswith("SAME"):
        wanted_shape = [side * step for side, step in zip(x.shape[2:], stride, strict=True)]
    if wanted_shape is not None:
        wanted_sides = wanted_shape[-len(sides) :]
        surplus = [side - wanted for side, wanted in zip(sides, wanted_sides, strict=True)]
        pads = _halves(node, surplus)
    kept = [slice(begin, side - end) for side, (begin, end) in zip(sides, pads, strict=True)]
    return whole[(slice(None), slice(None), *kept)]


def _pooling(node: Node, x: Tensor) -> tuple[dict[str, Any], list[int]]:
    """Returns the arguments of torch's pooling, and pads that must be added before.

    The latter are in the order of F.pad, and empty where torch's own padding does: as much at both
    ends of an axis, and no more than half a kernel.

    Args:
        node: The pooling.
        x: Input (b, c, spatial axes).

    Raises:
        ModelError: There are such pads, and the size of the output is rounded up.
    """
    kernel = node.get("kernel_shape")
    rounds_up = bool(node.get("ceil_mode", 0))
    stride, _, pads = _window(node, x, kernel)
    arguments = {"kernel_size": kernel, "stride": stride, "ceil_mode": rounds_up}
    can_torch_pad = all(
        begin == end <= pixels // 2 for (begin, end), pixels in zip(pads, kernel, strict=True)
    )
    if can_torch_pad:
        return arguments | {"padding": [begin for begin, _ in pads]}, []
    if rounds_up:
        raise ModelError("ceil_mode and such pads")
    return arguments, _in_torch_order(pads)


@operator("MaxPool")
def max_pool(node: Node, inputs: Inputs) -> Tensor:
    """Returns the largest value of the input under each position of the kernel, without padding."""
    x = inputs[0]
    arguments, pads = _pooling(node, x)
    if pads:
        x = F.pad(x, pads, value=-math.inf)
    pool: Callable[..., Tensor] = _MAX_POOL[x.ndim - 2]
    return pool(x, dilation=node.get("dilations", 1), **arguments)


@operator("AveragePool")
def average_pool(node: Node, inputs: Inputs) -> Tensor:
    """Returns the mean under each position of the kernel.

    Padded zeros count if the node's `count_include_pad` is 1.

    Raises:
        ModelError: The input has other than two spatial axes, or the kernel is dilated.
    """
    x = inputs[0]
    counts_pads = bool(node.get("count_include_pad", 0))
    if x.ndim != 4 or any(spread != 1 for spread in node.get("dilations", [])):
        raise ModelError("other than two spatial axes, or dilations")
    arguments, pads = _pooling(node, x)
    mean = F.avg_pool2d(F.pad(x, pads), count_include_pad=counts_pads, **arguments)
    if counts_pads or not pads:
        return mean
    # Divided by the fraction of the kernel that lies in the image.
    is_image = F.pad(torch.ones_like(x[:1, :1]), pads)
    return mean / F.avg_pool2d(is_image, **arguments)


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
    """Returns the input normalised by the mean and variance of training, scaled and shifted."""
    x, weight, bias, mean, variance = inputs[:5]
    return F.batch_norm(x, mean, variance, weight, bias, eps=node.get("epsilon", 1e-5))


@operator("LayerNormalization")
def layer_norm(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input normalised over an axis and all behind it, scaled and shifted."""
    x = inputs[0]
    weight = inputs[1]
    bias = optional(inputs, 2)
    shape = list(x.shape[node.get("axis", -1) % x.ndim :])
    bias = None if bias is None else bias.expand(shape)
    return F.layer_norm(x, shape, weight.expand(shape), bias, node.get("epsilon", 1e-5))


@operator("GroupNormalization")
def group_norm(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input normalised over groups of channels, scaled and shifted."""
    x, weight, bias = inputs
    return F.group_norm(x, node.get("num_groups"), weight, bias, node.get("epsilon", 1e-5))


@operator("Upsample", "Resize", host_inputs=(1, 2, 3))
def resize(node: Node, inputs: Inputs) -> Tensor:
    """Returns the input resized along each axis, to stated sizes or by stated factors.

    Raises:
        ModelError: Neither is stated, or only some axes or a region are resized.
    """
    x = inputs[0]
    if "axes" in node.attributes:
        raise ModelError("axes")
    # The sizes, or the factors, whose place depends on the version.
    factors_input = optional(inputs, 2)
    sizes_input = optional(inputs, 3)
    sizes = [] if sizes_input is None else whole_numbers(sizes_input)
    if sizes:
        factors = [size / side for size, side in zip(sizes, x.shape, strict=True)]
    elif node.op == "Upsample" or node.opset < 11:
        factors = node.get("scales") if len(inputs) < 2 else inputs[1].tolist()
        node = _as_later_resize(node)
    elif factors_input is None:
        raise ModelError("neither scales nor sizes")
    else:
        factors = factors_input.tolist()
    if not sizes:
        sizes = [math.floor(side * factor) for side, factor in zip(x.shape, factors, strict=True)]
    # By torch's own resize where it computes the same; else along each axis by its weights.
    resized = _by_torch(x, node, factors, sizes)
    if resized is not None:
        return resized
    for axis, (size, factor) in enumerate(zip(sizes, factors, strict=True)):
        if factor != 1:
            x = _weighted_sums(x, axis, _weights(node, x.shape[axis], size, factor))
    return x


def _as_later_resize(node: Node) -> Node:
    """Returns an Upsample, or a Resize before opset 11, with the attributes of opset 11."""
    mode = node.get("mode", "nearest")
    if mode == "bilinear":
        mode = "linear"
    attributes = {
        "mode": mode,
        "coordinate_transformation_mode": "asymmetric",
        "nearest_mode": "floor",
    }
    return replace(node, attributes=attributes)


def _by_torch(x: Tensor, node: Node, factors: list[float], sizes: list[int]) -> Tensor | None:
    """Returns the result of torch's own resize if it computes the same; else None.

    Args:
        x: Input, of any number of axes.
        node: Resize of opset 11 or later.
        factors: Factor of each axis.
        sizes: Size of each axis of the result.
    """
    # torch resizes the last two axes of images, by the quotient of the sizes.
    are_exact = all(
        side * factor == size for side, factor, size in zip(x.shape, factors, sizes, strict=True)
    )
    is_image = x.ndim == 4 and list(x.shape[:2]) == sizes[:2] and x.is_floating_point()
    if not is_image or not are_exact:
        return None
    size = (sizes[2], sizes[3])
    mode = node.get("mode", "nearest")
    coordinates = node.get("coordinate_transformation_mode", "half_pixel")
    # Pixels are repeated a whole number of times.
    are_whole = all(factor >= 1 and factor == int(factor) for factor in factors)
    if mode == "nearest" and are_whole and node.get("nearest_mode") == "floor":
        return F.interpolate(x, size) if coordinates == "asymmetric" else None
    # Bilinear interpolation. The two kinds of half pixels differ where a side becomes one pixel.
    by_corners = coordinates == "align_corners"
    by_half_pixels = coordinates in ("half_pixel", "pytorch_half_pixel") and min(size) > 1
    if mode == "linear" and (by_half_pixels or by_corners):
        return F.interpolate(x, size, mode="bilinear", align_corners=by_corners)
    return None


def _weighted_sums(x: Tensor, axis: int, weights: Tensor) -> Tensor:
    """Returns a tensor whose entries along an axis are weighted sums of those of another.

    Args:
        x: The other tensor, of `size` entries along the axis.
        axis: Number of the axis.
        weights: (out, size): entry n of the result is the sum over k of weights[n, k] · x[k].
    """
    weights_shape = [1] * x.ndim
    weights_shape[axis] = -1
    # Each row has few weights that are not 0, at most `count`: (out, count) weights and the numbers
    # k of their entries. A row with fewer is filled with weights of 0.
    count = int(weights.ne(0).sum(1).max())
    indices = weights.abs().topk(count, dim=1).indices
    largest = weights.gather(1, indices).to(x)
    terms = [
        x.index_select(axis, index) * weight.reshape(weights_shape)
        for index, weight in zip(indices.to(x.device).T, largest.T, strict=True)
    ]
    return torch.stack(terms).sum(0, dtype=x.dtype)


def _weights(node: Node, size: int, out: int, factor: float) -> Tensor:
    """Returns the weights (out, size) by which an axis is resized.

    They are what onnxruntime makes of the identity matrix.

    Args:
        node: Resize of opset 11 or later.
        size: Length of the axis.
        out: Length that it gets.
        factor: Factor that the node states; `out` may be rounded.

    Raises:
        ModelError: The node resizes a region, or onnxruntime cannot.
    """
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    if node.get("coordinate_transformation_mode") == "tf_crop_and_resize":
        raise ModelError("a region of interest")
    torch.empty(out, size, device="meta")  # which a `SizeLimit` refuses if it is too large
    # One node that resizes the rows of the identity matrix, to a size or by a factor. Its inputs
    # are the matrix, the region, which is empty, the factors, and the sizes.
    attributes = {name: node.get(name) for name in _RESIZE if name in node.attributes}
    if factor == out / size:
        input_names = ["x", "none", "none", "by"]
        by = np.array([out, size])
    else:
        input_names = ["x", "none", "by"]
        by = np.array([factor, 1], np.float32)
    none = np.zeros(0, np.float32)
    graph = helper.make_graph(
        [helper.make_node("Resize", input_names, ["y"], **attributes)],
        "resize",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [size, size])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [out, size])],
        [numpy_helper.from_array(by, "by"), numpy_helper.from_array(none, "none")],
    )
    opset = helper.make_opsetid("", _RESIZE_OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=_IR_VERSION)
    with wrap_user_errors(f"{node.op} of onnxruntime"):
        session = onnxruntime.InferenceSession(
            model.SerializeToString(), providers=["CPUExecutionProvider"]
        )
        return torch.from_numpy(session.run(None, {"x": np.eye(size, dtype=np.float32)})[0])
