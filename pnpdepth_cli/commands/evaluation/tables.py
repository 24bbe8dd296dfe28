"""The tables of an evaluation and of a comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pnpdepth_cli.commands.evaluation.compare import ALPHA
from pnpdepth_cli.commands.evaluation.evaluate import Evaluation, frame_record
from pnpdepth_cli.commands.evaluation.scoring import FrameScores
from pnpdepth_cli.commands.tables import Cell, Style, Table
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.measures import COVERAGE, Measure, chosen_measures

_FRAMES_SHOWN = 12
_FRAME_COLUMNS = 6
_STARS = (0.05, 0.01, 0.001)


def text_tables(evaluation: Evaluation, keys: Sequence[str] | None) -> list[Table]:
    """Returns what the terminal shows: the means, and the frames or the worst of them."""
    frames = [worst_frames(evaluation, keys)] if len(evaluation.frames) > 1 else []
    return [means_table(evaluation, keys), *frames]


def means_table(evaluation: Evaluation, keys: Sequence[str] | None) -> Table:
    """Returns a row for each measure: its mean and the interval of it."""
    count = len(evaluation.scored)
    pixels = sum(frame.pixels for frame in evaluation.frames)
    title = f"Means over {count:,} frame{'' if count == 1 else 's'}, {pixels:,} pixels"
    columns, intervals = ["", "mean"], evaluation.interval
    if intervals is not None:
        columns.append("95 %")
        title += f"; 95 % interval over {evaluation.clusters.describe()}"
    rows = []
    mean = evaluation.mean | {COVERAGE.key: evaluation.coverage}
    for measure in (*chosen_measures(evaluation.measures, keys), COVERAGE):
        row = [measure.heading, measure.text(mean[measure.key])]
        if intervals is not None:
            row.append(" … ".join(measure.text(end) for end in intervals.get(measure.key, ())))
        rows.append(row)
    title += _without_sparse(evaluation.request.rules.exclude_sparse)
    return Table(title=title, columns=columns, rows=rows)


def frames_table(evaluation: Evaluation, keys: Sequence[str] | None) -> Table:
    """Returns a row for each frame: its files, its counts, and the chosen measures as stored."""
    measures = chosen_measures(evaluation.measures, keys)
    records = [plain(frame_record(frame)) for frame in evaluation.frames]
    facts = [name for name in records[0] if name not in ("scores", "error")]
    rows = []
    for record in records:
        values = (record["scores"] or {}).get("after", {})
        row = [*(record[name] for name in facts), *(values.get(m.key) for m in measures)]
        rows.append([*row, record["error"]])
    columns = [COVERAGE if name == COVERAGE.key else name for name in facts]
    return Table(columns=[*columns, *measures, "error"], rows=rows)


def worst_frames(evaluation: Evaluation, keys: Sequence[str] | None) -> Table:
    """Returns the chosen or first measures of each frame, or of the worst of many."""
    title, found = "Frames", evaluation
    if len(evaluation.frames) > _FRAMES_SHOWN:
        found = replace(evaluation, frames=worst(evaluation)[:_FRAMES_SHOWN])
        title = f"The {_FRAMES_SHOWN} worst by RMSE; --csv has all"
    shown = keys or [measure.key for measure in evaluation.measures[:_FRAME_COLUMNS]]
    table = frames_table(found, keys).only(["name", *shown, COVERAGE.key])
    return replace(table, title=title + _without_sparse(evaluation.request.rules.exclude_sparse))


def worst(evaluation: Evaluation) -> tuple[FrameScores, ...]:
    """Returns the scored frames by RMSE, worst first, those with NaN at the very end."""
    rmse = {frame.name: frame.values["rmse"] for frame in evaluation.scored}
    order = sorted(evaluation.scored, key=lambda f: (math.isnan(rmse[f.name]), -rmse[f.name]))
    return tuple(order)


def comparison_table(comparison: Mapping[str, Any]) -> Table:
    """Returns a row for each measure and run; all runs but the first have gain and p."""
    (first, *others), measures = comparison["runs"], _measures(comparison)
    rows: list[list[Any]] = []
    for measure in measures:
        rows.append([measure.heading, first["name"], measure.text(first["mean"][measure.key])])
        rows[-1] += ["–"] * 4
        for run, gains in zip(others, comparison["gains"], strict=True):
            found = gains[measure.key]
            percent, p = found["percent"], found["p_adjusted"]
            style: Style = "good" if (percent or 0) > 0 else "bad"
            ends = (_signed(found[end]) for end in ("low_percent", "high_percent"))
            rows.append([
                measure.heading,
                run["name"],
                measure.text(run["mean"][measure.key]),
                Cell(_signed(percent), style if p is not None and p < ALPHA else "dim"),
                *ends,
                "–" if p is None else f"{p:.4f}",
            ])  # fmt: skip
    swaps = "all" if comparison["exact_p_values"] else f"{comparison['permutations']:,} random"
    return Table(
        title=(
            f"{len(comparison['frames']):,} shared frames; gains in per cent of the error of"
            f" {first['name']}, positive is better; intervals (95 %) and p-values, from {swaps}"
            f" swaps, {_tested(comparison)}"
        ),
        columns=["measure", "run", "mean", "gain [%]", "low", "high", "p"],
        rows=rows,
    )


def methods_table(comparison: Mapping[str, Any]) -> Table:
    """Returns a row for each run and a column for each measure, the best of a column in bold.

    Stars mark where a run differs from the first significantly.
    """
    runs, measures = comparison["runs"], _measures(comparison)
    rows: list[list[str]] = [[run["name"]] for run in runs]
    for measure in measures:
        means = [run["mean"][measure.key] for run in runs]
        pick = max if measure.better == "higher" else min
        best = measure.text(pick((m for m in means if m is not None), default=None))
        p_values = [1.0, *(gains[measure.key]["p_adjusted"] for gains in comparison["gains"])]
        for row, mean, p in zip(rows, means, p_values, strict=True):
            stars = "*" * sum(p is not None and p < limit for limit in _STARS)
            is_best = mean is not None and measure.text(mean) == best and measure.sign != 0
            row.append(Cell(measure.text(mean) + stars, "bold" if is_best else ""))
    return Table(
        title=(
            f"means over {len(comparison['frames']):,} frames, the best in bold; *, **, ***:"
            f" differs from {runs[0]['name']} with p < 0.05, 0.01, 0.001 {_tested(comparison)}"
        ),
        columns=["", *measures],
        rows=rows,
    )


def _measures(comparison: Mapping[str, Any]) -> list[Measure]:
    return [Measure.from_json(entry) for entry in comparison["measures"]]


def _tested(comparison: Mapping[str, Any]) -> str:
    clusters, runs = comparison["clusters"], len(comparison["gains"])
    over = f"{clusters['count']:,} {clusters['unit']}"
    tests = f"{len(comparison['measures'])} measures" + (f" of {runs} runs" if runs > 1 else "")
    tested = f"over {over}, p adjusted for {tests} (Holm)"
    return tested + _without_sparse(comparison["scoring"].get("exclude_sparse", False))


def _without_sparse(excluded: bool) -> str:
    return "; without the pixels of sparse points" if excluded else ""


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}"
