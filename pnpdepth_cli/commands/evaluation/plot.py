"""The plot of a comparison of what `batch --vary` wrote: measures over the varied values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.commands.evaluation.compare import ComparedRun, Comparison
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.statistics import gain
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import atomic_path

_CHANGING = {".png": "Software", ".svg": "Date", ".pdf": "CreationDate"}
"""Metadata that a plot lacks, by its suffix, so that the same runs give the same bytes."""
_SIDE_INCHES = 3.2
_SEED = "seed"  # an option whose values are draws of the same


def plot_comparison(comparison: Comparison, path: Path, *, overwrite: bool = False) -> None:
    """Writes a plot of each measure over a varied option, and of its improvement by refinement.

    Numbers, and of several options the one of most values, lie along the axis; each combination of
    the others is a line. A point is the mean over random seeds, where these vary. The means before
    refinement are dashed; the improvement is in per cent of them.

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
        from matplotlib.lines import Line2D
    except ImportError:
        raise UsageError("--plot needs matplotlib: pip install 'pnpdepth[plot]'") from None
    # where each value lies, and the runs of each line in this order
    across, positions = _axis(comparison.runs)
    lines: dict[str, dict[float, list[ComparedRun]]] = {}
    for run in sorted(comparison.runs, key=lambda run: positions[run.varied[across]]):
        others = [f"{k}={value}" for k, value in run.varied.items() if k not in (across, _SEED)]
        line = lines.setdefault(", ".join(others), {})
        line.setdefault(positions[run.varied[across]], []).append(run)
    # a column of two panels for each measure
    measures = comparison.measures
    size = _SIDE_INCHES * len(measures) + 1, 2 * _SIDE_INCHES
    with mpl.rc_context({"svg.hashsalt": "pnpdepth", "font.size": 8, "axes.grid": True}):
        figure = Figure(size, layout="constrained", dpi=150)
        panels = figure.subplots(2, len(measures), squeeze=False, sharex=True)
        for measure, above, below in zip(measures, *panels, strict=True):
            for number, (label, line) in enumerate(lines.items()):
                x, key = [*line], measure.key
                means = [
                    np.mean(np.array([[run.before[key], run.mean[key]] for run in runs], float), 0)
                    for runs in line.values()
                ]  # None becomes NaN
                before, after = np.array(means).T * measure.shown_factor
                improved = gain(before, after, measure.sign)
                above.plot(x, before, f"C{number}--", linewidth=0.8)
                above.plot(x, after, f"C{number}o-", label=label or "after refinement")
                below.plot(x, improved, f"C{number}o-")
            above.set_ylabel(measure.heading)
            below.set(ylabel=f"improvement of {measure.title} [%]", xlabel=across)
            below.set_xscale("log" if min(positions.values()) > 0 else "linear")
            below.set_xticks([*positions.values()], [*positions])
            below.set_xticks([], minor=True)
        handles, labels = panels[0][0].get_legend_handles_labels()
        handles.append(Line2D([], [], color="black", linestyle="--", linewidth=0.8))
        labels.append("before refinement")
        figure.legend(handles, labels, loc="outside lower center")
        with atomic_path(path) as temporary:
            metadata: dict[str, Any] = {_CHANGING[path.suffix]: None}
            figure.savefig(temporary, format=path.suffix[1:], metadata=metadata)


def _axis(runs: Sequence[ComparedRun]) -> tuple[str, dict[str, float]]:
    """The option that lies along the axis, and where its values do: names from 0 on."""
    options = {tuple(run.varied) for run in runs}
    if len(options) > 1 or () in options:
        raise UsageError("--plot needs results of `batch --vary`, all of the same options")
    names = [name for name in options.pop() if name != _SEED] or [_SEED]
    values = {name: [*dict.fromkeys(run.varied[name] for run in runs)] for name in names}
    across = max(values, key=lambda name: (_numbers(values[name]) is not None, len(values[name])))
    places = {value: float(place) for place, value in enumerate(values[across])}
    return across, _numbers(values[across]) or places


def _numbers(texts: Sequence[str]) -> dict[str, float] | None:
    """The number that each of the texts is; None if one is none."""
    try:
        return {text: float(text.removesuffix("%")) for text in texts}
    except ValueError:
        return None
