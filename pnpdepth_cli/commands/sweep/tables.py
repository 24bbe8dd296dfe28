"""Averages the rows of a sweep over frames, with intervals, and writes its tables."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.commands.evaluation.statistics import (
    Floats,
    FrameTable,
    find_clusters,
    gain,
    groups_by_name,
    interval,
)
from pnpdepth_cli.commands.tables import Table, write_text
from pnpdepth_cli.core.metrics import MEASURES
from pnpdepth_cli.io.csv_text import write_csv
from pnpdepth_cli.io.record import plain, write_json

METHODS = ("plain", "linear", "refined")
SWEPT = tuple(m for m in MEASURES if m.key in ("mae", "rmse", "mre", "delta1"))
"""The measures of a sweep."""
SCORES = tuple(f"{measure.key}_{method}" for measure in SWEPT for method in METHODS)
"""Columns of a row."""

_BETTER = np.array([1.0 if m.higher_is_better else -1.0 for m in SWEPT])
_COLUMNS = (
    *(*METHODS, "refined_low", "refined_high"),
    *("gain", "gain_low", "gain_high", "gain_over_linear"),
)
_ROWS = (*METHODS, "gain", "gain_over_linear")


def row_of(
    iterations: int, linear: Mapping[str, Any] | None, refined: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Returns the status and the scores of one frame with one draw of its points.

    They are of the journal's results after a number of updates; None is one that failed.
    """
    if linear is None or refined is None:
        return {"status": "failed", "points_used": 0, **dict.fromkeys(SCORES)}
    after = refined["scores"][str(iterations)]
    by_method = (refined["plain"], linear["scores"]["linear"], after)
    return {
        "status": "diverged" if after["updates"] < iterations else "done",
        "points_used": refined["points"],
        **dict(zip(SCORES, (of[m.key] for m in SWEPT for of in by_method), strict=True)),
        "time_s": after["time_s"],
    }


def summarise(rows: Sequence[Mapping[str, Any]], resamples: int) -> dict[str, Any]:
    """Returns a cell's means over frames, of each frame's mean over its draws.

    Frames of which a draw failed are left out. Gains are in per cent, positive where the refinement
    is better: over the plain network, and over linear interpolation.

    Args:
        rows: All draws of all frames of the cell, as of `row_of`, with the frame's name.
        resamples: Bootstrap samples behind the intervals, which are studentised and over sequences
            of frames; there are none with fewer than MIN_CLUSTERS of these.
    """
    by_frame: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_frame.setdefault(row["frame"], []).append(row)
    whole = {n: of for n, of in by_frame.items() if all(r["status"] != "failed" for r in of)}
    counts = {
        "frames": len(whole),
        "failed": len(by_frame) - len(whole),
        "diverged": sum(row["status"] == "diverged" for row in rows),
    }
    if not whole:
        return counts | {"time_s": None, "points": None, "measures": None}
    scores = [np.array([[r[k] for k in SCORES] for r in of], float) for of in whole.values()]
    table = np.stack([each.mean(axis=0) for each in scores])
    table = table.reshape(len(table), len(SWEPT), len(METHODS)).swapaxes(1, 2)
    mean, low, high = _mean_and_interval(table, list(whole), resamples)
    values = {name: mean[row] for row, name in enumerate(_ROWS)}
    for name in ("refined", "gain"):
        values[f"{name}_low"], values[f"{name}_high"] = (
            end[_ROWS.index(name)] for end in (low, high)
        )
    used = [row for of in whole.values() for row in of]
    measures = {
        measure.key: {name: float(values[name][m]) for name in _COLUMNS}
        for m, measure in enumerate(SWEPT)
    }
    time_s, points = (np.mean([row[key] for row in used]) for key in ("time_s", "points_used"))
    result: dict[str, Any] = plain(
        counts | {"time_s": time_s, "points": points, "measures": measures}
    )
    return result


def _mean_and_interval(
    table: Floats, names: Sequence[str], resamples: int
) -> tuple[Floats, Floats, Floats]:
    """(5, measures) each, of a table (frames, methods, measures): means and gains, their ends."""
    plain, linear, refined = (FrameTable.of_frames(table[:, method]) for method in range(3))
    clusters = find_clusters(groups_by_name(names), table.reshape(len(table), -1))
    drawing = clusters, resamples, 0
    ends = [interval(lambda means: means, [each], *drawing) for each in (plain, linear, refined)]
    ends += [
        interval(lambda a, b: gain(a, b, _BETTER), [each, refined], *drawing)
        for each in (plain, linear)
    ]
    means = table.mean(axis=0)
    mean = np.concatenate([means, [gain(each, means[2], _BETTER) for each in means[:2]]])
    low, high = np.stack(ends, axis=1)
    return mean, low, high


def write_sweep(folder: Path, record: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes sweep.json, the means to sweep.csv and sweep.tex, and all rows to sweep_frames.csv."""
    studies = record["studies"]
    write_json(folder / "sweep.json", record)
    write_text(folder / "sweep.tex", "\n".join(_latex(study, record) for study in studies))
    names = list(dict.fromkeys(name for study in studies for name in study["parameters"]))
    timed = ["time_s"] * any("time_s" in cell for study in studies for cell in study["cells"])
    counts = ("frames", "failed", "diverged", "points_used", *timed)
    means = [f"{measure.key}_{name}" for measure in SWEPT for name in _COLUMNS]
    cells = [
        {
            "study": study["name"],
            **cell["parameters"],
            **{f"{m}_{n}": v for m, of in (cell["measures"] or {}).items() for n, v in of.items()},
            **{name: cell[name.removesuffix("_used")] for name in counts},
        }
        for study in studies
        for cell in study["cells"]
    ]
    _write_csv(folder / "sweep.csv", ("study", *names, *counts, *means), cells)
    columns = ("study", *names, "frame", "seed", "status", "points_used", *timed, *SCORES)
    _write_csv(folder / "sweep_frames.csv", tuple(dict.fromkeys(columns)), rows)


def _latex(study: Mapping[str, Any], record: Mapping[str, Any]) -> str:
    """A tabular of a study: MAE and RMSE of each method, the gain in MAE and its interval."""
    names = list(study["parameters"])
    header = [*names, *(f"{m} {what} [m]" for m in ("MAE", "RMSE") for what in METHODS)]
    header += ["gain [%]", "low", "high"]
    shown = [("mae", n, ".4f") for n in METHODS] + [("rmse", n, ".4f") for n in METHODS]
    shown += [("mae", name, "+.1f") for name in ("gain", "gain_low", "gain_high")]
    rows = []
    for cell in study["cells"]:
        measures = cell["measures"] or {}
        values = [(measures.get(key, {}).get(name), form) for key, name, form in shown]
        texts = ["–" if value is None else f"{value:{form}}" for value, form in values]
        rows.append([*(str(cell["parameters"][name]) for name in names), *texts])
    caption = (
        f"means over {len(record['frames']):,} frames, {record['seeds']} draws of the points each;"
        " gain: in per cent of the plain network's MAE; interval: 95 %, over sequences of frames"
    )
    return Table(header=header, rows=rows, caption=caption).latex()


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    cells: list[list[Any]] = [[row.get(name) for name in header] for row in rows]
    text = io.StringIO()
    write_csv(text, header, cells)
    write_text(path, text.getvalue())
