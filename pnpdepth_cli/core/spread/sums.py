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
    """Rows of the left factor and columns of the right one stay; what is summed becomes full."""
    left = 1 if call.name in ("addmm", "baddbmm") else 0  # number of the left factor
    if call.place is None:
        return everywhere(call)
    if call.place < left:  # the summand
        return pointwise(call)
    if call.name == "linear" and call.place:  # its weights
        return everywhere(call)
    axes = call.spread.axes()
    summed = len(axes) - 1 if call.place == left else len(axes) - 2
    axes[summed] = full_range(call, summed)
    return Spread.from_axes(axes)


@rule("mean", "sum", "amax", "amin", "logsumexp", "prod", "var", "std")
def reduction(call: Call) -> Spread:
    """Axes that are reduced become full, or go."""
    stated = call.args[1] if len(call.args) > 1 else None
    if isinstance(stated, int):
        stated = [stated]
    if not isinstance(stated, list | tuple) or not stated:  # over all axes
        return everywhere(call)
    reduced = {axis % call.source.ndim for axis in stated}
    keeps_axes = len(call.shape) == call.source.ndim
    axes: list[AxisRange] = []
    for axis, axis_range in enumerate(call.spread.axes()):
        if axis not in reduced:
            axes.append(axis_range)
        elif keeps_axes:
            axes.append(full_range(call, axis))
    if len(axes) != len(call.shape):
        return everywhere(call)
    return Spread.from_axes(axes)


@rule("_softmax", "_log_softmax", "_safe_softmax", "cumsum")
def along_axis(call: Call) -> Spread:
    """An element depends on all of its axis."""
    axes = call.spread.axes()
    axis = call.args[1] % call.source.ndim
    axes[axis] = full_range(call, axis)
    return Spread.from_axes(axes)


@rule("native_layer_norm")
def layer_norm(call: Call) -> Spread:
    """An element depends on all of the last axes, which are normalised together."""
    if call.place != 0:
        return everywhere(call)
    axes = call.spread.axes()
    for axis in range(len(axes) - len(call.args[1]), len(axes)):
        axes[axis] = full_range(call, axis)
    return Spread.from_axes(axes)
