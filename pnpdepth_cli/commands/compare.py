"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.comparisons.comparison import (
    ALPHA,
    ComparedRun,
    Comparison,
    Gain,
    Means,
    positions_of,
)
from pnpdepth_cli.commands.comparisons.saved_runs import Rows, Run, read_run, without_repeats
from pnpdepth_cli.commands.shared import statistics
from pnpdepth_cli.commands.shared.statistics import Clusters, find_clusters
from pnpdepth_cli.commands.shared.tables import count_of, some_names
from pnpdepth_cli.dataset.frame_files import groups_of
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.measures import BEFORE, COVERAGE, Measure, choose_measures, frame_means


def compare(paths: Sequence[str], *, columns: Sequence[str] | None = None) -> Comparison:
    """Returns the runs on the frames that all of them scored, compared with the first.

    A measure that a frame lacks in one of the runs is averaged and tested over the other frames.
    Runs of a study whose settings give the same result are one.

    Args:
        paths: Outputs of `pnpdepth eval --json`, summaries of batches, or the folders of these; the
            first is the reference. `FILE:before` is the prediction that a refinement started from.
        columns: Keys of the measures to compare by, instead of the main ones.

    Raises:
        UsageError: For fewer than two runs.
        InputError: For a file without scores, or if the runs were scored by different rules or have
            no frame in common.
    """
    # The runs, and the frames and measures that all of them have.
    if len(paths) < 2:
        raise UsageError("two runs at least are needed to compare; name another one")
    runs, notes_on_repeats = without_repeats([read_run(path) for path in paths])
    if len(runs) < 2:
        raise UsageError(f"{notes_on_repeats[0]}; name a run with another result")
    _check_rules(runs)
    names = _shared_frames(runs)
    measures = _shared_measures(runs, columns)
    keys = [measure.key for measure in measures]
    # Their scores (runs, frames, measures); NaN in every run where one run has none.
    scores = np.array([run.rows(names, keys) for run in runs], np.float64)  # None becomes NaN
    in_all_runs = np.asarray(np.isfinite(scores).all(axis=0))
    scores[:, ~in_all_runs] = math.nan
    # Sets of frames that count as independent in what is tested: the differences from the first.
    groups = groups_of(names, [runs[0].frames[name].group for name in names])
    # (frames, others · measures), a column for each other run and measure.
    differences = np.concatenate([*(scores[1:] - scores[0])], axis=1)
    clusters = find_clusters(groups, differences)
    # Mean of each run by measure, and gains of each but the first.
    means = [_means(of_run.tolist(), keys) for of_run in scores]
    gains = [{}, *_gains(scores, means, measures, clusters)]
    are_names_unique = len({run.name for run in runs}) == len(runs)
    compared = [
        ComparedRun(
            name=run.name if are_names_unique else run.path,
            path=run.path,
            mean=mean,
            before=_means_before(run, names, keys, in_all_runs),
            varied=run.varied,
            coverage=_means(run.rows(names, [COVERAGE.key]), [COVERAGE.key])[COVERAGE.key],
            gains=gains_of_run,
        )
        for run, mean, gains_of_run in zip(runs, means, gains, strict=True)
    ]
    comparison = Comparison(
        frames=names,
        measures=measures,
        scoring=runs[0].scoring,
        runs=tuple(_in_order_of_values(compared)),
        clusters=clusters,
        notes=notes_on_repeats,
    )
    notes = [*_notes_on_unshared(runs, comparison, in_all_runs), *_notes_on_power(comparison)]
    return replace(comparison, notes=[*notes_on_repeats, *notes])


def _check_rules(runs: Sequence[Run]) -> None:
    """Raises InputError unless all runs were scored by the rules of the first."""
    first = runs[0]
    for run in runs[1:]:
        for rule in sorted({*first.scoring, *run.scoring}):
            value_of_first = first.scoring.get(rule)
            value = run.scoring.get(rule)
            if value != value_of_first:
                raise InputError(
                    f"{first.path} and {run.path} were scored by different rules ({rule}"
                    f" {value_of_first} and {value}); score both by one protocol"
                )


def _shared_frames(runs: Sequence[Run]) -> tuple[str, ...]:
    """The names of the frames that all runs scored. Raises InputError if there is none."""
    first = runs[0]
    names = tuple(name for name in first.frames if all(name in run.frames for run in runs))
    if not names:
        raise InputError(
            f"the runs have no scored frame in common: {some_names(first.frames)}; and"
            f" {some_names(runs[-1].frames)}; compare runs on the same frames"
        )
    return names


def _shared_measures(runs: Sequence[Run], columns: Sequence[str] | None) -> tuple[Measure, ...]:
    """The measures that all runs have, of which some are chosen.

    Args:
        runs: The runs.
        columns: Keys of the measures that are wanted, in order. None: the main ones.

    Raises:
        UsageError: A key is of none of them.
    """
    shared = set.intersection(*({measure.key for measure in run.measures} for run in runs))
    measures = [measure for measure in runs[0].measures if measure.key in shared]
    main = [measure.key for measure in measures if measure.main]
    return choose_measures(measures, columns or main)


def _means(rows: Rows, keys: Sequence[str]) -> Means:
    """The mean of each column over the rows that have a value there, by the column's key.

    Args:
        rows: A row for each frame, with a value for each key; None or NaN for one it lacks.
        keys: Keys of measures, one a column.
    """
    return frame_means(dict(zip(keys, row, strict=True)) for row in rows)


