"""Plots a sweep's studies: the error, the gain over the plain network, and the error over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli.commands.sweep.axes import PARAMETERS, Axis, Study
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Cells = Sequence[Mapping[str, Any]]

_GREY = "#555555"
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Distinguishable for the colour-blind (Okabe and Ito 2008)."""
_MARKS = "osD^vP"
_BESIDE = {"plain network": ("plain", "--"), "linear interpolation": ("linear", ":")}
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "pnpdepth",
    "font.size": 8,
    "lines.linewidth": 1.4,
    "lines.markersize": 4,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
}
_METADATA = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
"""Without the program's version and the date, so that the same sweep gives the same bytes."""
_MAX_LETTERS = 30
"""More letters of values below an axis are rotated."""


def need_matplotlib() -> None:
    """Raises UsageError if matplotlib is not installed."""
    if find_spec("matplotlib") is None:
        raise UsageError(
            "plots need matplotlib: pip install 'pnpdepth[plot]'; --plots none does without"
        )


def draw_study(study: Study, cells: Cells, path: Path) -> None:
    """Writes a plot of a study's cells, with a third panel where times are known."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        timed = any(cell.get("time_s") is not None for cell in cells)
        figure = Figure(figsize=(11.4 if timed else 8.2, 2.9), dpi=200, layout="constrained")
        error, gain, *cost = figure.subplots(1, 3 if timed else 2)
        across, apart = (
            (*study.axes, None) if len(study.axes) == 1 else across_and_apart(*study.axes)
        )
        _draw_lines(across, apart, cells, error, gain)
        _scale((error, gain), across)
        for axes in cost:
            _draw_cost(axes, cells)
        lines = [line for axes in (error, gain) for line in axes.get_lines()]
        named = {str(line.get_label()): line for line in reversed(lines)}
        labels = [name for name in reversed(named) if not name.startswith("_")]
        handles = [named[name] for name in labels]
        title = None if apart is None else apart.title()
        figure.legend(handles, labels, title=title, loc="outside right center")
        kind = path.suffix.removeprefix(".")
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format=kind, metadata=_METADATA[kind])


def across_and_apart(first: Axis, second: Axis) -> tuple[Axis, Axis]:
    """Returns the x axis and the axis that makes lines: numbers, and more values, lie across."""
    along = max((second, first), key=lambda a: (a.numbers() is not None, len(a.values)))
    return along, first if along is second else second


def _draw_lines(across: Axis, apart: Axis | None, cells: Cells, error: Axes, gain: Axes) -> None:
    """A line for each value apart: from dark to light if they are ordered, else of own colours."""
    import matplotlib as mpl

    groups = {"refined": cells}
    if apart is not None:
        groups = {v: [c for c in cells if c["parameters"][apart.name] == v] for v in apart.values}
    many, shades = len(groups), mpl.colormaps["viridis"]
    ordered = many > len(_COLOURS) or (apart is not None and apart.numbers() is not None)
    for n, (label, of) in enumerate(groups.items()):
        # the lightest fifth is hard to see on white
        colour = shades(0.8 * n / max(1, many - 1)) if ordered else _COLOURS[n]
        look: dict[str, Any]
        look = {"color": colour, "marker": _MARKS[n % len(_MARKS)], "label": label}
        look["aside"] = 0.6 * ((n + 0.5) / many - 0.5)
        _draw(error, across, of, "mae", "refined", **look)
        _draw(gain, across, of, "mae", "gain", **look)
        for method, dashes in _BESIDE.values():
            own = _GREY if apart is None else colour
            _draw(error, across, of, "mae", method, linestyle=dashes, color=own, linewidth=0.8)
    if apart is None:
        look = {"color": _COLOURS[1], "marker": "s", "label": "refined, RMSE", "aside": 0.1}
        _draw(gain, across, cells, "rmse", "gain", **look)
    for label, (_, dashes) in _BESIDE.items():
        error.plot([], [], color=_GREY, linestyle=dashes, label=label)
    error.set_ylabel("MAE (m)")
    gain.set_ylabel("gain over the plain network (%)")
    gain.axhline(0, color=_GREY, linewidth=0.8, zorder=1)


def _draw(
    axes: Axes, axis: Axis, cells: Cells, key: str, name: str, *, aside: float = 0.0, **look: Any
) -> None:
    """Draws a line through the cells' values, those of names aside; gains with their intervals."""
    x = axis.numbers() or [n + aside for n in range(len(axis.values))]
    order = sorted(range(len(x)), key=lambda n: x[n])
    at = [x[n] for n in order]
    values, low, high = (
        [_values(cells, key, name + end)[n] for n in order] for end in ("", "_low", "_high")
    )
    if axis.numbers() is None and name not in ("plain", "linear"):
        look |= {"linestyle": ""}
    axes.plot(at, values, **look)
    # the scatter of frames would hide the differences of errors
    if name == "gain" and not all(bound != bound for bound in low):
        if axis.numbers() is None:
            axes.vlines(at, low, high, color=look["color"], linewidth=1)
        else:
            axes.fill_between(at, low, high, color=look["color"], alpha=0.15, linewidth=0)


def _draw_cost(axes: Axes, cells: Cells) -> None:
    """The error of each cell over the time of its refinement, with its values."""
    for cell in cells:
        (error,) = _values([cell], "mae", "refined")
        if cell["time_s"] is not None and error == error:
            axes.plot(cell["time_s"], error, "o", color=_COLOURS[0])
            text = "  " + ", ".join(cell["parameters"].values())
            axes.text(cell["time_s"], error, text, fontsize=6, color=_GREY)
    axes.set_xlabel("time of the refinement (s)")
    axes.set_ylabel("MAE (m)")


def _values(cells: Cells, key: str, name: str) -> list[float]:
    """The cells' values; NaN where there is none."""
    values = [((cell["measures"] or {}).get(key) or {}).get(name) for cell in cells]
    return [float("nan") if value is None else value for value in values]


def _scale(both: Sequence[Axes], axis: Axis) -> None:
    """Puts a tick at every value."""
    from matplotlib.ticker import NullLocator

    numbers = axis.numbers()
    turned = numbers is None and sum(map(len, axis.values)) > _MAX_LETTERS
    for axes in both:
        axes.set_xlabel(axis.title())
        if numbers is not None and PARAMETERS[axis.name].shown.log and min(numbers) > 0:
            axes.set_xscale("log")
        if numbers is None:
            axes.set_xlim(-0.5, len(axis.values) - 0.5)
            axes.grid(visible=False, axis="x")
        axes.set_xticks(
            range(len(axis.values)) if numbers is None else numbers,
            [value.removesuffix("%") if numbers else value for value in axis.values],
            rotation=30 if turned else 0,
            ha="right" if turned else "center",
        )
        axes.xaxis.set_minor_locator(NullLocator())
