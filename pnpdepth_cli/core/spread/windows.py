"""Rules of operations on windows of rows and columns, such as convolutions.

Which outputs an input element reaches is asked of the operation itself, on the rows of a unit
matrix.
"""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.core.spread.boxes import NOWHERE, Call, Spread, everywhere, full_range, rule

Response = tuple[Tensor, Tensor]
"""First and last output index (n,) that each of n input indices reaches."""


def move_along(
    call: Call, responses: dict[int, Response], *, mixes_channels: bool = False
) -> Spread:
    """Returns the boxes moved along some axes; with mixed channels, axis 1 becomes full."""
    axes = call.spread.axes()
    empty = call.spread.empty()
    for axis, (least, most) in responses.items():
        first, last = axes[axis]
        # The first output of any input from `first` on, and the last of any up to `last`.
        from_here = least.flip(0).cummin(0).values.flip(0)
        up_to_here = most.cummax(0).values
        first = from_here[first.clamp(max=len(least) - 1)].masked_fill(empty, NOWHERE)
        last = up_to_here[last.clamp(min=0)].masked_fill(empty, -1)
        axes[axis] = (first, last)
    if mixes_channels:
        axes[1] = full_range(call, 1)
    return Spread.from_axes(axes)


def _response(output: Tensor) -> Response:
    """The response from outputs (n, m) for the n rows of a unit matrix."""
    reached = output != 0
    indices = torch.arange(output.shape[1])
    first = torch.where(reached, indices, NOWHERE).amin(dim=1)
    last = torch.where(reached, indices, -1).amax(dim=1)
    return first, last


def _unit_rows(call: Call, axis: int) -> Tensor:
    """(n, 1, n): each of the n indices of the input along an axis as a row that is 1 there."""
    return torch.eye(call.source.shape[axis])[:, None]


@functools.lru_cache(maxsize=256)
def _response_of_convolution(
    size: int, kernel: int, stride: int, padding: int, dilation: int, transposed: bool, extra: int
) -> Response:
    rows = torch.eye(size)[:, None]
    weight = torch.ones(1, 1, kernel)
    groups = 1
    output = torch.convolution(
        rows, weight, None, [stride], [padding], [dilation], transposed, [extra], groups
    )
    return _response(output[:, 0])


@rule("convolution", "_convolution", "cudnn_convolution", "mkldnn_convolution")
def convolution(call: Call) -> Spread:
    """Returns boxes widened by the kernel; everything for the forms that are not decomposed."""
    if call.place != 0 or call.name not in ("convolution", "_convolution"):
        return everywhere(call)
    weight, _, strides, paddings, dilations, transposed, extras = call.args[1:8]
    responses: dict[int, Response] = {}
    # A list of one number holds for all axes. `extras` are rows that a transposed one adds.
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
    """Returns boxes widened by the windows of a pooling."""
    # Arguments: input, kernel, stride, padding, then dilation (of the largest only), ceil_mode.
    kernels, strides, paddings = ([*call.args[1:4], [], [], []])[:3]
    strides = strides or kernels
    paddings = paddings or [0]
    dilations = [1]
    ceil_place = 4
    if call.name.startswith("max"):
        ceil_place = 5
        if len(call.args) > 4:
            dilations = call.args[4] or [1]
    ceil_mode = bool(call.args[ceil_place]) if len(call.args) > ceil_place else False
    responses: dict[int, Response] = {}
    for number in range(2):
        axis = call.source.ndim - 2 + number
        # The largest of a unit row is where its window reaches, also for a mean.
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
    """Returns boxes widened by windows that are chosen for the size of the result."""
    responses: dict[int, Response] = {}
    for axis in (len(call.shape) - 2, len(call.shape) - 1):
        output = F.adaptive_avg_pool1d(_unit_rows(call, axis), call.shape[axis])
        responses[axis] = _response(output[:, 0])
    return move_along(call, responses)


@rule("upsample_bilinear2d", "upsample_nearest2d", "upsample_bicubic2d")
@rule("_upsample_bilinear2d_aa", "_upsample_nearest_exact2d", "_upsample_bicubic2d_aa")
def resize(call: Call) -> Spread:
    """Returns boxes widened by the interpolation, which is asked with its own options."""
    stated = zip(call.function._schema.arguments, call.args, strict=False)
    options = {argument.name: value for argument, value in stated}
    corners = [options["align_corners"]] if "align_corners" in options else []
    responses: dict[int, Response] = {}
    for axis, name in ((2, "scales_h"), (3, "scales_w")):
        size = call.source.shape[axis]
        wanted = call.shape[axis]
        rows = torch.eye(size)[None, :, None]  # (1, n, 1, n)
        output = call.function(rows, [1, wanted], *corners, None, options.get(name))
        responses[axis] = _response(output.reshape(size, wanted))
    return move_along(call, responses)


_PADDING_MODES = {
    "constant_pad_nd": "constant",
    "reflection_pad2d": "reflect",
    "replication_pad2d": "replicate",
}
"""Modes of `F.pad`, by operation."""


@rule(*_PADDING_MODES)
def pad(call: Call) -> Spread:
    """Returns boxes moved by the padding, and widened where it repeats elements."""
    padding = list(call.args[1])
    responses: dict[int, Response] = {}
    # Pairs of numbers before and behind, of the last axis first.
    for number, pair in enumerate(zip(padding[::2], padding[1::2], strict=True)):
        axis = call.source.ndim - 1 - number
        output = F.pad(_unit_rows(call, axis), pair, mode=_PADDING_MODES[call.name])
        responses[axis] = _response(output[:, 0])
    return move_along(call, responses)


@rule("pixel_shuffle")
def pixel_shuffle(call: Call) -> Spread:
    """Returns boxes where a cell becomes factor × factor pixels."""
    factor = call.args[1]
    responses: dict[int, Response] = {}
    for axis in (2, 3):
        first = torch.arange(call.source.shape[axis]) * factor
        responses[axis] = (first, first + factor - 1)
    return move_along(call, responses, mixes_channels=True)


@rule("pixel_unshuffle")
def pixel_unshuffle(call: Call) -> Spread:
    """Returns boxes where factor × factor pixels become a cell."""
    factor = call.args[1]
    responses: dict[int, Response] = {}
    for axis in (2, 3):
        cell = torch.arange(call.source.shape[axis]) // factor
        responses[axis] = (cell, cell)
    return move_along(call, responses, mixes_channels=True)


@rule("gather")
def gather(call: Call) -> Spread:
    """Returns boxes by the indices, such as those of a pooling; everything if they are unknown."""
    indices = call.args[2]
    if call.place != 0 or indices.is_meta:
        return everywhere(call)
    axis = call.args[1] % call.source.ndim
    # The first and the last place along the axis that each index is found at.
    indices = indices.cpu().movedim(axis, -1).reshape(-1, indices.shape[axis])
    places = torch.arange(indices.shape[1]).expand_as(indices).reshape(-1)
    indices = indices.reshape(-1)
    size = call.source.shape[axis]
    first = torch.full((size,), NOWHERE).scatter_reduce(0, indices, places, "amin")
    last = torch.full((size,), -1).scatter_reduce(0, indices, places, "amax")
    return move_along(call, {axis: (first, last)})
