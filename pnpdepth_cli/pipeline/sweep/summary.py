"""Averages a sweep's cells over frames, with intervals, and writes the files that hold them."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from pnpdepth_cli.core.metrics import MEASURES
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import write_csv
from pnpdepth_cli.io.record import plain, write_json
from pnpdepth_cli.pipeline.evaluation.dependence import find_clusters, groups_by_name
from pnpdepth_cli.pipeline.evaluation.resampling import (
    Floats,
    FrameTable,
    gain,
    gain_interval,
    mean_interval,
)
from pnpdepth_cli.pipeline.tables import Table

CONFIDENCE = 0.95
MIN_SEEDS = 3
"""An interval of fewer draws says nothing: of two it is 13 standard errors wide."""
METHODS = ("plain", "linear", "refined")
SWEPT = tuple(m for m in MEASURES if m.key in ("mae", "rmse", "mre", "delta1"))
"""The measures of a sweep."""

_BETTER = np.array([1.0 if m.higher_is_better else -1.0 for m in SWEPT])
_MEASURE_COLUMNS = (
    *(*METHODS, "refined_low", "refined_high"),
    *("gain", "gain_low", "gain_high", "gain_over_linear"),
)


@dataclass(frozen=True, kw_only=True)
class FrameFigures:
    """The scores of one frame with one draw of its points."""

    name: str
    """The frame's name."""
    seed: int
    """Of the draw."""
    values: Floats | None
    """(methods, measures); None if something failed."""
    points: int = 0
    """How many points were drawn."""
    time_s: float | None = None
    """Seconds of the refinement; None if they were not recorded."""
    diverged: bool = False
    """True if the refinement made fewer updates than it should."""

    @classmethod
    def of(
        cls,
        name: str,
        seed: int,
        iterations: int,
        *,
        linear: Mapping[str, Any] | None,
        curve: Mapping[str, Any] | None,
    ) -> FrameFigures:
        """Returns the scores in the journal's lines.

        Args:
            name: The frame's name.
            seed: Of the draw.
            iterations: The number of updates whose scores are wanted.
            linear: The line of linear interpolation; None if it failed.
            curve: The line of the refinement; None if it failed.
        """
        if linear is None or curve is None:
            return cls(name=name, seed=seed, values=None)
        by_method = {
            "plain": curve["plain"],
            "linear": linear["scores"]["linear"],
            "refined": curve["scores"][str(iterations)],
        }
        rows = [[by_method[method][m.key] for m in SWEPT] for method in METHODS]
        return cls(
            name=name,
            seed=seed,
            values=np.array(rows, np.float64),  # null in JSON becomes NaN
            points=curve["points"],
            time_s=by_method["refined"].get("time_s"),
            diverged=by_method["refined"]["updates"] < iterations,
        )


def summarise(
    figures: Sequence[FrameFigures], resamples: int, *, cost: bool = False
) -> dict[str, Any]:
    """Returns a cell's means over frames, of each frame's mean over its draws.

    Frames of which a draw failed are left out. Gains are in per cent, positive where the refinement
    is better: over the plain network, and over linear interpolation.

    Args:
        figures: All draws of all frames of the cell.
        resamples: Bootstrap samples behind the intervals, which are studentised and over sequences
            of frames; there are none with fewer than MIN_CLUSTERS of these.
        cost: True to add the mean time of a refinement.
    """
    by_frame: dict[str, list[FrameFigures]] = {}
    for each in figures:
        by_frame.setdefault(each.name, []).append(each)
    whole = [of for of in by_frame.values() if all(each.values is not None for each in of)]
    counts: dict[str, Any] = {
        "frames": len(whole),
        "failed": len(by_frame) - len(whole),
        "diverged": sum(each.diverged for each in figures),
    }
    if cost:
        times = [each.time_s for of in whole for each in of if each.time_s is not None]
        counts |= {"time_s": float(np.mean(times)) if times else None}
    if not whole:
        return counts | {"points": None, "measures": None}
    table = np.stack(
        [np.mean([each.values for each in of if each.values is not None], axis=0) for of in whole]
    )
    mean, low, high = _mean_and_interval(table, [of[0].name for of in whole], resamples)
    points = float(np.mean([each.points for of in whole for each in of]))
    result: dict[str, Any] = plain(
        counts | {"points": points, "measures": _by_measure(mean, low, high)}
    )
    return result


def _mean_and_interval(
    table: Floats, names: Sequence[str], resamples: int
) -> tuple[Floats, Floats, Floats]:
    """(5, measures) each, of a table (frames, methods, measures): means and gains, their ends."""
    plain, linear, refined = tables = [FrameTable.of_frames(table[:, m]) for m in range(3)]
    clusters = find_clusters(groups_by_name(names), table.reshape(len(table), -1))
    drawing = clusters.ids, resamples, 0
    ends = [mean_interval(each, *drawing) for each in tables]
    ends += [gain_interval(before, refined, _BETTER, *drawing) for before in (plain, linear)]
    means = table.mean(axis=0)
    gains = [gain(before, means[2], _BETTER) for before in means[:2]]
    mean = np.concatenate([means, gains])
    low, high = np.where(np.isnan(mean), math.nan, np.stack(ends, axis=1))
    return mean, low, high


