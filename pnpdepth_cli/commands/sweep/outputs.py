"""Averages the rows of a sweep over frames, with intervals; writes its tables and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pnpdepth_cli.commands.evaluation.statistics import (
    FrameTable,
    find_clusters,
    gain,
    interval,
)
from pnpdepth_cli.commands.sweep.axes import PARAMETERS, Axis, Study
from pnpdepth_cli.commands.sweep.running import METHODS, SWEPT
from pnpdepth_cli.commands.tables import Table, write_text
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.dataset import groups_by_name
from pnpdepth_cli.io.record import plain, write_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = Mapping[str, Any]

SCORES = tuple(f"{measure.key}_{method}" for measure in SWEPT for method in METHODS)
_COLUMNS = (
    *(*METHODS, "refined_low", "refined_high"),
    *("gain", "gain_low", "gain_high", "gain_over_linear"),
)

_GREY = "#555555"
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Distinguishable for the colour-blind (Okabe and Ito 2008)."""
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


def row_of(result: Row | None, *, timed: bool) -> dict[str, Any]:
    """Returns the status and the scores of one frame with one draw; None is one that failed."""
    if result is None:
        return {"status": "failed", "points_used": 0, **dict.fromkeys(SCORES)}
    scores = {f"{m.key}_{of}": result["scores"][of][m.key] for m in SWEPT for of in METHODS}
    status = "diverged" if result["diverged"] else "done"
    time_s = {"time_s": result["time_s"]} if timed else {}
    return {"status": status, "points_used": result["points"], **scores, **time_s}


def summarise(rows: Sequence[Row], resamples: int) -> dict[str, Any]:
    """Returns a cell's means over frames, of each frame's mean over its draws.

    Frames of which a draw failed are left out. Gains are in per cent, positive where the refinement
    is better: over the plain network, and over linear interpolation.

    Args:
        rows: All draws of all frames of the cell, as of `row_of`, with the frame's name.
        resamples: Bootstrap samples behind the intervals, which are studentised and over sequences
            of frames; there are none with fewer than MIN_CLUSTERS of these.
    """
    by_frame: dict[str, list[Row]] = {}
    for row in rows:
        by_frame.setdefault(row["frame"], []).append(row)
    whole = {n: of for n, of in by_frame.items() if all(r["status"] != "failed" for r in of)}
    counts: dict[str, Any] = {
        "frames": len(whole),
        "failed": len(by_frame) - len(whole),
        "diverged": sum(row["status"] == "diverged" for row in rows),
        "points": None,
        "measures": None,
    }
    used = [row for of in whole.values() for row in of]
    for name in ("points_used", "time_s"):
        if used and name in used[0]:
            counts[name.removesuffix("_used")] = np.mean([row[name] for row in used])
    if used:
        scores = [np.array([[r[k] for k in SCORES] for r in of], float) for of in whole.values()]
        table = np.stack([draws.mean(axis=0) for draws in scores])
        counts["measures"] = _measures(table.reshape(-1, len(SWEPT), 3), list(whole), resamples)
    result: dict[str, Any] = plain(counts)
    return result


def _measures(table: Any, names: Sequence[str], resamples: int) -> dict[str, dict[str, float]]:
    """The values of _COLUMNS by measure, of (frames, measures, METHODS)."""
    better = np.array([1.0 if m.higher_is_better else -1.0 for m in SWEPT])
    drawing = find_clusters(groups_by_name(names), table.reshape(len(table), -1)), resamples, 0
    first, _, refined = (FrameTable.of_frames(table[..., method]) for method in range(3))
    means = table.mean(axis=0).T
    values = (
        *means,
        *interval(lambda mean: mean, [refined], *drawing),
        gain(means[0], means[2], better),
        *interval(lambda a, b: gain(a, b, better), [first, refined], *drawing),
        gain(means[1], means[2], better),
    )
    of_measures = np.stack(values, axis=1).tolist()
    return {
        m.key: dict(zip(_COLUMNS, of, strict=True))
        for m, of in zip(SWEPT, of_measures, strict=True)
    }


