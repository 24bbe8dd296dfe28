"""Simulates the type-1 error of `compare` and the coverage of the intervals of `eval`.

    python -m benchmarks.statistics_check --trials 10000

Type-1 error: two runs are equally good, and p < 0.05 should come in 5 % of the trials. The errors
of a run are independent, skewed, or autocorrelated within each sequence, AR(1). Coverage: the 95 %
interval of a mean should hold the true mean in 95 % of the trials. Trials are columns of the tables
that `compare` and `eval` resample, so that thousands are tested in one call.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from pnpdepth_cli.pipeline.evaluation.dependence import find_clusters
from pnpdepth_cli.pipeline.evaluation.resampling import (
    FrameTable,
    mean_interval,
    sign_flip_p_values,
)

Floats = NDArray[np.float64]
Draw = Callable[[np.random.Generator, int, int], Floats]

ALPHA = 0.05
SWAPS = 4999
"""Random swaps of a test; up to 12 clusters are tested exactly."""
_TEST_COLUMNS, _INTERVAL_COLUMNS = 250, 20
"""Trials that use the same random numbers."""


def normal(rng: np.random.Generator, sequences: int, frames: int) -> Floats:
    """Returns (sequences, frames) independent normal errors of mean 0."""
    return rng.normal(size=(sequences, frames))


def lognormal(sigma: float) -> Draw:
    """Returns a function that draws independent errors of mean 1 whose logarithm deviates sigma."""

    def draw(rng: np.random.Generator, sequences: int, frames: int) -> Floats:
        return rng.lognormal(-(sigma**2) / 2, sigma, (sequences, frames))

    return draw


skewed = lognormal(0.5)


def autoregression(correlation: float) -> Draw:
    """Returns a function that draws errors with this lag-1 autocorrelation in each sequence."""

    def draw(rng: np.random.Generator, sequences: int, frames: int) -> Floats:
        noise = rng.normal(size=(sequences, frames + 100))
        return np.asarray(lfilter([1.0], [1.0, -correlation], noise, axis=1)[:, 100:])

    return draw


def drifting(rng: np.random.Generator, sequences: int, frames: int) -> Floats:
    """Returns (sequences, frames) errors of a slow drift under independent noise."""
    return autoregression(0.9)(rng, sequences, frames) + 1.5 * normal(rng, sequences, frames)


ERRORS: dict[str, Draw] = {
    "normal": normal,
    "lognormal": skewed,
    "AR(1) 0.5": autoregression(0.5),
    "AR(1) 0.9": autoregression(0.9),
    "drift + noise": drifting,
}
SIZES = ((8, 12), (12, 12), (20, 10), (100, 1), (1, 30), (1, 100), (1, 400), (1, 1000))
"""(groups, frames of each)."""


def type_1_error(
    draw: Draw, groups: int, frames: int, *, trials: int, grouped: bool = True, seed: int = 0
) -> tuple[float, float]:
    """Returns the fraction of equally good pairs of runs with p < ALPHA, and of testable ones.

    A trial is testable if its clusters are enough for p < ALPHA.

    Args:
        draw: Draws the errors of a run.
        groups: Sequences.
        frames: Of each sequence.
        trials: Pairs of runs.
        grouped: False to treat all frames as independent.
        seed: Of the trials.
    """
    rng = np.random.default_rng(seed)
    names = [f"{group}" for group in range(groups) for _ in range(frames)]
    runs = [draw(rng, trials * groups, frames).reshape(trials, -1) for _ in range(2)]
    changes = runs[1] - runs[0]
    rejected = testable = 0
    for part, (ids, columns) in enumerate(_by_clusters(changes, names, grouped=grouped)):
        totals = FrameTable.of_frames(changes[columns].T).cluster_totals(ids)[..., 0]
        p_values, _ = sign_flip_p_values(
            lambda flips, totals=totals: (1 - 2 * flips) @ totals, len(totals), SWAPS, seed=part
        )
        rejected += int((p_values < ALPHA).sum())
        testable += len(columns) * (2.0 ** (1 - len(totals)) < ALPHA)
    return rejected / trials, testable / trials


def _by_clusters(
    changes: Floats, names: Sequence[str], *, grouped: bool
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """(clusters of the frames, a few trials that have these)."""
    by_count: dict[int, list[int]] = defaultdict(list)
    ids_of = {}
    for trial, change in enumerate(changes):
        if trial == 0 or len(set(names)) == 1:
            clusters = find_clusters(names, change[:, None], grouped=grouped)
        by_count[clusters.count].append(trial)
        ids_of[clusters.count] = clusters.ids
    for count, members in by_count.items():
        for start in range(0, len(members), _TEST_COLUMNS):
            yield ids_of[count], np.array(members[start : start + _TEST_COLUMNS])


def interval_coverage(
    draw: Draw, frames: int, *, trials: int, resamples: int = 1000, mean: float = 1.0, seed: int = 0
) -> float:
    """Returns the fraction of 95 % intervals of independent frames that hold the true mean.

    Args:
        draw: Draws the errors.
        frames: Of each trial.
        trials: How many intervals.
        resamples: Bootstrap samples behind each.
        mean: The true mean of the errors.
        seed: Of the trials.
    """
    rng = np.random.default_rng(seed)
    covered = 0
    for start in range(0, trials, _INTERVAL_COLUMNS):
        columns = min(_INTERVAL_COLUMNS, trials - start)
        table = FrameTable.of_frames(draw(rng, columns, frames).T)
        low, high = mean_interval(table, np.arange(frames), resamples, seed=start)
        covered += int(((low <= mean) & (mean <= high)).sum())
    return covered / trials


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints both tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=10_000)
    trials = parser.parse_args(arguments).trials
    error = (0.05 * 0.95 / trials) ** 0.5
    print(f"{trials:,} trials; standard error of a fraction of 5 %: {error:.2%}\n")
    print("| errors |" + "".join(f" {g} × {n} |" for g, n in SIZES) + " 20 × 10, no groups |")
    print("|---" * (len(SIZES) + 2) + "|")
    for name, draw in ERRORS.items():
        cells = [_cell(*type_1_error(draw, *size, trials=trials)) for size in SIZES]
        cells.append(_cell(*type_1_error(draw, 20, 10, trials=trials, grouped=False)))
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    frames = (5, 6, 8, 10, 12, 20, 50, 100)
    print("\n| errors |" + "".join(f" {n} frames |" for n in frames))
    print("|---" * (len(frames) + 1) + "|")
    for name, draw, mean in (
        ("normal", normal, 0.0),
        ("lognormal, σ 0.5", skewed, 1.0),
        ("lognormal, σ 1", lognormal(1.0), 1.0),
    ):
        cells = [f"{interval_coverage(draw, n, trials=trials, mean=mean):.1%}" for n in frames]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def _cell(rejected: float, testable: float) -> str:
    """The type-1 error, and where not all trials could be tested, how many could."""
    return f"{rejected:.1%}" + ("" if testable == 1 else f" ({testable:.0%} testable)")


if __name__ == "__main__":
    main()
