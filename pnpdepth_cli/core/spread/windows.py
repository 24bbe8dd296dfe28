"""Rules of operations on windows of rows and columns, such as convolutions.

Which outputs an input element reaches is asked of the operation itself, on the rows of a unit
matrix.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.core.spread.boxes import NOWHERE, Call, Spread, everywhere, full_range, rule

Response = tuple[Tensor, Tensor]
"""First and last index (n,) of an operation's result that each of n indices of its input reaches.

They are along one axis. An index that reaches nothing has `NOWHERE` and −1."""


def move_along(
    call: Call, responses: dict[int, Response], *, mixes_channels: bool = False
) -> Spread:
    """Returns where an operation that works along each of some axes by itself depends on the map.

    Args:
        call: The operation.
        responses: What each index of the input reaches, by axis. Other axes stay as they are.
        mixes_channels: Whether every channel, axis 1, depends on every other.
    """
    axes = call.spread.axes()
    empty = call.spread.empty()
    for axis, (first_reached, last_reached) in responses.items():
        first, last = axes[axis]
        # The first output of any input from `first` on, and the last of any up to `last`.
        first_from_here = first_reached.flip(0).cummin(0).values.flip(0)
        last_up_to_here = last_reached.cummax(0).values
        first = first_from_here[first.clamp(max=len(first_reached) - 1)]
        last = last_up_to_here[last.clamp(min=0)]
        first = first.masked_fill(empty, NOWHERE)
        last = last.masked_fill(empty, -1)
        axes[axis] = (first, last)
    if mixes_channels:
        axes[1] = full_range(call, 1)
    return Spread.from_axes(axes)


def _response(output: Tensor) -> Response:
    """Which indices the n rows of a unit matrix reach, from what an operation gives of them.

    Args:
        output: (n, m), row i for the input that is 1 at index i and 0 elsewhere.
    """
    is_reached = output != 0
    indices = torch.arange(output.shape[1])
    first = torch.where(is_reached, indices, NOWHERE).amin(dim=1)
    last = torch.where(is_reached, indices, -1).amax(dim=1)
    return first, last


def _unit_rows(call: Call, axis: int) -> Tensor:
    """(n, 1, n): n rows in one channel; row i is 1 at the i-th of the input's n indices on axis."""
    return torch.eye(call.source.shape[axis])[:, None]


@functools.lru_cache(maxsize=256)
def _response_of_convolution(
    size: int, kernel: int, stride: int, padding: int, dilation: int, transposed: bool, extra: int
) -> Response:
    """Which outputs each of `size` inputs of a convolution along one axis reaches.

    `extra` is the output padding: outputs that a transposed convolution adds at its end.
    """
    rows = torch.eye(size)[:, None]
    weight = torch.ones(1, 1, kernel)
    groups = 1
    output = torch.convolution(
        rows, weight, None, [stride], [padding], [dilation], transposed, [extra], groups
    )
    return _response(output[:, 0])


@rule("convolution", "_convolution", "cudnn_convolution", "mkldnn_convolution")
def convolution(call: Call) -> Spread:
    """Returns where a convolution depends on the feature map.

    The boxes are the input's, widened by the kernel, in all channels. They are all of the result if
    the input is weight or bias, or the operation one of a device's own, whose arguments are others.
    """
    if call.place != 0 or call.name not in ("convolution", "_convolution"):
        return everywhere(call)
    weight, _, strides, paddings, dilations, transposed, extras = call.args[1:8]
    responses: dict[int, Response] = {}
    # A list of one number holds for all axes. `extras` are outputs that a transposed one adds.
    for number, kernel in enumerate(weight.shape[2:]):
        axis = 2 + number
        responses[axis] = _response_of_convolution(
            call.source.shape[axis],
            kernel,
            strides[number % len(strides)],
            paddings[number % len(paddings)],
            dilations[number % len(dilations)],
            bool(transposed),
            extras[number % len(extras)] if extras else 0,
        )
    return move_along(call, responses, mixes_channels=True)


@rule("max_pool2d_with_indices", "avg_pool2d", "max_pool2d")
def pool(call: Call) -> Spread:
    """Returns where a pooling depends on the feature map.

    The boxes are the input's, widened by the windows of rows and columns.
    """
    options = _options(call)
    kernels = options["kernel_size"]
    strides = options.get("stride") or kernels
    paddings = options.get("padding") or [0]
    dilations = options.get("dilation") or [1]  # a mean has none
    ceil_mode = bool(options.get("ceil_mode", False))
    responses: dict[int, Response] = {}
    # A list of one number holds for both axes.
    for number in range(2):
        axis = call.source.ndim - 2 + number
        # A window's maximum is 1 where it holds the row's 1; the window of a mean reaches as far.
        output = F.max_pool1d(
            _unit_rows(call, axis),
            kernels[number % len(kernels)],
            strides[number % len(strides)],
            paddings[number % len(paddings)],
            dilations[number % len(dilations)],
            ceil_mode=ceil_mode,
        )
        responses[axis] = _response(output[:, 0])
    return move_along(call, responses)


