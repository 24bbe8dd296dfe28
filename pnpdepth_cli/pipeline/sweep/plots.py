"""Plots a sweep's studies: the error, the gain over the plain network, and the error over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.pipeline.sweep.axes import Axis, Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Cells = Sequence[Mapping[str, Any]]

BLUE, VERMILION, GREEN, PURPLE, SKY, ORANGE = (
    *("#0072B2", "#D55E00", "#009E73"),
    *("#CC79A7", "#56B4E9", "#E69F00"),
)
"""Distinguishable for the colour-blind (Okabe and Ito 2008)."""

_GREY = "#555555"
_KINDS = (BLUE, VERMILION, GREEN, PURPLE, SKY, ORANGE)
_MARKS = "osD^vP"
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "pnpdepth",
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
}
_METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
"""Without the program's version and the date, so that the same sweep gives the same bytes."""
_MAX_LETTERS = 30
"""More letters of values below an axis are rotated."""


def need_matplotlib() -> None:
    """Raises UsageError if matplotlib is not installed."""
    if find_spec("matplotlib") is None:
        raise UsageError(
            "plots need matplotlib: pip install 'pnpdepth[plot]'; --no-plots does without"
        )


def draw_study(study: Study, cells: Cells, path: Path) -> None:
    """Writes a plot of the cells of one axis or two, with a third panel where times are known.

    Args:
        study: The axes.
        cells: The cells in the order of the study.
        path: The file, of one of PLOT_FORMATS.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        timed = any(cell.get("time_s") is not None for cell in cells)
        figure = Figure(figsize=(10.4 if timed else 7.2, 2.9), dpi=200, layout="constrained")
        error, gain, *cost = figure.subplots(1, 3 if timed else 2)
        if len(study.axes) == 1:
            _draw_one(study.axes[0], cells, error, gain)
        else:
            _draw_two(study, cells, error, gain)
            handles, labels = gain.get_legend_handles_labels()
            figure.legend(
                handles, labels, title=_across(*study.axes)[1].title(), loc="outside right center"
            )
        error.set_ylabel("MAE (m)")
        gain.axhline(0, color=_GREY, linewidth=0.8, zorder=1)
        for axes in cost:
            _draw_cost(axes, cells)
        kind = path.suffix.removeprefix(".")
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format=kind, metadata=_METADATA[kind])


def _draw_cost(axes: Axes, cells: Cells) -> None:
    """The error of each cell over the time of its refinement, with its values."""
    for cell in cells:
        (error,) = _values([cell], "mae", "refined")
        if cell.get("time_s") is None or error != error:
            continue
        axes.plot(cell["time_s"], error, "o", color=BLUE, markersize=4)
        axes.annotate(
            ", ".join(cell["parameters"].values()),
            (cell["time_s"], error),
            textcoords="offset points",
            xytext=(4, 3),
            fontsize=6,
            color=_GREY,
        )
    axes.set_xlabel("time of the refinement (s)")
    axes.set_ylabel("MAE (m)")


def _draw_one(axis: Axis, cells: Cells, error: Axes, gain: Axes) -> None:
    for method, colour, dashes, label in (
        ("plain", _GREY, "--", "plain network"),
        ("linear", ORANGE, ":", "linear interpolation"),
        ("refined", BLUE, "-", "refined"),
    ):
        line = _Line(
            colour=colour, dashes=dashes, mark="o" if method == "refined" else "", label=label
        )
        _draw(error, axis, cells, "mae", method, line)
    mae = _Line(colour=BLUE, mark="o", aside=-0.08, label="MAE")
    rmse = _Line(colour=VERMILION, mark="s", aside=0.08, label="RMSE")
    _draw(gain, axis, cells, "mae", "gain", mae)
    _draw(gain, axis, cells, "rmse", "gain", rmse)
    gain.set_ylabel("gain over the plain network (%)")
    for axes in (error, gain):
        _scale(axes, axis)
        axes.legend()


def _draw_two(study: Study, cells: Cells, error: Axes, gain: Axes) -> None:
    across, apart = _across(*study.axes)
    groups = [
        [cell for cell in cells if cell["parameters"][apart.name] == value]
        for value in apart.values
    ]
    for group, line in zip(groups, _lines(apart), strict=True):
        _draw(error, across, group, "mae", "refined", line)
        _draw(gain, across, group, "mae", "gain", line)
    for method, dashes, label in (
        ("plain", "--", "plain network"),
        ("linear", ":", "linear interpolation"),
    ):
        if all(_values(g, "mae", method) == _values(groups[0], "mae", method) for g in groups):
            line = _Line(dashes=dashes, label=label)
            _draw(error, across, groups[0], "mae", method, line)
        elif method == "linear":
            for group, line in zip(groups, _lines(apart), strict=True):
                same = _Line(colour=line.colour, dashes=dashes, aside=line.aside)
                _draw(error, across, group, "mae", method, same)
            error.plot([], [], color=_GREY, linestyle=dashes, label=label)
    handles, labels = error.get_legend_handles_labels()
    kept = [pair for pair in zip(handles, labels, strict=True) if pair[1] not in apart.values]
    error.legend([handle for handle, _ in kept], [label for _, label in kept])
    gain.set_ylabel("MAE gain over the plain network (%)")
    for axes in (error, gain):
        _scale(axes, across)


@dataclass(frozen=True, kw_only=True)
class _Line:
    """How a line looks."""

    colour: Any = _GREY
    """Colour of matplotlib."""
    dashes: str = "-"
    """Line style of matplotlib."""
    mark: str = ""
    """Marker of matplotlib."""
    aside: float = 0
    """Offset of categories, so that no line hides another."""
    label: str | None = None
    """Text of the legend; None for no entry."""


def _lines(apart: Axis) -> list[_Line]:
    """A line for each value: from dark to light if they are ordered, else of distinct colours."""
    import matplotlib as mpl

    many = len(apart.values)
    if apart.numbers() is not None or many > len(_KINDS):
        shades = mpl.colormaps["viridis"]
        # the lightest fifth is hard to see on white
        colours: list[Any] = [shades(0.8 * n / max(1, many - 1)) for n in range(many)]
    else:
        colours = list(_KINDS[:many])
    return [
        _Line(
            colour=c,
            mark=_MARKS[n % len(_MARKS)],
            aside=0.6 * ((n + 0.5) / many - 0.5),
            label=apart.values[n],
        )
        for n, c in enumerate(colours)
    ]


def _across(first: Axis, second: Axis) -> tuple[Axis, Axis]:
    """(the x axis, the axis that makes lines): numbers and many values on the x axis."""
    along = max((second, first), key=lambda a: (a.numbers() is not None, len(a.values)))
    return along, first if along is second else second


def _draw(axes: Axes, axis: Axis, cells: Cells, key: str, name: str, line: _Line) -> None:
    """Draws a line through the cells' values; gains with their intervals."""
    positions = axis.numbers()
    x = [n + line.aside for n in range(len(axis.values))] if positions is None else positions
    order = sorted(range(len(x)), key=lambda n: x[n])
    values, low, high = (
        [_values(cells, key, name + end)[n] for n in order] for end in ("", "_low", "_high")
    )
    at = [x[n] for n in order]
    linked = positions is not None or name in ("plain", "linear")
    style = line.dashes if linked else ""
    if positions is None and name in ("plain", "linear") and len(set(values)) > 1:
        mark = "_" if name == "plain" else "x"
        style, line = "", replace(line, mark=mark)
    drawn = {"color": line.colour, "linestyle": style, "marker": line.mark, "label": line.label}
    axes.plot(at, values, markersize=12 if line.mark == "_" else 4, **drawn)
    if name != "gain" or all(bound != bound for bound in low):
        return  # the scatter of frames would hide the differences of values
    if positions is None:
        axes.vlines(at, low, high, color=line.colour, linewidth=1)
    else:
        axes.fill_between(at, low, high, color=line.colour, alpha=0.15, linewidth=0)


def _values(cells: Cells, key: str, name: str) -> list[float]:
    """The cells' values; NaN where there is none."""
    values = [((cell["measures"] or {}).get(key) or {}).get(name) for cell in cells]
    return [float("nan") if value is None else value for value in values]


def _scale(axes: Axes, axis: Axis) -> None:
    from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

    positions = axis.numbers()
    axes.set_xlabel(axis.title())
    if positions is None:
        turned = sum(map(len, axis.values)) > _MAX_LETTERS
        axes.set_xlim(-0.5, len(axis.values) - 0.5)
        axes.set_xticks(
            range(len(axis.values)),
            axis.values,
            rotation=30 if turned else 0,
            ha="right" if turned else "center",
        )
        axes.grid(visible=False, axis="x")
    elif axis.parameter.log and min(positions) > 0:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator(positions))
        axes.xaxis.set_major_formatter(FixedFormatter([v.removesuffix("%") for v in axis.values]))
        axes.xaxis.set_minor_locator(NullLocator())