def write_sweep(folder: Path, record: Mapping[str, Any], rows: Sequence[Row]) -> None:
    """Writes sweep.json, the means to sweep.csv and sweep.tex, and all rows to sweep_frames.csv."""
    studies = record["studies"]
    write_json(folder / "sweep.json", record)
    tables = [study_table(study, record).latex() for study in studies]
    write_text(folder / "sweep.tex", "\n".join(tables))
    names = list(dict.fromkeys(name for study in studies for name in study["parameters"]))
    timed = ["time_s"] * any("time_s" in cell for study in studies for cell in study["cells"])
    counts = ("frames", "failed", "diverged", "points_used", *timed)
    means = [f"{measure.key}_{name}" for measure in SWEPT for name in _COLUMNS]
    cells = [
        {
            "study": study["name"],
            **cell["parameters"],
            **{f"{m}_{n}": v for m, of in (cell["measures"] or {}).items() for n, v in of.items()},
            **{name: cell.get(name.removesuffix("_used")) for name in counts},
        }
        for study in studies
        for cell in study["cells"]
    ]
    columns = ("study", *names, "frame", "seed", "status", "points_used", *timed, *SCORES)
    for name, header, lines in (
        ("sweep.csv", ("study", *names, *counts, *means), cells),
        ("sweep_frames.csv", tuple(dict.fromkeys(columns)), rows),
    ):
        of_header = [[line.get(column) for column in header] for line in lines]
        write_text(folder / name, Table(header=header, rows=of_header).csv())


def study_table(study: Row, record: Row) -> Table:
    """Returns the means of a study: a row for each cell."""
    timed = any("time_s" in cell for cell in study["cells"])
    rows = []
    for cell in study["cells"]:
        measures = cell["measures"] or {measure.key: {} for measure in SWEPT}
        mae, diverged = measures["mae"], f", {cell['diverged']:,} diverged"
        low, high = (_text(mae.get(f"gain_{end}"), "+.1f") for end in ("low", "high"))
        rows.append(
            [
                *cell["parameters"].values(),
                _text(cell["points"], ",.0f"),
                f"{cell['frames']:,}{diverged if cell['diverged'] else ''}",
                *(_text(mae.get(name), ".4f") for name in METHODS),
                "–" if low == "–" else f"{mae['refined_low']:.4f} … {mae['refined_high']:.4f}",
                _text(mae.get("gain"), "+.1f"),
                "–" if low == "–" else f"{low} … {high}",
                *(_text(measures[k].get("gain"), "+.1f") for k in ("rmse", "mre", "delta1")),
                *[_text(cell.get("time_s"), ".3g")] * timed,
            ]
        )
    draws = "1 draw" if record["seeds"] == 1 else f"{record['seeds']} draws"
    caption = (
        f"{' × '.join(study['parameters'])}: means over frames, of {draws} of the points each; MAE"
        " in metres, gains over plain in %"
    )
    return Table(
        header=[*study["parameters"], "points used", "frames", *METHODS, "95 %", "gain", "95 %",
                "RMSE gain", "MRE gain", "δ1 gain", *["time [s]"] * timed],
        rows=rows,
        caption="; ".join([caption, *record["assumed"]]),
    )  # fmt: skip


def _text(value: float | None, form: str) -> str:
    return "–" if value is None else f"{value:{form}}"


def need_matplotlib() -> None:
    """Raises UsageError if matplotlib is not installed."""
    if find_spec("matplotlib") is None:
        raise UsageError(
            "plots need matplotlib: pip install 'pnpdepth[plot]'; --plots none does without"
        )