def _means_before(
    run: Run, names: Sequence[str], keys: Sequence[str], in_all_runs: NDArray[np.bool_]
) -> Means:
    """The means before refinement, over the frames of the means after it.

    Args:
        run: The run.
        names: Names of the frames.
        keys: Keys of the measures.
        in_all_runs: (frames, measures) where the means after refinement have a value.
    """
    before = np.array(run.rows(names, keys, BEFORE), np.float64)  # None becomes NaN
    return _means(np.where(in_all_runs, before, math.nan).tolist(), keys)


def _gains(
    scores: NDArray[np.float64],
    means: Sequence[Means],
    measures: Sequence[Measure],
    clusters: Clusters,
) -> Iterator[dict[str, Gain]]:
    """Yields the gains over the first run of each other run, by the key of the measure.

    Args:
        scores: (runs, frames, measures), NaN in all runs where one has none.
        means: Means of each run.
        measures: What the runs are compared by.
        clusters: Sets of the frames that count as independent.
    """
    # p of each other run and measure, and the same adjusted for all of these tests.
    reference, *others = scores.transpose(0, 2, 1)  # of each run (measures, frames)
    p_values = np.empty((len(others), len(measures)))
    for run, of_run in enumerate(others):
        for place in range(len(measures)):
            p_values[run, place] = statistics.swap_p_value(
                reference[place], of_run[place], clusters
            )
    adjusted = statistics.holm(p_values)
    # The gains, with their intervals.
    for run, (of_run, means_of_run) in enumerate(zip(others, means[1:], strict=True)):
        gains = {}
        for place, measure in enumerate(measures):
            percent_of = functools.partial(statistics.gain, sign=measure.sign)  # of two means
            pair = [means[0][measure.key], means_of_run[measure.key]]
            mean_of_first, mean = np.array(pair, float)  # None becomes NaN
            low, high = statistics.interval(percent_of, (reference[place], of_run[place]), clusters)
            gains[measure.key] = Gain(
                percent=float(percent_of(mean_of_first, mean)),
                low_percent=low,
                high_percent=high,
                p_value=float(p_values[run, place]),
                p_adjusted=float(adjusted[run, place]),
            )
        yield gains


def _in_order_of_values(runs: Sequence[ComparedRun]) -> list[ComparedRun]:
    """The runs of `batch --vary` in the order of its values; others as they are."""
    if not all(run.varied for run in runs):
        return [*runs]
    options = [*dict.fromkeys(option for run in runs for option in run.varied)]
    positions = {
        option: positions_of(run.varied[option] for run in runs if option in run.varied)
        for option in options
    }

    def places(run: ComparedRun) -> list[float]:
        """Where the run's value of each option lies; a run without one comes before all others."""
        return [
            positions[option][run.varied[option]] if option in run.varied else -math.inf
            for option in options
        ]

    return sorted(runs, key=places)


def _notes_on_unshared(
    runs: Sequence[Run], comparison: Comparison, in_all_runs: NDArray[np.bool_]
) -> Iterator[str]:
    """Yields a line on each kind of frames, pixels and measures that not all runs have.

    Args:
        runs: The runs as they were read.
        comparison: The runs on the frames that all scored.
        in_all_runs: (frames, measures) where all runs have a value.
    """
    # Frames that other runs lack.
    for run in runs:
        unshared = [name for name in run.frames if name not in comparison.frames]
        if unshared:
            yield (
                f"warning: {count_of(len(unshared), 'frame')} of {run.path} not scored in all runs,"
                f" left out: {some_names(unshared)}"
            )
    # How many frames have other numbers of scored pixels in one run than in another.
    pixels_of_runs = []
    for run in runs:
        rows = run.rows(comparison.frames, ["pixels"])
        pixels_of_runs.append([count for (count,) in rows])
    unequal = sum(len({*counts}) > 1 for counts in zip(*pixels_of_runs, strict=True))
    if unequal:
        shares = ", ".join(COVERAGE.text(run.coverage) for run in comparison.runs)
        yield (
            f"warning: {count_of(unequal, 'frame')} with other numbers of scored pixels in the runs"
            f" (coverage: {shares}), and a run that leaves hard pixels empty looks better; this is"
            " no ranking"
        )
    # Measures that a run lacks on some frames.
    for measure, has_value in zip(comparison.measures, in_all_runs.T, strict=True):
        if not has_value.all():
            yield (
                f"{measure.title}: over {has_value.sum():,} of {len(has_value):,} frames; the"
                " others lack it in a run"
            )


def _notes_on_power(comparison: Comparison) -> Iterator[str]:
    """Yields a line if frames are not independent, and one if too few of them are for any test."""
    yield from comparison.clusters.notes()
    # p is the fraction of the 2^G swaps of G clusters after which the runs differ as much as they
    # do. At least two swaps do that: that of no cluster, and that of all. Holm's correction
    # multiplies the smallest p by the number of tests.
    smallest = 2.0 ** (1 - comparison.clusters.count)
    tests = len(comparison.measures) * (len(comparison.runs) - 1)
    if len(comparison.frames) > 1 and tests * smallest >= ALPHA:
        yield (
            f"warning: {comparison.clusters.text} are too few independent ones to conclude anything"
            f" from {tests} tests: p is at least {smallest:.2g}, adjusted"
            f" {min(1.0, tests * smallest):.2g}"
        )
