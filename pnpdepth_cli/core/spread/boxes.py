"""Boxes of a tensor's elements, the operation that moves them, and the table of rules for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch._ops import OpOverload

NOWHERE = 1 << 40
"""First index of an empty box; its last one is -1."""

AxisRange = tuple[Tensor, Tensor]
"""First and last indices (n,) of n boxes along one axis, the last ones included."""


class Spread(NamedTuple):
    """Boxes of a tensor with d axes: the elements that depend on each of n rows of a feature map.

    The rows may also be its columns, or there is one box for all of it.
    """

    first: Tensor
    """(n, d) the least indices of each box along each axis; `NOWHERE` for an empty box."""
    last: Tensor
    """(n, d) the largest indices, which belong to the box; −1 for an empty box."""

    @classmethod
    def of_axis(cls, shape: Sequence[int], axis: int) -> Spread:
        """Returns, for each row of a feature map, the box of its elements in that map.

        Args:
            shape: Shape of the feature map.
            axis: Axis along which the rows are counted, 2 for rows and 3 for columns.
        """
        count = shape[axis]
        spread = cls.whole(shape, count)
        spread.first[:, axis] = torch.arange(count)
        spread.last[:, axis] = torch.arange(count)
        return spread

    @classmethod
    def whole(cls, shape: Sequence[int], count: int) -> Spread:
        """Returns `count` boxes, each of which is all of a tensor of this shape."""
        last = torch.tensor([max(size, 1) - 1 for size in shape], dtype=torch.long)
        return cls(torch.zeros(count, len(shape), dtype=torch.long), last.repeat(count, 1))

    @classmethod
    def from_axes(cls, axes: Sequence[AxisRange]) -> Spread:
        """Returns n boxes from their ranges along each axis; one empty range empties the box.

        Args:
            axes: Range of the n boxes along each axis, one axis or more.
        """
        first = torch.stack([axis_first for axis_first, _ in axes], dim=1)
        last = torch.stack([axis_last for _, axis_last in axes], dim=1)
        empty = (first > last).any(dim=1, keepdim=True)
        return cls(first.masked_fill(empty, NOWHERE), last.masked_fill(empty, -1))

    def axes(self) -> list[AxisRange]:
        """Returns the ranges of the n boxes along each axis; the inverse of `from_axes`."""
        return list(zip(self.first.unbind(1), self.last.unbind(1), strict=True))

    def empty(self) -> Tensor:
        """Returns (n,) bool, whether each box has no element."""
        return self.last[:, 0] < 0

    def joined(self, other: Spread | None) -> Spread:
        """Returns the smallest boxes around these and others of the same tensor; None: no others.

        Empty boxes need no case of their own: `NOWHERE` and −1 are never the least and largest.
        """
        if other is None:
            return self
        return Spread(self.first.minimum(other.first), self.last.maximum(other.last))


class Call(NamedTuple):
    """An operation on tensors, with one of its inputs whose spread is known."""

    name: str
    """Name of the operation in torch's library aten, without `_` at its end."""
    function: OpOverload
    """The operation itself."""
    args: Sequence[Any]
    """Its positional arguments, in aten's order; those at the end may be left to their defaults."""
    place: int | None
    """Number of the input among them; None in a list or a keyword."""
    source: Tensor
    """The input."""
    spread: Spread
    """Boxes of the input's elements that depend on each row of a feature map."""
    shape: tuple[int, ...]
    """Shape of the result; (1,) for a number."""


Rule = Callable[[Call], Spread]
"""Takes an operation to the boxes of its result, one for each box of its input."""

RULES: dict[str, Rule] = {}
"""How boxes move, by the name of the operation."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Returns a decorator that enters a function in `RULES` for operations of these names."""

    def enter(function: Rule) -> Rule:
        """Returns the function itself, after it was entered."""
        RULES.update(dict.fromkeys(names, function))
        return function

    return enter


def full_range(call: Call, axis: int) -> AxisRange:
    """Returns the range of all indices along an axis of the result; empty boxes stay empty."""
    empty = call.spread.empty()
    first = torch.zeros(len(empty), dtype=torch.long)
    last = torch.full((len(empty),), max(call.shape[axis], 1) - 1)
    return first.masked_fill(empty, NOWHERE), last.masked_fill(empty, -1)


def everywhere(call: Call) -> Spread:
    """Returns where a result depends on the feature map, each element on any of the input's.

    Each box is all of the result, but for those that were empty.
    """
    return Spread.from_axes([full_range(call, axis) for axis in range(len(call.shape))])


@rule("detach", "alias", "to", "_to_copy", "clone", "copy", "lift_fresh", "expand")
@rule("where", "masked_fill", "addcmul", "lerp", "prelu", "_prelu_kernel", "native_dropout")
@rule("native_batch_norm", "_native_batch_norm_legit", "_native_batch_norm_legit_no_training")
def pointwise(call: Call) -> Spread:
    """Returns where a result depends on the feature map, each element on its own of the input's.

    The boxes are the input's, full along axes that are broadcast.
    """
    if "batch_norm" in call.name:
        # Argument 0 is what is normalised. Argument 5 is `training`: with it, elements are
        # normalised by all others.
        is_training = call.args[5] is True
        if call.place != 0 or is_training:
            return everywhere(call)
    # Axes of the result that the input has not are in front of those that it has.
    new_axes = len(call.shape) - call.source.ndim
    if new_axes < 0:  # an operation that drops axes does not broadcast
        return everywhere(call)
    axes = [full_range(call, axis) for axis in range(new_axes)]
    for axis, axis_range in enumerate(call.spread.axes(), start=new_axes):
        is_broadcast = call.source.shape[axis - new_axes] == 1 and call.shape[axis] > 1
        axes.append(full_range(call, axis) if is_broadcast else axis_range)
    return Spread.from_axes(axes)
