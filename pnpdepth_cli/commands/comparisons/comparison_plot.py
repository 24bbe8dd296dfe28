"""The plot of a study: measures over the values of an option that `batch --vary` varied."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.comparisons.comparison import (
    ComparedRun,
    Comparison,
    numbers_of,
    positions_of,
)
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.shared import statistics
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.measures import Measure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CHANGING = {".png": "Software", ".svg": "Date", ".pdf": "CreationDate"}
"""Metadata that a plot lacks, by its suffix, so that the same runs give the same bytes."""
_SIDE_INCHES = 3.2
"""Side of a panel of a plot."""
_SEED = "seed"
"""An option whose values are random draws of one setting, so that runs are averaged over it."""

Line = dict[float, list[ComparedRun]]
"""The runs of a line by their position on the axis, in its order; several differ in their seed."""


class _Axis(NamedTuple):
    """The varied option that lies along the axis."""

    option: str
    positions: Mapping[str, float]
    """Where each value of the option lies: at its number, or names at 0, 1, …"""


def plot_comparison(comparison: Comparison, path: Path, *, overwrite: bool = False) -> None:
    """Writes a plot of each measure over a varied option, and of its improvement by refinement.

    Numbers, and of several options the one of most values, lie along the axis; each combination of
    the others is a line. A point is the mean over random seeds, where these vary. The means before
    refinement are dashed; the improvement is in per cent of them.

    Args:
        comparison: Runs of `batch --vary`, all with the same options.
        path: File to write; its suffix, of PNG, SVG or PDF, is the format.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: The runs are not of `batch --vary` with the same options, the suffix is of no
            known format, or matplotlib is not installed.
        OutputError: The file exists and is not to be replaced.
    """
    if path.suffix not in _CHANGING:
        raise UsageError(f"--plot {path}: name a file that ends in {', '.join(_CHANGING)}")
    check_outputs([path], overwrite=overwrite)
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("--plot needs matplotlib: pip install 'pnpdepth[plot]'") from None
    axis = _choose_axis(comparison.runs)
    lines = _lines(comparison.runs, axis)
    # A column of two panels for each measure. The salt makes the ids of an SVG the same each time.
    measures = comparison.measures
    size = (_SIDE_INCHES * len(measures) + 1, 2 * _SIDE_INCHES)
    with mpl.rc_context({"svg.hashsalt": "pnpdepth", "font.size": 8, "axes.grid": True}):
        figure = Figure(size, layout="constrained", dpi=150)
        panels = figure.subplots(2, len(measures), squeeze=False, sharex=True)
        for measure, above, below in zip(measures, *panels, strict=True):
            _plot_measure(measure, lines, axis, above, below)
        # One legend for all panels, as their lines are the same.
        panels[0][0].plot([], "k--", linewidth=0.8, label="before refinement")
        figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center")
        with atomic_path(path) as temporary:
            metadata = {_CHANGING[path.suffix]: None}
            figure.savefig(temporary, format=path.suffix[1:], metadata=metadata)


def _plot_measure(
    measure: Measure, lines: Mapping[str, Line], axis: _Axis, above: Axes, below: Axes
) -> None:
    """Draws a measure before and after refinement into the panel above, the improvement below.

    Args:
        measure: What is drawn.
        lines: The lines by their label, which is empty where there is only one.
        axis: The option along the axis.
        above: Panel of the measure.
        below: Panel of the improvement.
    """
    for number, (label, line) in enumerate(lines.items()):
        colour = f"C{number}"  # matplotlib's name of the n-th colour of its cycle
        before, after = _means_along(line, measure)
        improvement = statistics.gain(before, after, measure.sign)
        above.plot([*line], before, f"{colour}--", linewidth=0.8)
        above.plot([*line], after, f"{colour}o-", label=label or "after refinement")
        below.plot([*line], improvement, f"{colour}o-")
    above.set_ylabel(measure.heading)
    below.set(ylabel=f"improvement of {measure.title} [%]", xlabel=axis.option)
    # Numbers above 0 lie on a logarithmic axis; its ticks are the values themselves.
    below.set_xscale("log" if min(axis.positions.values()) > 0 else "linear")
    below.set_xticks([*axis.positions.values()], [*axis.positions])
    below.set_xticks([], minor=True)


def _means_along(line: Line, measure: Measure) -> NDArray[np.float64]:
    """(2, points) the means before, then after refinement, of each point along a line.

    They are in the unit of tables, and NaN where a run lacks the measure.
    """
    means = []
    for runs in line.values():
        pairs = [[run.before[measure.key], run.mean[measure.key]] for run in runs]
        means.append(np.mean(np.array(pairs, float), axis=0))  # over seeds; None becomes NaN
    return np.array(means).T * measure.shown_factor


def _choose_axis(runs: Sequence[ComparedRun]) -> _Axis:
    """The option along the axis: one of numbers before one of names, then that of most values.

    Raises:
        UsageError: The runs have no varied options, or others than each other.
    """
    # A run may lack options that have no effect on it, so the longest list is that of the study.
    options = max((tuple(run.varied) for run in runs), key=len)
    if not all({*run.varied} <= {*options} and run.varied for run in runs):
        raise UsageError("--plot needs results of `batch --vary`, all of the same options")
    shared = [option for option in options if all(option in run.varied for run in runs)]
    candidates = [option for option in shared if option != _SEED] or [_SEED]

    def preference(option: str) -> tuple[bool, int]:
        """Whether all values of the option are numbers, and how many values there are."""
        texts = {run.varied[option] for run in runs}
        return numbers_of(texts) is not None, len(texts)

    along = max(candidates, key=preference)
    return _Axis(along, positions_of(run.varied[along] for run in runs))


def _lines(runs: Sequence[ComparedRun], axis: _Axis) -> dict[str, Line]:
    """The lines of a plot by their label: one for each combination of values of other options.

    A line holds its runs by their position on the axis; several at one differ in their seed.

    Args:
        runs: The runs of a study.
        axis: The option along the axis, which all runs have.
    """

    def position(run: ComparedRun) -> float:
        """Where the run lies on the axis."""
        return axis.positions[run.varied[axis.option]]

    combinations = [*dict.fromkeys(_other_values(run, axis) for run in runs)]
    # A run without an option, as it has no effect there, makes no line of its own but is a point
    # of each line that has its other values.
    most = max(map(len, combinations))
    complete = [combination for combination in combinations if len(combination) == most]
    lines = defaultdict[str, Line](dict)
    for run in sorted(runs, key=position):
        for combination in complete:
            is_on_line = {*_other_values(run, axis)} <= {*combination}
            if is_on_line:
                line = lines[", ".join(combination)]
                line.setdefault(position(run), []).append(run)
    return lines


def _other_values(run: ComparedRun, axis: _Axis) -> tuple[str, ...]:
    """The run's values of all options but that of the axis and the seed, such as `loss=l1`.

    Runs of one line have the same.
    """
    return tuple(
        f"{option}={value}"
        for option, value in run.varied.items()
        if option not in (axis.option, _SEED)
    )
