"""Means over frames of a sweep's cells, with their intervals, and the files that hold them."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.core.metrics import MEASURES
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import text_cell
from pnpdepth_cli.io.record import plain, write_json
from pnpdepth_cli.pipeline.evaluation.averages import Floats, bootstrap

METHODS = ("plain", "linear", "refined")
SWEPT = tuple(m for m in MEASURES if m.key in ("mae", "rmse", "mre", "delta1"))
"""The measures of a sweep."""

_BETTER = np.array([1.0 if m.higher_is_better else -1.0 for m in SWEPT])
_OF_A_MEASURE = (
    *(*METHODS, "refined_low", "refined_high"),
    *("gain", "gain_low", "gain_high", "gain_over_linear"),
)


@dataclass(frozen=True, kw_only=True)
class FrameFigures:
    """One frame with one draw of its points.

    values: (methods, measures), None if something failed. points: how many. diverged: the
    refinement did not get as far as it was to.
    """

    name: str
    seed: int
    values: Floats | None
    points: int = 0
    diverged: bool = False

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
        """From the journal's lines of the interpolation and the refinement, None for a failure."""
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
            values=np.array(rows, np.float64),  # None, which is no number in JSON, becomes NaN
            points=curve["points"],
            diverged=by_method["refined"]["updates"] < iterations,
        )


def summarise(figures: Sequence[FrameFigures], resamples: int) -> dict[str, Any]:
    """A cell's means over the frames all draws of which went through, of each frame's over those.

    Intervals are of frames drawn again and again (bootstrap), None for a single frame. Gains are
    in per cent, positive where the refinement is better: over the plain network, and over linear
    interpolation.
    """
    by_frame: dict[str, list[FrameFigures]] = {}
    for each in figures:
        by_frame.setdefault(each.name, []).append(each)
    whole = [of for of in by_frame.values() if all(each.values is not None for each in of)]
    counts = {
        "frames": len(whole),
        "failed": len(by_frame) - len(whole),
        "diverged": sum(each.diverged for each in figures),
    }
    if not whole:
        return counts | {"points": None, "measures": None}
    table = np.stack(
        [np.mean([each.values for each in of if each.values is not None], axis=0) for of in whole]
    )
    mean = _figures(table.mean(axis=0)[None])[0]
    low = high = np.full_like(mean, np.nan)
    if len(table) > 1:
        low, high = bootstrap(
            lambda weights: _figures(np.tensordot(weights, table, axes=1) / len(table)).reshape(
                len(weights), -1
            ),
            len(table),
            resamples,
            seed=0,
        )
        low, high = low.reshape(mean.shape), high.reshape(mean.shape)
    points = float(np.mean([each.points for of in whole for each in of]))
    found: dict[str, Any] = plain(
        counts | {"points": points, "measures": _by_measure(mean, low, high)}
    )
    return found


def _figures(means: Floats) -> Floats:
    """(B, 5, measures) of means (B, methods, measures): these, and the gains over the others."""
    before, refined = means[:, :2], means[:, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        change = 100 * _BETTER * (refined - before) / np.abs(before)
        gains = np.where(before == refined, 0.0, change)
    return np.concatenate([means, np.where(np.isfinite(gains), gains, np.nan)], axis=1)


def _by_measure(mean: Floats, low: Floats, high: Floats) -> dict[str, dict[str, float]]:
    rows = {method: number for number, method in enumerate((*METHODS, "gain", "gain_over_linear"))}
    places = {
        **{name: (mean, row) for name, row in rows.items()},
        **{f"{name}_low": (low, rows[name]) for name in ("refined", "gain")},
        **{f"{name}_high": (high, rows[name]) for name in ("refined", "gain")},
    }
    return {
        measure.key: {name: float(places[name][0][places[name][1], m]) for name in _OF_A_MEASURE}
        for m, measure in enumerate(SWEPT)
    }


def write_sweep(folder: Path, record: Mapping[str, Any]) -> None:
    """sweep.json holds the record, sweep.csv a line for each of its cells."""
    write_json(folder / "sweep.json", record)
    names = _parameters(record["studies"])
    header = ["study", *names, "frames", "failed", "diverged", "points"]
    header += [f"{measure.key}_{name}" for measure in SWEPT for name in _OF_A_MEASURE]

    def rows() -> Iterator[list[Any]]:
        for study in record["studies"]:
            for cell in study["cells"]:
                measures = cell["measures"] or {}
                yield [
                    study["name"],
                    *(cell["parameters"].get(name) for name in names),
                    *(cell[name] for name in ("frames", "failed", "diverged", "points")),
                    *(
                        measures.get(measure.key, {}).get(name)
                        for measure in SWEPT
                        for name in _OF_A_MEASURE
                    ),
                ]

    _write_csv(folder / "sweep.csv", header, rows())


def write_frames(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """The file holds a line for each cell, frame and seed: study, parameters and figures."""
    names = list(dict.fromkeys(name for row in rows for name in row["parameters"]))
    header = ["study", *names, "frame", "seed", "status", "points"]
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
                *(text_cell(figures.name), figures.seed),
                *("failed" if figures.values is None else status, figures.points),
                *values,
            ]

    _write_csv(path, header, lines())


def _parameters(studies: Sequence[Mapping[str, Any]]) -> list[str]:
    """All that are varied, each once."""
    return list(dict.fromkeys(name for study in studies for name in study["parameters"]))


def _write_csv(path: Path, header: Sequence[str], rows: Iterator[list[Any]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    with atomic_path(path) as temporary:
        # A file name that is no UTF-8 has characters that are none.
        temporary.write_bytes(text.getvalue().encode("utf-8", "backslashreplace"))
