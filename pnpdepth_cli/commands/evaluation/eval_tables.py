"""The tables of an evaluation and of a comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pnpdepth_cli.commands.evaluation.compare import ALPHA, PERMUTATIONS, Comparison
from pnpdepth_cli.commands.evaluation.evaluate import Evaluation
from pnpdepth_cli.commands.evaluation.scoring import FILES, scores_of
from pnpdepth_cli.commands.tables import Cell, Style, Table
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.text_files import plain
from pnpdepth_cli.measures import COVERAGE, choose_measures

_FRAMES_SHOWN = 12
_FRAME_COLUMNS = 6
_COUNTS = ("pixels", "known", COVERAGE.key, "given", "median_ratio", "factor", "shift")
_STARS = (0.05, 0.01, 0.001)


def means_table(evaluation: Evaluation, keys: Sequence[str] | None) -> Table:
    """Returns a row for each measure: its mean and the interval of it."""
    count, intervals = len(evaluation.scored), evaluation.interval
    title = f"Means over {count:,} frame{'s' * (count != 1)}, {evaluation.pixels:,} pixels"
    columns = ["", "mean"]
    if intervals is not None:
        columns.append("95 %")
        title += f"; 95 % interval over {evaluation.clusters.describe()}"
    rows = []
    mean = evaluation.mean | {COVERAGE.key: evaluation.coverage}
    for measure in (*choose_measures(evaluation.measures, keys), COVERAGE):
        ends = [] if intervals is None else [intervals.get(measure.key, ())]
        texts = (" … ".join(map(measure.text, each)) for each in ends)
        rows.append([measure.heading, measure.text(mean[measure.key]), *texts])
    title += _without_sparse(evaluation.request.rules.exclude_sparse)
    return Table(title=title, columns=columns, rows=rows)


def frames_table(evaluation: Evaluation, keys: Sequence[str] | None) -> Table:
    """Returns a row for each frame: its files, its counts, and the chosen measures as stored."""
    measures = choose_measures(evaluation.measures, keys)
    rows = []
    for frame in evaluation.frames:
        files, scores = (frame.inputs.get(name) for name in FILES), plain(scores_of(frame))
        row = [frame.name, frame.group, *(file and file.path for file in files)]
        row += map(scores.get, (*_COUNTS, *(measure.key for measure in measures)))
        rows.append([*row, frame.message])
    counts = [COVERAGE if name == COVERAGE.key else name for name in _COUNTS]
    return Table(columns=["name", "group", *FILES, *counts, *measures, "error"], rows=rows)


def worst_frames(evaluation: Evaluation, keys: Sequence[str] | None) -> Table:
    """Returns the chosen or first measures of each frame, or of the worst of many."""
    title, frames = "Frames", evaluation.frames
    if len(frames) > _FRAMES_SHOWN:
        frames = worst(evaluation)[:_FRAMES_SHOWN]
        title = f"The {_FRAMES_SHOWN} worst by RMSE; --csv has all"
    measures = choose_measures(evaluation.measures, keys)
    shown = [*(measures if keys else measures[:_FRAME_COLUMNS]), COVERAGE]
    return Table(
        title=title + _without_sparse(evaluation.request.rules.exclude_sparse),
        columns=["name", *shown],
        rows=[[frame.name, *(scores_of(frame).get(m.key) for m in shown)] for frame in frames],
    )


def worst(evaluation: Evaluation) -> list[FrameRecord]:
    """Returns the scored frames by RMSE, worst first, those with NaN at the very end."""

    def rank(frame: FrameRecord) -> float:
        rmse = scores_of(frame)["rmse"]
        return math.inf if rmse is None or math.isnan(rmse) else -rmse

    return sorted(evaluation.scored, key=rank)


def comparison_table(comparison: Comparison) -> Table:
    """Returns a row for each measure and run; all runs but the first have gain and p."""
    first, *others = comparison.runs
    rows: list[list[str]] = []
    for measure in comparison.measures:
        rows.append([measure.heading, first.name, measure.text(first.mean[measure.key]), *"––––"])
        for run in others:
            found, p = run.gains[measure.key], run.gains[measure.key].p_adjusted
            style: Style = "good" if (found.percent or 0) > 0 else "bad"
            percents = (found.percent, found.low_percent, found.high_percent)
            percent, *ends = ("–" if value is None else f"{value:+.2f}" for value in percents)
            rows.append([
                measure.heading,
                run.name,
                measure.text(run.mean[measure.key]),
                Cell(percent, style if p is not None and p < ALPHA else "dim"),
                *ends,
                "–" if p is None else f"{p:.4f}",
            ])  # fmt: skip
    # What was tested, in the title.
    swaps = "all" if comparison.exact_p_values else f"{PERMUTATIONS:,} random"
    return Table(
        title=(
            f"{len(comparison.frames):,} shared frames; gains in per cent of the error of"
            f" {first.name}, positive is better; intervals (95 %) and p-values, from {swaps}"
            f" swaps, {_describe_tests(comparison)}"
        ),
        columns=["measure", "run", "mean", "gain [%]", "low", "high", "p"],
        rows=rows,
    )


def methods_table(comparison: Comparison) -> Table:
    """Returns a row for each run and a column for each measure, the best of a column in bold.

    Stars mark where a run differs from the first significantly.
    """
    runs = comparison.runs
    rows: list[list[str]] = [[run.name] for run in runs]
    for measure in comparison.measures:
        means = [run.mean[measure.key] for run in runs]
        pick = max if measure.better == "higher" else min
        best = measure.text(pick((mean for mean in means if mean is not None), default=None))
        for row, run, mean in zip(rows, runs, means, strict=True):
            p = run.gains[measure.key].p_adjusted if run.gains else None
            stars = "*" * sum(p is not None and p < limit for limit in _STARS)
            text = measure.text(mean)
            is_best = mean is not None and text == best and measure.sign != 0
            row.append(Cell(text + stars, "bold" if is_best else ""))
    return Table(
        title=(
            f"means over {len(comparison.frames):,} frames, the best in bold; *, **, ***:"
            f" differs from {runs[0].name} with p < 0.05, 0.01, 0.001 {_describe_tests(comparison)}"
        ),
        columns=["", *comparison.measures],
        rows=rows,
    )


def _describe_tests(comparison: Comparison) -> str:
    others, measures = len(comparison.runs) - 1, len(comparison.measures)
    tests = f"{measures} measures" + (f" of {others} runs" if others > 1 else "")
    tested = f"over {comparison.clusters.describe()}, p adjusted for {tests} (Holm)"
    return tested + _without_sparse(comparison.scoring.get("exclude_sparse", False))


def _without_sparse(excluded: bool) -> str:
    return "; without the pixels of sparse points" if excluded else ""
