"""Rules of operations that arrange the same numbers in other axes, or leave some out."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pnpdepth_cli.core.spread.boxes import (
    NOWHERE,
    AxisRange,
    Call,
    Spread,
    everywhere,
    full_range,
    rule,
)

PARTITIONS = ("split", "split_with_sizes", "unbind", "unsafe_split")
"""Operations whose results are parts of their input."""


def part_of(call: Call, number: int) -> Spread:
    """Returns where one result of an operation of `PARTITIONS` depends on the feature map.

    Args:
        call: The operation; its `shape` is that of this part.
        number: Number of this part, from 0.
    """
    if call.name == "unbind":  # parts are `tensor[number]` along an axis
        axis = _stated_axis(call, 1, call.source.ndim)
        return select(call._replace(args=(call.source, axis, number)))
    axis = _stated_axis(call, 2, call.source.ndim)
    sizes = call.args[1]  # one size of all parts, or the size of each
    start = number * sizes if isinstance(sizes, int) else sum(sizes[:number])
    return Spread.from_axes(_crop(call, axis, start, 1, call.shape[axis]))


def _stated_axis(call: Call, number: int, axes: int) -> int:
    """The axis that an argument states, counted from 0; 0 where it is left out, as torch has it.

    Args:
        call: The operation.
        number: Number of the argument.
        axes: How many axes the tensor has, from whose end a negative axis is counted.
    """
    stated = call.args[number] if len(call.args) > number else 0
    return int(stated % axes)


@rule("cat")
def concatenate(call: Call) -> Spread:
    """Returns where `torch.cat` depends on the feature map: the input's boxes, shifted.

    They are shifted to where the input lies in the result. If it is given several times, they reach
    over all its places.
    """
    axis = _stated_axis(call, 1, len(call.shape))
    offset = 0  # elements along the axis in front of the tensor at hand
    spread: Spread | None = None
    for tensor in call.args[0]:
        if tensor is call.source:
            axes = call.spread.axes()
            first, last = axes[axis]
            # An empty box keeps its last index of −1; any larger first one leaves it empty.
            last = torch.where(call.spread.empty(), last, last + offset)
            axes[axis] = (first + offset, last)
            spread = Spread.from_axes(axes).joined(spread)
        # torch skips an empty tensor of another number of axes.
        offset += tensor.shape[axis] if tensor.ndim == len(call.shape) else 0
    return everywhere(call) if spread is None else spread


@rule("stack")
def stack(call: Call) -> Spread:
    """Returns where `torch.stack` depends on the feature map: the input's boxes, with a new axis.

    Along it the boxes reach from the first to the last place of the input, which may be given
    several times.
    """
    axis = _stated_axis(call, 1, len(call.shape))
    places = [place for place, tensor in enumerate(call.args[0]) if tensor is call.source]
    if not places:  # it came another way, such as through a keyword
        return everywhere(call)
    # A box that is empty stays so: its last place is before its first.
    empty = call.spread.empty()
    first = torch.full((len(empty),), places[0]).masked_fill(empty, NOWHERE)
    last = torch.full((len(empty),), places[-1]).masked_fill(empty, -1)
    axes = call.spread.axes()
    axes.insert(axis, (first, last))
    return Spread.from_axes(axes)


def _crop(call: Call, axis: int, start: int, step: int, count: int) -> list[AxisRange]:
    """The ranges of boxes, where along one axis only some indices of the input are kept.

    Args:
        call: The operation.
        axis: The axis.
        start: First index that is kept.
        step: Distance between indices that are kept.
        count: How many are kept. A box none of whose indices is kept gets its first behind its last
            one, by which `Spread.from_axes` knows it is empty.
    """
    axes = call.spread.axes()
    empty = call.spread.empty()
    first, last = axes[axis]
    # The first index that is kept at or behind `first`, and the last one up to `last`, both
    # counted among those that are kept: a division by the step, rounded up and down.
    first = (first - start + step - 1).div(step, rounding_mode="floor").clamp(min=0)
    last = (last - start).div(step, rounding_mode="floor").clamp(max=count - 1)
    axes[axis] = (first.masked_fill(empty, NOWHERE), last.masked_fill(empty, -1))
    return axes


@rule("slice")
def slice_(call: Call) -> Spread:
    """Returns where `tensor[start:end:step]`, along an axis, depends on the feature map.

    The boxes are what the slice keeps of the input's.
    """
    # aten's arguments behind the input, of which the last ones may be left to their defaults. The
    # end is not needed: the result has its size.
    defaults = (0, None, None, 1)
    stated = tuple(call.args[1:])
    axis, start, _, step = stated + defaults[len(stated) :]
    axis %= call.source.ndim
    size = call.source.shape[axis]
    if start is None:
        start = 0
    elif start < 0:  # counted from the end
        start += size
    start = min(max(start, 0), size)
    return Spread.from_axes(_crop(call, axis, start, step, call.shape[axis]))


@rule("select")
def select(call: Call) -> Spread:
    """Returns where `tensor[index]`, along an axis, depends on the feature map.

    The boxes are the input's without that axis, and empty where they do not contain the index.
    """
    axis = call.args[1] % call.source.ndim
    index = call.args[2] % call.source.shape[axis]
    axes = _crop(call, axis, index, step=1, count=1)
    # A box that the index misses is empty. As the axis goes, the first one left has to say so;
    # there is one, since `spread_of` sends no result without axes here.
    first, last = axes.pop(axis)
    missed = first > last
    first, last = axes[0]
    axes[0] = (first.masked_fill(missed, NOWHERE), last.masked_fill(missed, -1))
    return Spread.from_axes(axes)


@rule("permute")
def permute(call: Call) -> Spread:
    """Returns where `tensor.permute(order)` depends on the feature map.

    The boxes are the input's, with axes in that order.
    """
    axes = call.spread.axes()
    return Spread.from_axes([axes[axis % call.source.ndim] for axis in call.args[1]])


@rule("transpose")
def transpose(call: Call) -> Spread:
    """Returns where `tensor.transpose(first, second)` depends on the feature map.

    The boxes are the input's, with these two axes exchanged.
    """
    axes = call.spread.axes()
    first, second = (axis % call.source.ndim for axis in call.args[1:3])
    axes[first], axes[second] = axes[second], axes[first]
    return Spread.from_axes(axes)


@rule("t", "numpy_T")
def reverse_axes(call: Call) -> Spread:
    """Returns where `tensor.T` depends on the feature map: the input's boxes, axes reversed."""
    return Spread.from_axes(call.spread.axes()[::-1])