def _by_measure(mean: Floats, low: Floats, high: Floats) -> dict[str, dict[str, float]]:
    rows = {method: number for number, method in enumerate((*METHODS, "gain", "gain_over_linear"))}
    entries = {
        **{name: (mean, row) for name, row in rows.items()},
        **{f"{name}_low": (low, rows[name]) for name in ("refined", "gain")},
        **{f"{name}_high": (high, rows[name]) for name in ("refined", "gain")},
    }
    return {
        measure.key: {
            name: float(entries[name][0][entries[name][1], m]) for name in _MEASURE_COLUMNS
        }
        for m, measure in enumerate(SWEPT)
    }


def over_seeds(cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the MAE over the seeds of the points, for each setting of the other parameters.

    Every figure has a mean and the ends of its 95 % interval (Student's t over the draws, of each
    of which the mean over all frames is taken). The interval covers the choice of the points, not
    that of the frames.

    Args:
        cells: Of one study; those without a parameter `seed`, or without scores, are left out.
    """
    groups: dict[tuple[tuple[str, str], ...], list[Mapping[str, float]]] = {}
    for cell in cells:
        parameters, measures = cell["parameters"], cell["measures"]
        if "seed" in parameters and measures is not None:
            others = tuple((name, value) for name, value in parameters.items() if name != "seed")
            groups.setdefault(others, []).append(measures["mae"])
    return [
        {
            "parameters": dict(others),
            "seeds": len(drawn),
            "mae": {
                name: _over_draws([each[name] for each in drawn]) for name in (*METHODS, "gain")
            },
        }
        for others, drawn in groups.items()
        if len(drawn) >= MIN_SEEDS
    ]


def _over_draws(values: Sequence[float | None]) -> dict[str, float | None]:
    """The mean and the ends of its interval; None where a value is missing."""
    numbers = np.array([math.nan if value is None else value for value in values])
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(numbers) - 1) * stats.sem(numbers)
    ends = {"mean": numbers.mean(), "low": numbers.mean() - half, "high": numbers.mean() + half}
    return {name: float(end) if math.isfinite(end) else None for name, end in ends.items()}


def write_sweep(folder: Path, record: Mapping[str, Any]) -> None:
    """Writes the record to sweep.json, and a line for each of its cells to sweep.csv."""
    write_json(folder / "sweep.json", record)
    tables = (_latex(study, record) for study in record["studies"])
    _write_text(folder / "sweep.tex", "\n".join(tables))
    names = _parameters(record["studies"])
    cost = ["time_s"] * any("time_s" in c for study in record["studies"] for c in study["cells"])
    header = ["study", *names, "frames", "failed", "diverged", "points_used", *cost]
    header += [f"{measure.key}_{name}" for measure in SWEPT for name in _MEASURE_COLUMNS]

    def rows() -> Iterator[list[Any]]:
        for study in record["studies"]:
            for cell in study["cells"]:
                measures = cell["measures"] or {}
                yield [
                    study["name"],
                    *(cell["parameters"].get(name) for name in names),
                    *(cell[name] for name in ("frames", "failed", "diverged", "points", *cost)),
                    *(
                        measures.get(measure.key, {}).get(name)
                        for measure in SWEPT
                        for name in _MEASURE_COLUMNS
                    ),
                ]

    _write_csv(folder / "sweep.csv", header, rows())


def _latex(study: Mapping[str, Any], record: Mapping[str, Any]) -> str:
    """A tabular of a study: MAE and RMSE of each method, the gain in MAE and its interval."""
    names = list(study["parameters"])
    header = [*names, *(f"{m} {what} [m]" for m in ("MAE", "RMSE") for what in METHODS)]
    header += ["gain [%]", "low", "high"]
    rows = []
    for cell in study["cells"]:
        measures = cell["measures"] or {}
        mae = measures.get("mae", {})
        values = [measures.get(key, {}).get(name) for key in ("mae", "rmse") for name in METHODS]
        row = ["–" if value is None else f"{value:.4f}" for value in values]
        gains = [mae.get(name) for name in ("gain", "gain_low", "gain_high")]
        row += ["–" if value is None else f"{value:+.1f}" for value in gains]
        rows.append([*(cell["parameters"][name] for name in names), *row])
    caption = (
        f"means over {len(record['frames']):,} frames, {record['seeds']} draws of the points each;"
        " gain: in per cent of the plain network's MAE; interval: 95 %, over sequences of frames"
    )
    return Table(header=header, rows=rows, caption=caption).latex()


def write_frames(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes a line for each cell, frame and seed: study, parameters and scores."""
    names = list(dict.fromkeys(name for row in rows for name in row["parameters"]))
    header = ["study", *names, "frame", "seed", "status", "points_used"]
    header += [f"{measure.key}_{method}" for measure in SWEPT for method in METHODS]

    def lines() -> Iterator[list[Any]]:
        for row in rows:
            figures: FrameFigures = row["figures"]
            status = "diverged" if figures.diverged else "done"
            values = [None] * len(SWEPT) * len(METHODS)
            if figures.values is not None:
                values = plain(figures.values.T.ravel().tolist())
            yield [
                row["study"],
                *(row["parameters"].get(name) for name in names),
                *(figures.name, figures.seed),
                *("failed" if figures.values is None else status, figures.points),
                *values,
            ]

    _write_csv(path, header, lines())


def _parameters(studies: Sequence[Mapping[str, Any]]) -> list[str]:
    """The parameters that are varied, each once."""
    return list(dict.fromkeys(name for study in studies for name in study["parameters"]))


def _write_csv(path: Path, header: Sequence[str], rows: Iterator[list[Any]]) -> None:
    text = io.StringIO()
    write_csv(text, header, rows)
    _write_text(path, text.getvalue())


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        # a file name that is no UTF-8 has surrogates
        temporary.write_bytes(text.encode("utf-8", "backslashreplace"))
