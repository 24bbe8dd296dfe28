"""Simulates the type-1 error of `compare` and the coverage of the intervals of `eval`.

    python -m benchmarks.statistics_check --trials 1000

Type-1 error: two runs are equally good, and p < 0.05 should come in 5 % of the trials. The errors
of a run are independent, skewed, or autocorrelated within each sequence, AR(1). Coverage: the 95 %
interval of a mean should hold the true mean in 95 % of the trials.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from pnpdepth_cli.pipeline.evaluation.averages import FrameTable
from pnpdepth_cli.pipeline.evaluation.dependence import find_clusters
from pnpdepth_cli.pipeline.evaluation.resampling import sign_flip_p_values, studentised_interval

Floats = NDArray[np.float64]
Draw = Callable[[np.random.Generator, int, int], Floats]

ALPHA = 0.05
SIGMA = 0.5
"""Standard deviation of the logarithm of lognormal errors."""


def normal(rng: np.random.Generator, groups: int, frames: int) -> Floats:
    """Returns (groups, frames) independent normal errors."""
    return rng.normal(size=(groups, frames))


def skewed(rng: np.random.Generator, groups: int, frames: int) -> Floats:
    """Returns (groups, frames) independent lognormal errors."""
    return rng.lognormal(0, SIGMA, (groups, frames))


def autoregression(correlation: float) -> Draw:
    """Returns a function that draws errors with this lag-1 autocorrelation in each sequence."""

    def draw(rng: np.random.Generator, groups: int, frames: int) -> Floats:
        noise = rng.normal(size=(groups, frames + 100))
        return np.asarray(lfilter([1.0], [1.0, -correlation], noise, axis=1)[:, 100:])

    return draw


ERRORS: dict[str, Draw] = {
    "normal": normal,
    "lognormal": skewed,
    "AR(1) 0.5": autoregression(0.5),
    "AR(1) 0.9": autoregression(0.9),
}


def type_1_error(
    draw: Draw, groups: int, frames: int, *, trials: int, grouped: bool, seed: int = 0
) -> float:
    """Returns the fraction of trials with p < ALPHA for two equally good runs.

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
    rejected = 0
    for trial in range(trials):
        change = (draw(rng, groups, frames) - draw(rng, groups, frames)).reshape(-1, 1)
        ids = find_clusters(names, change).ids if grouped else np.arange(len(change))
        sums = FrameTable(rows=change).cluster_totals(ids)[:, :1]

        def difference(flips: Floats, sums: Floats = sums) -> Floats:
            return (1 - 2 * flips) @ sums

        (p_value,), _ = sign_flip_p_values(difference, len(sums), 999, seed=trial)
        rejected += p_value < ALPHA
    return rejected / trials


def interval_coverage(frames: int, *, trials: int, resamples: int = 1000, seed: int = 0) -> float:
    """Returns the fraction of 95 % intervals of lognormal errors that hold the true mean."""
    rng = np.random.default_rng(seed)
    mean = np.exp(SIGMA**2 / 2)
    covered = 0
    for trial in range(trials):
        table = FrameTable(rows=rng.lognormal(0, SIGMA, (frames, 1)))
        totals = table.cluster_totals(np.arange(frames))
        low, high = studentised_interval(table.means_of, totals, resamples, seed=trial)
        covered += bool(low[0] <= mean <= high[0])
    return covered / trials


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    trials = parser.parse_args(arguments).trials
    error = (0.05 * 0.95 / trials) ** 0.5
    print(f"{trials:,} trials; standard error of a fraction of 5 %: {error:.1%}\n")
    print("type-1 error at p < 0.05     groups × frames   by group   frames as independent")
    for name, draw in ERRORS.items():
        for groups, frames in ((8, 12), (20, 10), (100, 1), (1, 100)):
            by_group, independent = (
                type_1_error(draw, groups, frames, trials=trials, grouped=grouped)
                for grouped in (True, False)
            )
            size = f"{groups} × {frames}"
            print(f"{name:<28} {size:>15} {by_group:>10.1%} {independent:>23.1%}")
    print(f"\n95 % interval of lognormal errors (σ {SIGMA})   coverage")
    for frames in (5, 8, 12, 20, 50, 100):
        print(f"{frames:>3} frames {interval_coverage(frames, trials=trials):>40.1%}")


if __name__ == "__main__":
    main()