@rule("flip")
def flip(call: Call) -> Spread:
    """Returns where `tensor.flip(axes)` depends on the feature map.

    The boxes are the input's, mirrored along these axes.
    """
    axes = call.spread.axes()
    empty = call.spread.empty()
    for stated_axis in call.args[1]:
        axis = stated_axis % call.source.ndim
        first, last = axes[axis]
        end = call.shape[axis] - 1
        axes[axis] = (
            (end - last).masked_fill(empty, NOWHERE),
            (end - first).masked_fill(empty, -1),
        )
    return Spread.from_axes(axes)


@rule("repeat")
def repeat(call: Call) -> Spread:
    """Returns where `tensor.repeat(repeats)` depends on the feature map.

    The boxes are the input's, full along axes that are repeated or new.
    """
    repeats = call.args[1]
    source_axes = call.spread.axes()
    new_axes = len(repeats) - len(source_axes)
    axes = [full_range(call, axis) for axis in range(new_axes)]
    for axis, axis_range in enumerate(source_axes, start=new_axes):
        axes.append(axis_range if repeats[axis] == 1 else full_range(call, axis))
    return Spread.from_axes(axes)


@rule("view", "_unsafe_view", "reshape", "_reshape_alias", "squeeze", "unsqueeze", "flatten")
def reshape(call: Call) -> Spread:
    """Returns where a tensor of another shape depends on the feature map.

    Its elements and their order are the input's, as where (2, 3, 4) becomes (6, 4) or (2, 12). Both
    shapes fall into groups of neighbouring axes with equally many elements, such as (2, 3) and (6).
    Each group is moved by itself.
    """
    old_sizes = list(call.source.shape)
    new_sizes = list(call.shape)
    elements = math.prod(old_sizes)
    if not elements or elements != math.prod(new_sizes):  # such as a view as another type
        return everywhere(call)
    old_axes = call.spread.axes()
    new_axes: list[AxisRange] = []
    while old_sizes or new_sizes:
        group = _first_group(old_sizes, new_sizes)
        new_axes += _regroup(old_axes[: len(group.old)], group, call.spread.empty())
        old_sizes = old_sizes[len(group.old) :]
        new_sizes = new_sizes[len(group.new) :]
        old_axes = old_axes[len(group.old) :]
    return Spread.from_axes(new_axes)


class _Group(NamedTuple):
    """Sizes of neighbouring axes of two shapes with equally many elements."""

    old: list[int]
    new: list[int]


def _first_group(old_sizes: list[int], new_sizes: list[int]) -> _Group:
    """The fewest first axes of two shapes that have equally many elements in both.

    Args:
        old_sizes: Sizes of the axes of one shape.
        new_sizes: Sizes of the axes of the other, which has as many elements in all.
    """
    old = old_sizes[:1]
    new = new_sizes[:1]
    while math.prod(old) != math.prod(new):
        if math.prod(old) < math.prod(new):
            old = old_sizes[: len(old) + 1]
        else:
            new = new_sizes[: len(new) + 1]
    return _Group(old, new)


def _regroup(axes: list[AxisRange], group: _Group, empty: Tensor) -> list[AxisRange]:
    """The ranges of n boxes along the new axes of a group.

    Args:
        axes: Ranges along its old axes.
        group: Sizes of its axes.
        empty: (n,) bool, whether a box is empty.
    """
    if group.old == group.new:
        return axes
    # The first and the last element of each box, counted through the whole group.
    first = torch.zeros(len(empty), dtype=torch.long)
    last = torch.zeros(len(empty), dtype=torch.long)
    for (axis_first, axis_last), size in zip(axes, group.old, strict=True):
        first = first * size + axis_first.masked_fill(empty, 0)
        last = last * size + axis_last.masked_fill(empty, 0)
    # Their indices along the new axes, outermost first.
    new_axes: list[AxisRange] = []
    is_one_index = torch.ones(len(empty), dtype=torch.bool)  # of every axis so far, of each box
    inner = math.prod(group.new)  # elements for each index of the axis at hand
    for size in group.new:
        inner //= max(size, 1)
        # Behind the first axis with several indices a box may have any index.
        low = torch.where(is_one_index, first // inner, 0)
        high = torch.where(is_one_index, last // inner, size - 1)
        new_axes.append((low.masked_fill(empty, NOWHERE), high.masked_fill(empty, -1)))
        is_one_index = is_one_index & (low == high)
        first = first % inner
        last = last % inner
    return new_axes