def draw_study(study: Study, cells: Sequence[Row], path: Path) -> None:
    """Writes a plot of a study's cells, with a third panel where times are known."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    timed = any(cell.get("time_s") is not None for cell in cells)
    across, apart = (*study.axes, None) if len(study.axes) == 1 else across_and_apart(*study.axes)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(11.4 if timed else 8.2, 2.9), dpi=200, layout="constrained")
        error, gained, *cost = figure.subplots(1, 3 if timed else 2)
        _draw_lines(across, apart, cells, error, gained)
        for axes in (error, gained):
            _scale(axes, across)
        for axes in cost:
            _draw_cost(axes, cells)
        lines = [line for axes in (error, gained) for line in axes.get_lines()]
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


def _draw_lines(
    across: Axis, apart: Axis | None, cells: Sequence[Row], error: Axes, gained: Axes
) -> None:
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
        look: dict[str, Any] = {"color": colour, "marker": "osD^vP"[n % 6], "label": label}
        look["aside"] = 0.6 * ((n + 0.5) / many - 0.5)
        _draw(error, across, of, "mae", "refined", **look)
        _draw(gained, across, of, "mae", "gain", **look)
        for method, dashes in _BESIDE.values():
            own = _GREY if apart is None else colour
            _draw(error, across, of, "mae", method, linestyle=dashes, color=own, linewidth=0.8)
    if apart is None:
        look = {"color": _COLOURS[1], "marker": "s", "label": "refined, RMSE", "aside": 0.1}
        _draw(gained, across, cells, "rmse", "gain", **look)
    for label, (_, dashes) in _BESIDE.items():
        error.plot([], [], color=_GREY, linestyle=dashes, label=label)
    error.set_ylabel("MAE (m)")
    gained.set_ylabel("gain over the plain network (%)")
    gained.axhline(0, color=_GREY, linewidth=0.8, zorder=1)


def _draw(
    axes: Axes, axis: Axis, cells: Sequence[Row], key: str, name: str, *, aside: float = 0.0,
    **look: Any,
) -> None:  # fmt: skip
    """Draws a line through the cells' values, those of names aside; gains with their intervals."""
    numbers = axis.numbers()
    x = np.array(numbers or [n + aside for n in range(len(axis.values))])
    order = np.argsort(x, kind="stable")
    at, values, low, high = (
        line[order]
        for line in (x, *(_values(cells, key, name + end) for end in ("", "_low", "_high")))
    )
    if numbers is None and name not in ("plain", "linear"):
        look |= {"linestyle": ""}
    axes.plot(at, values, **look)
    # the scatter of frames would hide the differences of errors
    if name == "gain" and not np.isnan(low).all():
        if numbers is None:
            axes.vlines(at, low, high, color=look["color"], linewidth=1)
        else:
            axes.fill_between(at, low, high, color=look["color"], alpha=0.15, linewidth=0)


def _draw_cost(axes: Axes, cells: Sequence[Row]) -> None:
    """The error of each cell over the time of its refinement, with its values."""
    for cell, error in zip(cells, _values(cells, "mae", "refined"), strict=True):
        if not np.isnan(error):
            axes.plot(cell["time_s"], error, "o", color=_COLOURS[0])
            text = "  " + ", ".join(cell["parameters"].values())
            axes.text(cell["time_s"], error, text, fontsize=6, color=_GREY)
    axes.set_xlabel("time of the refinement (s)")
    axes.set_ylabel("MAE (m)")


def _values(cells: Sequence[Row], key: str, name: str) -> Any:
    """(cells,) the values; NaN where there is none."""
    values = (((cell["measures"] or {}).get(key) or {}).get(name) for cell in cells)
    return np.array([np.nan if value is None else value for value in values])


def _scale(axes: Axes, axis: Axis) -> None:
    """Puts a tick at every value."""
    from matplotlib.ticker import NullLocator

    numbers, labels = axis.numbers(), list(axis.values)
    axes.set_xlabel(axis.title())
    if numbers is not None:
        if PARAMETERS[axis.name].shown.log:  # of values above 0
            axes.set_xscale("log")
        axes.set_xticks(numbers, [label.removesuffix("%") for label in labels])
    else:
        turned = sum(map(len, labels)) > _MAX_LETTERS
        axes.set_xlim(-0.5, len(labels) - 0.5)
        axes.grid(visible=False, axis="x")
        look: dict[str, Any] = {"rotation": 30, "ha": "right"} if turned else {}
        axes.set_xticks(range(len(labels)), labels, **look)
    axes.xaxis.set_minor_locator(NullLocator())
