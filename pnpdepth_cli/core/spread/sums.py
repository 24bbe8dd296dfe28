"""Rules of operations that sum along axes: what is summed reaches all of the axis."""

from __future__ import annotations

from pnpdepth_cli.core.spread.boxes import (
    AxisRange,
    Call,
    Spread,
    everywhere,
    full_range,
    pointwise,
    rule,
)


@rule("mm", "bmm", "addmm", "baddbmm", "linear")
def product(call: Call) -> Spread:
    """Returns where a product of matrices depends on the feature map.

    The boxes are the input's, full along the axis that is summed over.
    Rows of the left factor are rows of the product, and columns of the right one its columns.
    """
    left = 1 if call.name in ("addmm", "baddbmm") else 0  # number of the left factor
    if call.place is None:
        return everywhere(call)
    if call.place < left:  # the matrix that is added to the product
        return pointwise(call)
    if call.name == "linear" and call.place:  # its weights or its bias
        return everywhere(call)
    # The columns of the left factor are summed over, and the rows of the right one.
    axes = call.spread.axes()
    summed = len(axes) - 1 if call.place == left else len(axes) - 2
    axes[summed] = full_range(call, summed)
    return Spread.from_axes(axes)


@rule("mean", "sum", "amax", "amin", "logsumexp", "prod", "var", "std")
def reduction(call: Call) -> Spread:
    """Returns where a sum, mean or the like along some axes depends on the feature map.

    The boxes are the input's. Axes that are reduced are gone, or full where the operation keeps
    them.
    """
    stated_axes = call.args[1] if len(call.args) > 1 else None
    if isinstance(stated_axes, int):
        stated_axes = [stated_axes]
    if not isinstance(stated_axes, list | tuple) or not stated_axes:  # all axes are reduced
        return everywhere(call)
    reduced = {axis % call.source.ndim for axis in stated_axes}
    keeps_axes = len(call.shape) == call.source.ndim
    axes: list[AxisRange] = []
    for axis, axis_range in enumerate(call.spread.axes()):
        if axis not in reduced:
            axes.append(axis_range)
        elif keeps_axes:
            axes.append(full_range(call, axis))
    if len(axes) != len(call.shape):  # such as a single element, an axis of one
        return everywhere(call)
    return Spread.from_axes(axes)


@rule("_softmax", "_log_softmax", "_safe_softmax", "cumsum")
def along_axis(call: Call) -> Spread:
    """Returns where a softmax or a cumulative sum depends on the feature map.

    The boxes are the input's, full along the axis of the operation.
    """
    axes = call.spread.axes()
    axis = call.args[1] % call.source.ndim
    axes[axis] = full_range(call, axis)
    return Spread.from_axes(axes)


@rule("native_layer_norm")
def layer_norm(call: Call) -> Spread:
    """Returns where a layer norm depends on the feature map.

    The boxes are the input's, full along the axes normalised together. These are the last ones, as
    many as argument 1 has sizes.
    """
    if call.place != 0:  # weight or bias
        return everywhere(call)
    axes = call.spread.axes()
    for axis in range(len(axes) - len(call.args[1]), len(axes)):
        axes[axis] = full_range(call, axis)
    return Spread.from_axes(axes)