@rule("_adaptive_avg_pool2d", "adaptive_max_pool2d", "mkldnn_adaptive_avg_pool2d")
def adaptive_pool(call: Call) -> Spread:
    """Returns where a pooling to a stated size depends on the feature map.

    The boxes are the input's, widened by the windows.
    """
    responses: dict[int, Response] = {}
    # Windows are the same for a mean and a maximum.
    for axis in (len(call.shape) - 2, len(call.shape) - 1):
        output = F.adaptive_avg_pool1d(_unit_rows(call, axis), call.shape[axis])
        responses[axis] = _response(output[:, 0])
    return move_along(call, responses)


@rule("upsample_bilinear2d", "upsample_nearest2d", "upsample_bicubic2d")
@rule("_upsample_bilinear2d_aa", "_upsample_nearest_exact2d", "_upsample_bicubic2d_aa")
def resize(call: Call) -> Spread:
    """Returns where a resized image depends on the feature map.

    The boxes are the input's, widened by the interpolation. How far it reaches is asked of the
    operation itself, with the options of the call.
    """
    options = _options(call)
    corners = [options["align_corners"]] if "align_corners" in options else []  # nearest has none
    responses: dict[int, Response] = {}
    for axis, scale_name in ((2, "scales_h"), (3, "scales_w")):
        old_size = call.source.shape[axis]
        new_size = call.shape[axis]
        # Both axes are asked along columns: an image of one row with a channel for each index.
        image = torch.eye(old_size)[None, :, None]  # (1, n, 1, n)
        scales = (None, options.get(scale_name))  # of rows and of columns
        output = call.function(image, [1, new_size], *corners, *scales)
        responses[axis] = _response(output.reshape(old_size, new_size))
    return move_along(call, responses)


def _options(call: Call) -> dict[str, Any]:
    """The positional arguments of an operation by their names in aten, without those left out."""
    arguments = zip(call.function._schema.arguments, call.args, strict=False)
    return {argument.name: value for argument, value in arguments}


_PADDING_MODES = {
    "constant_pad_nd": "constant",
    "reflection_pad2d": "reflect",
    "replication_pad2d": "replicate",
}
"""Modes of `F.pad`, by operation."""


@rule(*_PADDING_MODES)
def pad(call: Call) -> Spread:
    """Returns where a padded image depends on the feature map.

    The boxes are the input's, shifted, and widened where the padding repeats the image.
    """
    padding = list(call.args[1])
    responses: dict[int, Response] = {}
    # Pairs of how many elements are added before and behind, those of the last axis first.
    for number, pair in enumerate(zip(padding[::2], padding[1::2], strict=True)):
        axis = call.source.ndim - 1 - number
        output = F.pad(_unit_rows(call, axis), pair, mode=_PADDING_MODES[call.name])
        responses[axis] = _response(output[:, 0])
    return move_along(call, responses)


@rule("pixel_shuffle")
def pixel_shuffle(call: Call) -> Spread:
    """Returns where `torch.pixel_shuffle` depends on the feature map.

    It makes factor × factor pixels of `factor²` channels of one pixel.
    """
    factor = call.args[1]
    responses: dict[int, Response] = {}
    for axis in (2, 3):
        first = torch.arange(call.source.shape[axis]) * factor
        responses[axis] = (first, first + factor - 1)
    return move_along(call, responses, mixes_channels=True)


@rule("pixel_unshuffle")
def pixel_unshuffle(call: Call) -> Spread:
    """Returns where `torch.pixel_unshuffle` depends on the feature map.

    It makes `factor²` channels of one pixel, the cell, of factor × factor pixels.
    """
    factor = call.args[1]
    responses: dict[int, Response] = {}
    for axis in (2, 3):
        cell = torch.arange(call.source.shape[axis]) // factor
        responses[axis] = (cell, cell)
    return move_along(call, responses, mixes_channels=True)


@rule("gather")
def gather(call: Call) -> Spread:
    """Returns where `torch.gather` depends on the feature map.

    The boxes are all places that its indices fill from the input's boxes. They are all of the
    result if the indices have no values, as on the device "meta".
    """
    indices = call.args[2]
    if call.place != 0 or indices.is_meta:
        return everywhere(call)
    axis = call.args[1] % call.source.ndim
    # The first and the last place along the axis, in any row, that each index is found at.
    indices = indices.cpu().movedim(axis, -1).reshape(-1, indices.shape[axis])
    places = torch.arange(indices.shape[1]).expand_as(indices).reshape(-1)
    indices = indices.reshape(-1)
    size = call.source.shape[axis]
    first = torch.full((size,), NOWHERE).scatter_reduce(0, indices, places, "amin")
    last = torch.full((size,), -1).scatter_reduce(0, indices, places, "amax")
    return move_along(call, {axis: (first, last)})
