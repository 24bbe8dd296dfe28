"""The tables of an evaluation and of a comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pnpdepth_cli.commands.evaluation.compare import ALPHA
from pnpdepth_cli.commands.evaluation.evaluate import Evaluation, frame_record, readings_of
from pnpdepth_cli.commands.evaluation.scoring import FrameScores
from pnpdepth_cli.commands.tables import (
    Cell,
    Style,
    Table,
)
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.measures import Measure, chosen_measures

_FRAMES_SHOWN = 12
_FRAME_COLUMNS = 6
_STARS = (0.05, 0.01, 0.001)


def text_tables(evaluation: Evaluation, columns: Sequence[str] | None) -> list[Table]:
    """Returns what the terminal shows: the means, the frames or the worst of them, calibration."""
    frames = [frames_table(evaluation, columns)] if len(evaluation.frames) > 1 else []
    return [means_by_measure(evaluation, columns), *frames, *calibration_tables(evaluation)]


def means_by_measure(evaluation: Evaluation, columns: Sequence[str] | None) -> Table:
    """Returns a row for each measure: its mean and the interval of it."""
    count = len(evaluation.scored)
    pixels = sum(frame.pixels for frame in evaluation.frames)
    of = f"{count:,} frame{'' if count == 1 else 's'}, {pixels:,} pixels"
    caption = f"Means over {of}"
    header, has_interval = ["", "mean"], evaluation.interval is not None
    if has_interval:
        header.append("95 %")
        caption += f"; 95 % interval over {evaluation.clusters.describe()}"
    caption += _without_sparse(evaluation.protocol.exclude_sparse)
    rows = []
    for measure in chosen_measures(evaluation.protocol.measures, columns):
        interval = [_interval(evaluation, measure)] if has_interval else []
        mean = measure.text(evaluation.mean[measure.key])
        rows.append([measure.heading, mean, *interval])
    coverage = ["coverage ↑", f"{evaluation.coverage:.2%}", *[""] * has_interval]
    return Table(header=header, rows=[*rows, coverage], caption=caption)


def means_row(evaluation: Evaluation, name: str, columns: Sequence[str] | None) -> Table:
    """Returns one row: the chosen means with their intervals, the frames and the coverage."""
    measures = chosen_measures(evaluation.protocol.measures, columns)
    cells = [measure.text(evaluation.mean[measure.key]) for measure in measures]
    if evaluation.interval is not None:
        ends = [_interval(evaluation, measure) for measure in measures]
        cells = [f"{cell} ({end})" for cell, end in zip(cells, ends, strict=True)]
    scored = f"{len(evaluation.scored):,} of {len(evaluation.frames):,}"
    assumed = {
        f"{side}: {reading}"
        for side in ("prediction", "gt")
        for reading, _ in readings_of(evaluation.frames, side)
        if reading.assumed
    }
    return Table(
        header=["", *(m.heading for m in measures), "frames", "coverage"],
        rows=[[name, *cells, scored, f"{evaluation.coverage:.2%}"]],
        caption="; ".join([evaluation.protocol.describe(), *sorted(assumed)]),
    )


def _interval(evaluation: Evaluation, measure: Measure) -> str:
    ends = (evaluation.interval or {}).get(measure.key, ())
    return " … ".join(measure.text(end) for end in ends)


def frames_csv(evaluation: Evaluation, columns: Sequence[str] | None) -> Table:
    """Returns a row for each frame: its files, its counts, and the chosen measures as stored."""
    keys = [measure.key for measure in chosen_measures(evaluation.protocol.measures, columns)]
    records = [plain(frame_record(frame)) for frame in evaluation.frames]
    facts = [name for name in records[0] if name not in ("values", "error")]
    rows = [
        [*(r[name] for name in facts), *(r["values"].get(key) for key in keys), r["error"]]
        for r in records
    ]
    return Table(header=[*facts, *keys, "error"], rows=rows)


def frames_table(evaluation: Evaluation, columns: Sequence[str] | None) -> Table:
    """Returns the chosen or first measures of each frame, or of the worst of many."""
    measures = chosen_measures(evaluation.protocol.measures, columns)
    measures = measures if columns else measures[:_FRAME_COLUMNS]
    everything = len(evaluation.frames) <= _FRAMES_SHOWN
    frames = evaluation.frames if everything else worst(evaluation, "rmse")[:_FRAMES_SHOWN]
    caption = "Frames" if everything else f"The {len(frames)} worst by RMSE; --csv has all"
    return Table(
        caption=caption + _without_sparse(evaluation.protocol.exclude_sparse),
        header=["frame", *(m.heading for m in measures), "coverage"],
        rows=[
            [frame.name, *(m.text(frame.values.get(m.key)) for m in measures),
             _coverage(frame)]
            for frame in frames
        ],
    )  # fmt: skip


def worst(evaluation: Evaluation, key: str) -> list[FrameScores]:
    """Returns the scored frames by one measure, worst first, those with NaN at the very end."""
    (measure,) = (m for m in evaluation.protocol.measures if m.key == key)
    sign = measure.sign
    values = ((frame, frame.values[key]) for frame in evaluation.scored)
    ordered = sorted(values, key=lambda of: (math.isnan(of[1]), sign * of[1]))
    return [frame for frame, _ in ordered]


def _coverage(frame: FrameScores) -> str:
    if frame.missing:
        return Cell("missing", "bad")
    return f"{frame.coverage:.2%}" if frame.scored else Cell("not scored", "bad")


def calibration_tables(evaluation: Evaluation) -> list[Table]:
    """Returns how right the predicted standard deviation is, if there is one."""
    found = evaluation.uncertainty
    if found is None:
        return []
    rows = [
        ["errors within 1σ", f"{found['within_1_sigma']:.1%}", "68.3%"],
        ["errors within 2σ", f"{found['within_2_sigma']:.1%}", "95.4%"],
        ["AUSE (MAE, normalised)", f"{found['ause']:.4f}", "0"],
    ]
    count = found["frames"]
    caption = f"Standard deviation of {count:,} frame{'' if count == 1 else 's'}"
    return [Table(caption=caption, header=["", "observed", "calibrated"], rows=rows)]


def comparison_table(comparison: Mapping[str, Any]) -> Table:
    """Returns a row for each measure and run; all runs but the first have gain and p."""
    (base, *others), measures = comparison["runs"], _measures(comparison)
    rows = []
    for measure in measures:
        title, mean = measure.heading, measure.text(base["mean"][measure.key])
        rows.append([title, base["name"], mean, *["–"] * 4])
        for run, gains in zip(others, comparison["gains"], strict=True):
            found = gains[measure.key]
            percent, p = found["percent"], found["p_adjusted"]
            style: Style = "good" if (percent or 0) > 0 else "bad"
            style = style if p is not None and p < ALPHA else "dim"
            rows.append([
                title,
                run["name"],
                measure.text(run["mean"][measure.key]),
                Cell(_signed(percent), style),
                *(_signed(found[end]) for end in ("low_percent", "high_percent")),
                "–" if p is None else f"{p:.4f}",
            ])  # fmt: skip
    swaps = "all" if comparison["exact_p_values"] else f"{comparison['permutations']:,} random"
    return Table(
        header=["measure", "run", "mean", "gain [%]", "low", "high", "p"],
        rows=rows,
        caption=(
            f"{len(comparison['frames']):,} shared frames; gains in per cent of the error of"
            f" {base['name']}, positive is better; intervals (95 %) and p-values, from {swaps}"
            f" swaps, {_tested(comparison)}"
        ),
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
            text, stars = (
                measure.text(mean),
                "*" * sum(p is not None and p < limit for limit in _STARS),
            )
            is_best = text == best and mean is not None
            row.append(Cell(text + stars, "bold" if is_best else ""))
    return Table(
        header=["", *(m.heading for m in measures)],
        rows=rows,
        caption=(
            f"means over {len(comparison['frames']):,} frames, the best in bold; *, **, ***:"
            f" differs from {runs[0]['name']} with p < 0.05, 0.01, 0.001 {_tested(comparison)}"
        ),
    )
