"""Where the result of a tensor operation depends on an element of its input, by shapes alone.

A `Spread` has, for each of n rows (or columns) of a feature map, the box of a tensor's elements
that depend on that row. Every operation moves the boxes: a convolution widens them, `cat` shifts
them, a softmax fills an axis. An operation without a rule fills everything, so that no field comes
out too small.

A rule is a function with the decorator `rule`, which names its operations: of `windows`, `sums` or
`views`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload

from pnpdepth_cli.core.spread import sums, views, windows
from pnpdepth_cli.core.spread.boxes import RULES, Call, Spread, everywhere, pointwise

__all__ = ["Spread", "spread_of", "sums", "views", "windows"]

_NO_GRADIENT = frozenset(
    {"round", "floor", "ceil", "trunc", "sign", "sgn", "frac", "floor_divide", "bernoulli"}
)
"""Operations through which no gradient comes back."""

_OVERWRITTEN = frozenset({"zero", "fill", "resize"})
"""Operations after which nothing of their input is left."""


def spread_of(
    func: OpOverload, args: Sequence[Any], place: int | None, source: Tensor, spread: Spread,
    result: Tensor, number: int,
) -> Spread | None:  # fmt: skip
    """Returns which elements of an operation's result depend on each row of a feature map.

    None if none does: nothing of the input comes through the operation.

    Args:
        func: The operation.
        args: Its positional arguments.
        place: Number of the input among them; None where it is in a list or a keyword.
        source: The input.
        spread: Boxes of the input's elements that depend on each row of the feature map.
        result: The result, or one of several.
        number: Number of the result, 0 for the only one.
    """
    name = func._opname.rstrip("_")  # that of the operation in place is `name_`
    # Through some operations nothing comes.
    if name in _NO_GRADIENT or not result.is_floating_point():
        return None
    if name in _OVERWRITTEN or name.startswith("new_") or name.endswith("_like"):
        return None  # these read no values
    if name == "copy" and place == 0:  # what is overwritten
        return None
    # The others move the boxes by their rule; one without a rule, by what torch says of it.
    shape = tuple(result.shape) or (1,)  # a number is an axis of one
    call = Call(name, func, args, place, source, spread, shape)
    if source.ndim == 0 or result.ndim == 0:
        return everywhere(call)
    if name in views.PARTITIONS:
        return views.part_of(call, number)
    if number:  # such as the indices of a pooling
        return everywhere(call)
    if name in RULES:
        return RULES[name](call)
    if torch.Tag.pointwise in func.tags:
        return pointwise(call)
    return everywhere(call)
