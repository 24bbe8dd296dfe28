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
    """Boxes of a tensor with d axes, one for each of n rows of a feature map.

    first, last: (n, d) indices along each axis, the last one included.
    """

    first: Tensor
    last: Tensor

    @classmethod
    def of_axis(cls, shape: Sequence[int], axis: int) -> Spread:
        """Returns, for each index along an axis of a feature map, the box of its elements."""
        count = shape[axis]
        spread = cls.whole(shape, count)
        spread.first[:, axis] = torch.arange(count)
        spread.last[:, axis] = torch.arange(count)
        return spread

    @classmethod
    def whole(cls, shape: Sequence[int], count: int) -> Spread:
        """Returns `count` boxes that are all of a tensor of this shape."""
        last = torch.tensor([max(size, 1) - 1 for size in shape], dtype=torch.long)
        return cls(torch.zeros(count, len(shape), dtype=torch.long), last.repeat(count, 1))

    @classmethod
    def from_axes(cls, axes: Sequence[AxisRange]) -> Spread:
        """Returns boxes from their ranges along each axis; one empty range empties the box.

        At least one axis is given.
        """
        first = torch.stack([axis_first for axis_first, _ in axes], dim=1)
        last = torch.stack([axis_last for _, axis_last in axes], dim=1)
        empty = (first > last).any(dim=1, keepdim=True)
        return cls(first.masked_fill(empty, NOWHERE), last.masked_fill(empty, -1))

    def axes(self) -> list[AxisRange]:
        """The ranges along each axis."""
        return list(zip(self.first.unbind(1), self.last.unbind(1), strict=True))

    def empty(self) -> Tensor:
        """Which of the boxes (n,) have no element."""
        return self.last[:, 0] < 0

    def joined(self, other: Spread | None) -> Spread:
        """Returns the smallest boxes around these and others of the same tensor."""
        if other is None:
            return self
        return Spread(self.first.minimum(other.first), self.last.maximum(other.last))


class Call(NamedTuple):
    """An operation on tensors, with one of its inputs whose spread is known.

    args: its positional arguments. place: number of the input among them; None in a list or a
    keyword. source: the input. spread: that of the input. shape: shape of the result.
    """

    name: str
    function: OpOverload
    args: Sequence[Any]
    place: int | None
    source: Tensor
    spread: Spread
    shape: tuple[int, ...]


Rule = Callable[[Call], Spread]
"""Takes an operation to the spread of its result."""

RULES: dict[str, Rule] = {}
"""How boxes move, by the name of the operation."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Enters the decorated function for operations of these names."""

    def enter(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return enter


def full_range(call: Call, axis: int) -> AxisRange:
    """Returns all indices along an axis of the result, for boxes that are not empty."""
    empty = call.spread.empty()
    first = torch.zeros(len(empty), dtype=torch.long)
    last = torch.full((len(empty),), max(call.shape[axis], 1) - 1)
    return first.masked_fill(empty, NOWHERE), last.masked_fill(empty, -1)


def everywhere(call: Call) -> Spread:
    """Returns boxes for operations whose every result depends on every element of the input."""
    return Spread.from_axes([full_range(call, axis) for axis in range(len(call.shape))])


@rule("detach", "alias", "to", "_to_copy", "clone", "copy", "lift_fresh", "expand")
@rule("where", "masked_fill", "addcmul", "lerp", "prelu", "_prelu_kernel", "native_dropout")
@rule("native_batch_norm", "_native_batch_norm_legit", "_native_batch_norm_legit_no_training")
def pointwise(call: Call) -> Spread:
    """Returns boxes of results that depend on one element of the input, which may be broadcast."""
    if "batch_norm" in call.name and (call.place != 0 or call.args[5] is True):  # it trains
        return everywhere(call)
    new_axes = len(call.shape) - call.source.ndim
    if new_axes < 0:
        return everywhere(call)
    axes = [full_range(call, axis) for axis in range(new_axes)]
    for axis, axis_range in enumerate(call.spread.axes(), start=new_axes):
        is_repeated = call.source.shape[axis - new_axes] == 1 < call.shape[axis]
        axes.append(full_range(call, axis) if is_repeated else axis_range)
    return Spread.from_axes(axes)
