"""The tables of a comparison: for a person, for programs (CSV), and for a paper (LaTeX)."""

from __future__ import annotations

import math
from dataclasses import fields

from pnpdepth_cli.commands.comparisons.comparison import ALPHA, Comparison, Gain
from pnpdepth_cli.commands.requests.eval_request import WITHOUT_SPARSE
from pnpdepth_cli.commands.shared.tables import Style, Table, count_of

_STARS = (0.05, 0.01, 0.001)
"""Adjusted p below which a cell has one, two, three stars, as papers mark it."""
_NOTHING = "–"
"""Text of a value that there is not."""
_GAIN_COLUMNS = [declared.name for declared in fields(Gain)]


def comparison_table(comparison: Comparison) -> Table:
    """Returns a row for each measure and run; all runs but the first have gain and p."""
    # The rows; a significant gain has a colour, and the first run, which has no gains, none.
    rows: list[list[object]] = []
    for measure in comparison.measures:
        for run in comparison.runs:
            row = [measure.heading, run.name, measure.text(run.mean[measure.key])]
            if not run.gains:
                rows.append([*row, _NOTHING, _NOTHING, _NOTHING, _NOTHING])
                continue
            gain = run.gains[measure.key]
            style: Style = "dim"
            if gain.p_adjusted < ALPHA:
                style = "good" if gain.percent > 0 else "bad"
            rows.append(
                [
                    *row,
                    (_number_text(gain.percent, "+.2f"), style),
                    _number_text(gain.low_percent, "+.2f"),
                    _number_text(gain.high_percent, "+.2f"),
                    _number_text(gain.p_adjusted, ".4f"),
                ]
            )
    # What the numbers are of, and how they were tested.
    frames = count_of(len(comparison.frames), "shared frame")
    gains = f"gains in per cent of the error of {comparison.reference.name}, positive is better"
    tests = f"intervals (95 %) and p-values {_tests_text(comparison)}"
    return Table(
        title=f"{frames}; {gains}; {tests}",
        columns=["measure", "run", "mean", "gain [%]", "low", "high", "p"],
        rows=rows,
    )


def _number_text(number: float, form: str) -> str:
    """The number in a format such as `.4f`; – for NaN."""
    return _NOTHING if math.isnan(number) else f"{number:{form}}"


def comparison_values(comparison: Comparison) -> Table:
    """Returns a row for each measure and run for programs: keys, and numbers in full.

    A value that a run lacks is None or NaN.
    """
    options = [*dict.fromkeys(name for run in comparison.runs for name in run.varied)]
    rows: list[list[object]] = []
    for measure in comparison.measures:
        for run in comparison.runs:
            row: list[object] = [measure.key, run.name]
            row += [run.varied.get(option) for option in options]
            row.append(run.mean[measure.key])
            gain = run.gains.get(measure.key)
            row += [None if gain is None else getattr(gain, column) for column in _GAIN_COLUMNS]
            rows.append(row)
    return Table(columns=["measure", "run", *options, "mean", *_GAIN_COLUMNS], rows=rows)


def methods_table(comparison: Comparison) -> Table:
    """Returns a row for each run and a column for each measure, the best of a column in bold.

    Stars mark where a run differs from the first significantly.
    """
    runs = comparison.runs
    rows: list[list[object]] = [[run.name] for run in runs]
    for measure in comparison.measures:
        # Runs whose means look the same as the best are the best, too.
        means = [run.mean[measure.key] for run in runs]
        best_of = max if measure.better == "higher" else min
        best = best_of((mean for mean in means if mean is not None), default=None)
        best_text = measure.text(best)
        for row, run, mean in zip(rows, runs, means, strict=True):
            text = measure.text(mean)
            is_best = mean is not None and measure.sign != 0 and text == best_text
            p_adjusted = run.gains[measure.key].p_adjusted if run.gains else math.nan
            stars = "*" * sum(p_adjusted < limit for limit in _STARS)
            row.append((text + stars, "bold" if is_best else ""))
    frames = f"means over {count_of(len(comparison.frames), 'frame')}, the best in bold"
    marks = f"*, **, ***: differs from {comparison.reference.name} with p < 0.05, 0.01, 0.001"
    return Table(
        title=f"{frames}; {marks} {_tests_text(comparison)}",
        columns=["", *comparison.measures],
        rows=rows,
    )


def _tests_text(comparison: Comparison) -> str:
    """What the tests are over, and how many they are; the end of a title that begins with p."""
    others = len(comparison.runs) - 1
    tests = count_of(len(comparison.measures), "measure")
    if others > 1:
        tests += f" of {others} runs"
    text = f"over {comparison.clusters.text}, p adjusted for {tests} (Holm)"
    if comparison.scoring.get("exclude_sparse"):
        text += WITHOUT_SPARSE
    return text
