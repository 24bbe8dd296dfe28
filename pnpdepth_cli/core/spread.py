"""Where the result of a tensor operation depends on an element of its input, by shapes alone.

A `Spread` has, for each of n rows (or columns) of a feature map, the box of a tensor's elements
that depend on that row. Every operation moves the boxes: a convolution widens them, `cat` shifts
them, a softmax fills an axis. An operation without a rule fills everything, so that no field comes
out too small.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch._ops import OpOverload

_NOWHERE = 1 << 40
"""First index of an empty box; its last one is -1."""


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
        spread.first[:, axis] = spread.last[:, axis] = torch.arange(count)
        return spread

    @classmethod
    def whole(cls, shape: Sequence[int], count: int) -> Spread:
        """Returns `count` boxes that are all of a tensor of this shape."""
        last = torch.tensor([max(size, 1) - 1 for size in shape], dtype=torch.long)
        return cls(torch.zeros(count, len(shape), dtype=torch.long), last.repeat(count, 1))

    @classmethod
    def from_axes(cls, axes: Sequence[tuple[Tensor, Tensor]]) -> Spread:
        """Returns boxes from first and last indices (n,) along each axis; one empty axis empties.

        At least one axis is given.
        """
        first = torch.stack([axis[0] for axis in axes], dim=1)
        last = torch.stack([axis[1] for axis in axes], dim=1)
        empty = (first > last).any(dim=1, keepdim=True)
        return cls(first.masked_fill(empty, _NOWHERE), last.masked_fill(empty, -1))

    def axes(self) -> list[tuple[Tensor, Tensor]]:
        """The first and last indices (n,) along each axis."""
        return list(zip(self.first.unbind(1), self.last.unbind(1), strict=True))

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


_Rule = Callable[[Call], Spread]
_Axes = list[tuple[Tensor, Tensor]]

_RULES: dict[str, _Rule] = {}
"""How boxes move, by the name of the operation."""

_NO_GRADIENT = frozenset(
    {"round", "floor", "ceil", "trunc", "sign", "sgn", "frac", "floor_divide", "bernoulli"}
)
"""Operations through which no gradient comes back."""

_OVERWRITTEN = frozenset({"zero", "fill", "resize"})
"""Operations after which nothing of their input is left."""


def spread_of(
    func: OpOverload, args: Sequence[Any], index: int | None, source: Tensor, spread: Spread,
    result: Tensor, position: int,
) -> Spread | None:  # fmt: skip
    """Returns where a result of an operation depends on an input; None if nowhere.

    Args:
        func: The operation.
        args: Its positional arguments.
        index: Number of the input among them; None where it is in a list or a keyword.
        source: The input.
        spread: That of the input.
        result: The result, or one of several.
        position: Number of the result.
    """
    name = func._opname.rstrip("_")
    if name in _NO_GRADIENT or not result.is_floating_point():
        return None
    if name in _OVERWRITTEN or name.startswith("new_") or name.endswith("_like"):
        return None  # these read no values
    if name == "copy" and index == 0:  # what is overwritten
        return None
    shape = tuple(result.shape) or (1,)  # a number is an axis of one
    call = Call(name, func, args, index, source, spread, shape)
    if source.ndim == 0 or result.ndim == 0 or (position and name not in _PARTS):
        return _everywhere(call)
    if name in _PARTS:
        return _part(call, position)
    rule = _RULES.get(name)
    if rule is None:
        rule = _pointwise if torch.Tag.pointwise in func.tags else _everywhere
    return rule(call)


def _rule(*names: str) -> Callable[[_Rule], _Rule]:
    """Enters the decorated function for operations of these names."""

    def enter(function: _Rule) -> _Rule:
        _RULES.update(dict.fromkeys(names, function))
        return function

    return enter


def _full(call: Call, axis: int) -> tuple[Tensor, Tensor]:
    """All indices along an axis of the result, for boxes that are not empty."""
    empty = call.spread.last[:, 0] < 0
    first = torch.zeros(len(empty), dtype=torch.long)
    last = torch.full((len(empty),), max(call.shape[axis], 1) - 1)
    return first.masked_fill(empty, _NOWHERE), last.masked_fill(empty, -1)


def _everywhere(call: Call) -> Spread:
    """Every element of the result depends on every one of the input."""
    return Spread.from_axes([_full(call, axis) for axis in range(len(call.shape))])


@_rule("detach", "alias", "to", "_to_copy", "clone", "copy", "lift_fresh", "expand")
@_rule("where", "masked_fill", "addcmul", "lerp", "prelu", "_prelu_kernel", "native_dropout")
@_rule("native_batch_norm", "_native_batch_norm_legit", "_native_batch_norm_legit_no_training")
def _pointwise(call: Call) -> Spread:
    """An element depends on the same element of the input, which may be broadcast."""
    if "batch_norm" in call.name and (call.place != 0 or call.args[5] is True):  # it trains
        return _everywhere(call)
    missing = len(call.shape) - call.source.ndim
    if missing < 0:
        return _everywhere(call)
    axes = [_full(call, axis) for axis in range(missing)]
    for axis, own in enumerate(call.spread.axes(), start=missing):
        repeated = call.source.shape[axis - missing] == 1 < call.shape[axis]
        axes.append(_full(call, axis) if repeated else own)
    return Spread.from_axes(axes)


# Operations on windows of rows and columns: which outputs an input element reaches is asked of the
# operation itself, on the rows of a unit matrix.

_Response = tuple[Tensor, Tensor]
"""First and last output index (n,) that each of n input indices reaches."""


def _windows(
    call: Call, responses: dict[int, _Response], *, mixes_channels: bool = False
) -> Spread:
    """Boxes moved along some axes by responses; with mixed channels, axis 1 becomes full."""
    axes = call.spread.axes()
    empty = call.spread.last[:, 0] < 0
    for axis, (least, most) in responses.items():
        first, last = axes[axis]
        # The first output of any input from `first` on, and the last of any up to `last`.
        from_here = least.flip(0).cummin(0).values.flip(0)
        up_to_here = most.cummax(0).values
        first = from_here[first.clamp(max=len(least) - 1)].masked_fill(empty, _NOWHERE)
        last = up_to_here[last.clamp(min=0)].masked_fill(empty, -1)
        axes[axis] = first, last
    if mixes_channels:
        axes[1] = _full(call, 1)
    return Spread.from_axes(axes)


def _response(output: Tensor) -> _Response:
    """The response from outputs (n, m) for the n rows of a unit matrix."""
    reached = output != 0
    indices = torch.arange(output.shape[1])
    least = torch.where(reached, indices, _NOWHERE).amin(dim=1)
    return least, torch.where(reached, indices, -1).amax(dim=1)


@functools.lru_cache(maxsize=256)
def _convolved(
    size: int, kernel: int, stride: int, padding: int, dilation: int, transposed: bool, more: int
) -> _Response:
    inputs, weight = torch.eye(size)[:, None], torch.ones(1, 1, kernel)
    numbers = [stride], [padding], [dilation], transposed, [more]
    return _response(torch.convolution(inputs, weight, None, *numbers, 1)[:, 0])


@_rule("convolution", "_convolution", "cudnn_convolution", "mkldnn_convolution")
def _convolution(call: Call) -> Spread:
    if call.place != 0 or call.name not in ("convolution", "_convolution"):
        return _everywhere(call)
    weight, _, stride, padding, dilation, transposed, more = call.args[1:8]
    responses = {}
    for number, kernel in enumerate(weight.shape[2:]):
        at = [values[number % len(values)] for values in (stride, padding, dilation)]
        extra = more[number % len(more)] if more else 0
        size = call.source.shape[2 + number]
        responses[2 + number] = _convolved(size, kernel, *at, bool(transposed), extra)
    return _windows(call, responses, mixes_channels=True)


@_rule("max_pool2d_with_indices", "avg_pool2d", "max_pool2d")
def _pool(call: Call) -> Spread:
    kernel, stride, padding = ([*call.args[1:4], *[[]] * 3])[:3]
    largest = call.name.startswith("max")
    dilation = call.args[4] if largest and len(call.args) > 4 else [1]
    ceil = bool(call.args[5 if largest else 4]) if len(call.args) > (5 if largest else 4) else False
    responses = {}
    for number in range(2):
        axis = call.source.ndim - 2 + number
        steps, pads, holes = stride or kernel, padding or [0], dilation or [1]
        each = (kernel, steps, pads, holes)
        k, s, p, d = (values[number % len(values)] for values in each)
        ones = torch.eye(call.source.shape[axis])[:, None]
        responses[axis] = _response(F.max_pool1d(ones, k, s, p, d, ceil_mode=ceil)[:, 0])
    return _windows(call, responses)


@_rule("_adaptive_avg_pool2d", "adaptive_max_pool2d", "mkldnn_adaptive_avg_pool2d")
def _adaptive_pool(call: Call) -> Spread:
    responses = {}
    for axis in (len(call.shape) - 2, len(call.shape) - 1):
        ones = torch.eye(call.source.shape[axis])[:, None]
        responses[axis] = _response(F.adaptive_avg_pool1d(ones, call.shape[axis])[:, 0])
    return _windows(call, responses)


@_rule("upsample_bilinear2d", "upsample_nearest2d", "upsample_bicubic2d")
@_rule("_upsample_bilinear2d_aa", "_upsample_nearest_exact2d", "_upsample_bicubic2d_aa")
def _resize(call: Call) -> Spread:
    stated = zip(call.function._schema.arguments, call.args, strict=False)
    options = {argument.name: value for argument, value in stated}
    corners = [options["align_corners"]] if "align_corners" in options else []
    responses = {}
    for axis, name in ((2, "scales_h"), (3, "scales_w")):
        size, wanted = call.source.shape[axis], call.shape[axis]
        rows = torch.eye(size)[None, :, None]  # (1, n, 1, n)
        output = call.function(rows, [1, wanted], *corners, None, options.get(name))
        responses[axis] = _response(output.reshape(size, wanted))
    return _windows(call, responses)


@_rule("constant_pad_nd", "reflection_pad2d", "replication_pad2d")
def _pad(call: Call) -> Spread:
    mode = {"c": "constant", "r": "reflect"}[call.name[0]]
    mode = "replicate" if call.name.startswith("repl") else mode
    pairs, responses = list(call.args[1]), {}
    for number, pair in enumerate(zip(pairs[::2], pairs[1::2], strict=True)):
        axis = call.source.ndim - 1 - number
        ones = torch.eye(call.source.shape[axis])[:, None]
        responses[axis] = _response(F.pad(ones, pair, mode=mode)[:, 0])
    return _windows(call, responses)


@_rule("pixel_shuffle", "pixel_unshuffle")
def _shuffle(call: Call) -> Spread:
    responses = {}
    for axis in (2, 3):
        indices = torch.arange(call.source.shape[axis])
        factor = call.args[1]
        least = indices * factor if call.name == "pixel_shuffle" else indices // factor
        responses[axis] = least, least + (factor - 1 if call.name == "pixel_shuffle" else 0)
    return _windows(call, responses, mixes_channels=True)


# Products and sums.


@_rule("mm", "bmm", "addmm", "baddbmm", "linear")
def _product(call: Call) -> Spread:
    """Rows of the left factor and columns of the right one stay; what is summed becomes full."""
    left = 1 if call.name in ("addmm", "baddbmm") else 0
    if call.place is None or call.place < left:
        return _pointwise(call) if call.place is not None else _everywhere(call)
    if call.name == "linear" and call.place:
        return _everywhere(call)
    axes = call.spread.axes()
    summed = len(axes) - (1 if call.place == left else 2)
    axes[summed] = _full(call, summed)
    return Spread.from_axes(axes)


@_rule("mean", "sum", "amax", "amin", "logsumexp", "prod", "var", "std")
def _reduce(call: Call) -> Spread:
    stated = call.args[1] if len(call.args) > 1 else None
    stated = [stated] if isinstance(stated, int) else stated
    if not isinstance(stated, list | tuple) or not stated:
        return _everywhere(call)
    summed = {axis % call.source.ndim for axis in stated}
    axes = list[tuple[Tensor, Tensor]]()
    keeps = len(call.shape) == call.source.ndim
    for axis, own in enumerate(call.spread.axes()):
        if axis not in summed:
            axes.append(own)
        elif keeps:
            axes.append(_full(call, axis))
    return Spread.from_axes(axes) if len(axes) == len(call.shape) else _everywhere(call)


@_rule("_softmax", "_log_softmax", "_safe_softmax", "cumsum")
def _along_axis(call: Call) -> Spread:
    axes, axis = call.spread.axes(), call.args[1] % call.source.ndim
    axes[axis] = _full(call, axis)
    return Spread.from_axes(axes)


@_rule("native_layer_norm")
def _layer_norm(call: Call) -> Spread:
    if call.place != 0:
        return _everywhere(call)
    axes = call.spread.axes()
    for axis in range(len(axes) - len(call.args[1]), len(axes)):
        axes[axis] = _full(call, axis)
    return Spread.from_axes(axes)


# Other views of the same numbers.


@_rule("cat")
def _cat(call: Call) -> Spread:
    axis = (call.args[1] if len(call.args) > 1 else 0) % len(call.shape)
    offset, found = 0, None
    for part in call.args[0]:
        if part is call.source:
            axes = call.spread.axes()
            empty = call.spread.last[:, 0] < 0
            first, last = axes[axis]
            axes[axis] = first + offset, torch.where(empty, last, last + offset)
            found = Spread.from_axes(axes).joined(found)
        offset += part.shape[axis] if part.ndim == len(call.shape) else 0
    return _everywhere(call) if found is None else found


@_rule("stack")
def _stack(call: Call) -> Spread:
    axis = (call.args[1] if len(call.args) > 1 else 0) % len(call.shape)
    places = [place for place, part in enumerate(call.args[0]) if part is call.source]
    if not places:
        return _everywhere(call)
    axes = call.spread.axes()
    empty = call.spread.last[:, 0] < 0
    first, last = torch.full((len(empty),), places[0]), torch.full((len(empty),), places[-1])
    axes.insert(axis, (first.masked_fill(empty, _NOWHERE), last.masked_fill(empty, -1)))
    return Spread.from_axes(axes)


@_rule("gather")
def _gather(call: Call) -> Spread:
    """Known where the indices are, as those of a pooling."""
    axis, indices = call.args[1] % call.source.ndim, call.args[2]
    if call.place != 0 or indices.is_meta:
        return _everywhere(call)
    # The first and the last place along the axis that each index is found at.
    indices = indices.cpu().movedim(axis, -1).reshape(-1, indices.shape[axis])
    places = torch.arange(indices.shape[1]).expand_as(indices).reshape(-1)
    indices = indices.reshape(-1)
    size = call.source.shape[axis]
    least = torch.full((size,), _NOWHERE).scatter_reduce(0, indices, places, "amin")
    most = torch.full((size,), -1).scatter_reduce(0, indices, places, "amax")
    return _windows(call, {axis: (least, most)})


def _cropped(call: Call, axis: int, start: int, step: int, count: int) -> _Axes:
    """The axes of boxes where every step-th index from the start is kept along one."""
    axes, empty = call.spread.axes(), call.spread.last[:, 0] < 0
    first, last = axes[axis]
    first = (first - start + step - 1).div(step, rounding_mode="floor").clamp(min=0)
    last = (last - start).div(step, rounding_mode="floor").clamp(max=count - 1)
    axes[axis] = first.masked_fill(empty, _NOWHERE), last.masked_fill(empty, -1)
    return axes


@_rule("slice")
def _slice(call: Call) -> Spread:
    stated = [*call.args[1:], *[0, None, None, 1][len(call.args) - 1 :]]
    axis, start, step = stated[0] % call.source.ndim, stated[1], stated[3]
    size = call.source.shape[axis]
    start = 0 if start is None else min(max(start + size if start < 0 else start, 0), size)
    return Spread.from_axes(_cropped(call, axis, start, step, call.shape[axis]))


@_rule("select")
def _select(call: Call) -> Spread:
    axis = call.args[1] % call.source.ndim
    axes = _cropped(call, axis, call.args[2] % call.source.shape[axis], 1, 1)
    gone = axes[axis][0] > axes[axis][1]
    del axes[axis]
    axes[0] = axes[0][0].masked_fill(gone, _NOWHERE), axes[0][1].masked_fill(gone, -1)
    return Spread.from_axes(axes)


_PARTS = ("split", "split_with_sizes", "unbind", "unsafe_split", "unsafe_chunk")


def _part(call: Call, position: int) -> Spread:
    """One of the parts that a tensor is split into."""
    if call.name == "unbind":
        axis = call.args[1] if len(call.args) > 1 else 0
        return _select(call._replace(args=(call.source, axis, position)))
    axis = (call.args[2] if len(call.args) > 2 else 0) % call.source.ndim
    sizes = call.args[1]
    start = position * sizes if isinstance(sizes, int) else sum(sizes[:position])
    return Spread.from_axes(_cropped(call, axis, start, 1, call.shape[axis]))


@_rule("permute", "transpose", "t", "numpy_T")
def _permute(call: Call) -> Spread:
    order = list(range(call.source.ndim))
    if call.name == "permute":
        order = [axis % call.source.ndim for axis in call.args[1]]
    elif call.name == "transpose":
        one, other = (axis % call.source.ndim for axis in call.args[1:3])
        order[one], order[other] = other, one
    else:
        order.reverse()
    axes = call.spread.axes()
    return Spread.from_axes([axes[axis] for axis in order])


@_rule("flip")
def _flip(call: Call) -> Spread:
    axes, empty = call.spread.axes(), call.spread.last[:, 0] < 0
    for axis in (each % call.source.ndim for each in call.args[1]):
        first, last = (call.shape[axis] - 1 - index for index in reversed(axes[axis]))
        axes[axis] = first.masked_fill(empty, _NOWHERE), last.masked_fill(empty, -1)
    return Spread.from_axes(axes)


@_rule("repeat")
def _repeat(call: Call) -> Spread:
    axes, repeats = call.spread.axes(), call.args[1]
    missing = len(repeats) - len(axes)
    made = [_full(call, axis) for axis in range(missing)]
    for axis, own in enumerate(axes, start=missing):
        made.append(own if repeats[axis] == 1 else _full(call, axis))
    return Spread.from_axes(made)


@_rule("view", "_unsafe_view", "reshape", "_reshape_alias", "squeeze", "unsqueeze", "flatten")
def _reshape(call: Call) -> Spread:
    """Axes are kept, merged or cut, group by group of equally many elements."""
    axes, made = call.spread.axes(), list[tuple[Tensor, Tensor]]()
    old, new = list(call.source.shape), list(call.shape)
    if math.prod(old) != math.prod(new) or not math.prod(old):  # such as of another type
        return _everywhere(call)
    empty = call.spread.last[:, 0] < 0
    while old or new:
        # The shortest groups of old and new axes with equally many elements.
        taken, given = old[:1], new[:1]
        while math.prod(taken) != math.prod(given):
            if math.prod(taken) < math.prod(given):
                taken = old[: len(taken) + 1]
            else:
                given = new[: len(given) + 1]
        old, new = old[len(taken) :], new[len(given) :]
        own, axes = axes[: len(taken)], axes[len(taken) :]
        made += _regrouped(own, taken, given, empty)
    return Spread.from_axes(made)


def _regrouped(own: _Axes, taken: list[int], given: list[int], empty: Tensor) -> _Axes:
    """A group of axes as other axes with equally many elements."""
    if taken == given:
        return own
    zero = torch.zeros(len(empty), dtype=torch.long)
    first = last = zero
    for (low, high), size in zip(own, taken, strict=True):
        first = first * size + low.masked_fill(empty, 0)
        last = last * size + high.masked_fill(empty, 0)
    made, exact = list[tuple[Tensor, Tensor]](), torch.ones(len(empty), dtype=torch.bool)
    inner = math.prod(given)
    for size in given:
        inner //= max(size, 1)
        low = torch.where(exact, first // inner, 0)
        high = torch.where(exact, last // inner, size - 1)
        made.append((low.masked_fill(empty, _NOWHERE), high.masked_fill(empty, -1)))
        # What lies behind the first axis with several indices is not known.
        exact = exact & (low == high)
        first, last = first % inner, last % inner
    return made
