"""Depth of sequences that shares its alignment: `python -m benchmarks.steady --data PATH`.

Networks are simulated on the frames of real sequences. They give disparity with an error of 4 %
after alignment. Its errors are drawn anew for each frame, or are the same in all. Its scale and
shift drift as a random walk from frame to frame, or each map is stretched to 0…1 by itself.

Four alignments are compared, each frame with 5, 10 or 50 points at random pixels:

    alone      each frame by itself, as the program does it
    disparity  the same, but read as disparity only
    pooled     a line through the points of the frame and its neighbours, after each map is
               divided by its own robust scale
    tied       lines that follow a random walk beside what is a frame's own, all variances by
               maximum likelihood; of the maps as they are or divided by their own robust scale it
               is what is likelier
    behind     the same with the frames so far only, which a stream has; the variances are known

The tables have geometric means over frames and seeds of the MAE in metres: aligned, with the
residual propagated as it is by default (`result`), and propagated with its mean held at 0 (`held`),
as an alignment that is tied knows the level that a frame's few points do not. The shake is the
standard deviation of the change from frame to frame of median log(depth / true depth). Nothing is
to be chosen on the two sets of TUM.

    python -m benchmarks.steady --data PATH --sets icl_nuim --frames 10 --json FILE
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from benchmarks.frames import ALL_SETS, EvalFrame, print_row
from benchmarks.simulated import weakened
from pnpdepth_cli.completion import gaussian_process
from pnpdepth_cli.completion.alignment import Candidate, align, candidates
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.core.losses import MAD_TO_STD
from pnpdepth_cli.frames.frame import tensor_of
from pnpdepth_cli.points import SparsePoints

Map = NDArray[np.float32]
Line = NDArray[np.float64]

CHOOSING = ("7scenes", "icl_nuim")
REPORTED = ("tum_fr1_rpy", "tum_fr3_cabinet")
COUNTS = (5, 10, 50)
ERROR = 0.04
"""Mean |aligned / true − 1| of the simulated networks."""
FAULTS = ("anew", "same")
"""Whether the errors of the network are drawn anew for each frame."""
DRIFTS = {"none": 0.0, "1 %": 0.01, "5 %": 0.05, "20 %": 0.2}
"""Standard deviation of the step of log scale, and of shift over the median disparity."""
STRETCHED = "stretched"
"""Instead of a drift: each map is stretched to 0…1."""
THINNED = 4
"""Of so many rows and columns one is used."""
REACHES = (1, 3)
"""Frames before and after one that are pooled with it."""
CAUCHY = 2.385
"""Width of the loss over the standard deviation of the errors, as in `robust_line`."""
LEAST_ERROR = 0.01
"""Standard deviation of relative errors that is assumed at least."""
ROUNDS = 3
"""How often the variances and the weights of the points are estimated in turn."""
DIFFUSE = 100.0
"""Variance of the first line, whose parameters are near 1."""
LEAST_VARIANCE = 1e-8
STAGES = ("aligned", "result", "held")
RESAMPLED = 2000
"""Draws of the frames with replacement, for the intervals."""
START = tuple(np.log([1e-3, 1e-3, 1e-3, 1e-3, ERROR**2]))
"""Logarithms of variances: of the walk's steps of level and slope, of a frame's own level and
slope, and of the points' errors, all relative."""
BOUNDS = [(-18.0, 3.0)] * len(START)

Run = dict[str, Any]


class Sequenced(NamedTuple):
    """A sequence as a method sees it: the network's maps (H, W), and the points of each frame."""

    maps: list[Tensor]
    points: list[SparsePoints]


class Solved(NamedTuple):
    """Factors of the posterior of the lines of a sequence."""

    factor: Line  # Cholesky factor of the prior's covariance
    root: Line  # Cholesky factor of the precision, in units of the prior
    reduced: Line  # the solution of the triangular system with `root`


# --- the networks ---


def drifting(disparity: Sequence[Map], drift: str, seed: int) -> list[Map]:
    """Returns maps of disparity (H, W) whose scale and shift are those of a drifting network.

    Args:
        disparity: The maps, in 1/m.
        drift: A name in `DRIFTS`, or `STRETCHED`.
        seed: Random seed of the walk.
    """
    if drift == STRETCHED:
        return [
            ((values - values.min()) / np.ptp(values)).astype(np.float32) for values in disparity
        ]
    rng = np.random.default_rng(seed)
    typical = float(np.median(np.stack(disparity)))
    steps = rng.standard_normal((len(disparity), 2)) * DRIFTS[drift]
    log_scale, shift = np.cumsum(steps, axis=0).T
    # Any first scale and shift is as good as another.
    scale = 20 * np.exp(log_scale)
    added = 20 * typical * (0.5 + shift)
    return [
        (one_scale * values + one_shift).astype(np.float32)
        for one_scale, one_shift, values in zip(scale, added, disparity, strict=True)
    ]


def weakened_disparity(frames: Sequence[EvalFrame], faults: str, seed: int) -> list[Map]:
    """Returns the disparity (H, W) in 1/m of networks that are off by `ERROR` on each frame."""
    seeds = [seed] * len(frames)
    if faults == "anew":
        seeds = [zlib.crc32(f"{frame.name} {seed}".encode()) for frame in frames]
    return [
        1 / weakened(frame.gt, ERROR, np.random.default_rng(number))
        for frame, number in zip(frames, seeds, strict=True)
    ]


# --- the alignments ---


def aligned_alone(sequence: Sequenced) -> list[Tensor]:
    """Returns depth (H, W) in metres, each frame aligned by itself as the program does it."""
    tried = candidates("auto", "inverse", "affine")
    return [_depth(x, points, tried) for x, points in zip(*sequence, strict=True)]


def aligned_as_disparity(sequence: Sequenced) -> list[Tensor]:
    """Returns depth (H, W) in metres, each frame aligned by itself, read as disparity."""
    tried = [Candidate("disparity", "affine", 1)]
    return [_depth(x, points, tried) for x, points in zip(*sequence, strict=True)]


def aligned_pooled(sequence: Sequenced, reach: int) -> list[Tensor]:
    """Returns depth (H, W) in metres by the points of each frame and its neighbours.

    Args:
        sequence: The frames.
        reach: Frames before and after one that are its neighbours.
    """
    maps = [standardised(x) for x in sequence.maps]
    at_points = [points.sample(x) for x, points in zip(maps, sequence.points, strict=True)]
    depths = list[Tensor]()
    for number, x in enumerate(maps):
        near = range(max(0, number - reach), min(len(maps), number + reach + 1))
        neighbours = [neighbour for neighbour in near if neighbour != number]
        together = sequence.points[number]
        for neighbour in neighbours:
            together = together.joined(sequence.points[neighbour])
        values = torch.cat([at_points[frame] for frame in (number, *neighbours)])
        fit = align(values, together, [Candidate("disparity", "affine", 1)])
        depths.append(fit.depth(x))
    return depths


def likeliest_lines(sequence: Sequenced) -> TiedLines:
    """Returns the tied lines of the maps as they are, or standardised, whichever is likelier."""
    as_given = TiedLines(sequence.maps, sequence.points)
    divided = TiedLines([standardised(x) for x in sequence.maps], sequence.points)
    return max(as_given, divided, key=lambda lines: lines.log_likelihood)


def alignments_of(sequence: Sequenced) -> dict[str, list[Tensor]]:
    """Returns depth (H, W) in metres of each frame, by the names of the alignments."""
    tied = likeliest_lines(sequence)
    return {
        "alone": aligned_alone(sequence),
        "disparity": aligned_as_disparity(sequence),
        **{f"pooled ±{reach}": aligned_pooled(sequence, reach) for reach in REACHES},
        "tied": tied.depths(),
        "behind": tied.depths(behind=True),
    }


def standardised(x: Tensor) -> Tensor:
    """Returns a map (H, W) less its median, over its median absolute deviation."""
    centred = x - x.median()
    return centred / centred.abs().median()


class TiedLines:
    """Lines 1/d = level + slope·x of the frames of a sequence, which follow a random walk.

    A frame's line is that of the walk and an addend of its own. The variances are those of maximum
    likelihood. The errors are relative to 1/d, and outliers count little, by Cauchy's weights.

    Args:
        maps: (H, W) what the network gave.
        points: The points of each frame.
    """

    def __init__(self, maps: Sequence[Tensor], points: Sequence[SparsePoints]) -> None:
        self._maps, self._points = maps, points
        at_points = [p.sample(x).double().numpy() for x, p in zip(maps, points, strict=True)]
        together = np.concatenate(at_points)
        self._centre = float(np.median(together))
        self._spread = float(together.std())
        disparity = [1 / p.depth.double().numpy() for p in points]
        self._typical = float(np.median(np.concatenate(disparity)))
        # A row for each point: (level, slope)·row is 1 where the line is exact.
        self._rows = [
            self._typical / y[:, None] * np.stack([np.ones_like(x), self._moved(x)], axis=1)
            for x, y in zip(at_points, disparity, strict=True)
        ]
        self._weigh([np.ones(len(rows)) for rows in self._rows])
        self._variances = np.array(START)
        for number in range(ROUNDS):
            found = minimize(self._cost, self._variances, method="L-BFGS-B", bounds=BOUNDS)
            self._variances = found.x
            # Kinds of maps are compared while all points count alike.
            if not number:
                self.log_likelihood = -float(found.fun)
            lines = self._lines(len(self._rows))
            errors = [rows @ line - 1 for rows, line in zip(self._rows, lines, strict=True)]
            size = float(np.median(np.abs(np.concatenate(errors))))
            width = CAUCHY * max(MAD_TO_STD * size, LEAST_ERROR)
            self._weigh([1 / (1 + (error / width) ** 2) for error in errors])

    def depths(self, *, behind: bool = False) -> list[Tensor]:
        """Returns depth (H, W) in metres of each frame, by all frames or by those so far."""
        count = len(self._maps)
        lines = self._lines(count)
        if behind:
            lines = np.stack([self._lines(number + 1)[-1] for number in range(count)])
        depths = list[Tensor]()
        for x, points, (level, slope) in zip(self._maps, self._points, lines, strict=True):
            fit = align(points.sample(x), points, [Candidate("disparity", "affine", 1)])
            scale = self._typical * slope / self._spread
            shift = self._typical * level - scale * self._centre
            depths.append(replace(fit, scale=scale, shift=shift).depth(x))
        return depths

    def _moved(self, x: Line) -> Line:
        """Returns values of the maps less their median at the points, over their deviation."""
        return (x - self._centre) / self._spread

    def _weigh(self, weights: Sequence[Line]) -> None:
        """Sets the normal equations of each frame's line, with weights of its points.

        Args:
            weights: Weights (N,) of the points of each frame.
        """
        count = len(self._rows)
        self._matrix = np.zeros((2 * count, 2 * count))
        self._side = np.zeros(2 * count)
        for number, (rows, weight) in enumerate(zip(self._rows, weights, strict=True)):
            here = slice(2 * number, 2 * number + 2)
            self._matrix[here, here] = rows.T @ (weight[:, None] * rows)
            self._side[here] = rows.T @ weight
        self._total = float(sum(weight.sum() for weight in weights))

    def _solved(self, count: int, variances: Line) -> Solved:
        """Returns the posterior of the lines of the first frames, given their points.

        Args:
            count: Number of the frames.
            variances: Logarithms of the five variances, in the order of `START`.
        """
        variance = np.exp(variances)
        number = np.arange(count)
        steps = np.minimum(number[:, None], number[None])
        factor = np.zeros((2 * count, 2 * count))
        # Level and slope.
        for parameter in (0, 1):
            covariance = DIFFUSE + variance[parameter] * steps
            covariance = covariance + (variance[2 + parameter] + LEAST_VARIANCE) * np.eye(count)
            factor[parameter::2, parameter::2] = np.linalg.cholesky(covariance)
        matrix = self._matrix[: 2 * count, : 2 * count] / variance[4]
        side = self._side[: 2 * count] / variance[4]
        root = np.linalg.cholesky(np.eye(2 * count) + factor.T @ matrix @ factor)
        reduced = np.linalg.solve(root, factor.T @ side)
        return Solved(factor, root, reduced)

    def _cost(self, variances: Line) -> float:
        """Minus the log likelihood of all points, up to a constant."""
        solved = self._solved(len(self._rows), variances)
        points = sum(map(len, self._rows))
        squares = self._total / np.exp(variances[4]) - solved.reduced @ solved.reduced
        determinant = points * variances[4] + 2 * np.log(np.diag(solved.root)).sum()
        return float(squares + determinant) / 2

    def _lines(self, count: int) -> Line:
        """(count, 2) level and slope of the first frames, given their points."""
        factor, root, reduced = self._solved(count, self._variances)
        lines: Line = factor @ np.linalg.solve(root.T, reduced)
        return lines.reshape(count, 2)


# --- measuring ---


def sequence_of(name: str, data: Path, count: int | None) -> list[EvalFrame]:
    """Returns the first frames of a set, in order, of fewer rows and columns."""
    frames = list(ALL_SETS[name](data))[:count]
    thin = (slice(THINNED // 2, None, THINNED),) * 2
    return [
        EvalFrame(
            frame.name,
            np.ascontiguousarray(frame.rgb[thin]),
            np.ascontiguousarray(frame.gt[thin]),
        )
        for frame in frames
    ]


def measure(
    frames: Sequence[EvalFrame], disparity: Sequence[Map], drift: str, count: int, seed: int
) -> list[Run]:
    """Returns the runs of a sequence with so many points a frame, one for each alignment."""
    maps = [torch.from_numpy(values) for values in drifting(disparity, drift, seed)]
    points = [
        frame.points(count, zlib.crc32(f"{frame.name} {seed}".encode())).tensors()
        for frame in frames
    ]
    runs = list[Run]()
    for alignment, depths in alignments_of(Sequenced(maps, points)).items():
        results = propagated(depths, frames, points)
        # The level that is tied is the one of the result, too.
        with patch.multiple(gaussian_process, CONSTANT=0.0, SLOPE=0.0):
            held = propagated(depths, frames, points)
        run: Run = {"alignment": alignment, "points": count, "drift": drift, "seed": seed}
        for what, stage in (("aligned", depths), ("result", results), ("held", held)):
            run[what] = [mae(depth, frame) for depth, frame in zip(stage, frames, strict=True)]
            run[f"shake, {what}"] = shake(stage, frames)
        runs.append(run)
    return runs


def propagated(
    depths: Sequence[Tensor], frames: Sequence[EvalFrame], points: Sequence[SparsePoints]
) -> list[Tensor]:
    """Returns depth (H, W) in metres of each frame, corrected by what its points measured.

    The log ratio of measured and aligned depth at the points is propagated to all pixels.

    Args:
        depths: Aligned depth (H, W) in metres of each frame.
        frames: The frames, whose images guide the propagation.
        points: Points of each frame.
    """
    return [
        ResidualField(depth, sparse, tensor_of(frame.rgb)).depth()
        for depth, frame, sparse in zip(depths, frames, points, strict=True)
    ]


def mae(depth: Tensor, frame: EvalFrame) -> float:
    """Returns the mean absolute error in metres where there is ground truth."""
    known = frame.gt > 0
    return float(np.abs(depth.numpy() - frame.gt)[known].mean())


def shake(depths: Sequence[Tensor], frames: Sequence[EvalFrame]) -> float:
    """Returns how much the scale changes from frame to frame.

    It is the standard deviation of the differences of median log(depth / true depth).
    """
    scales = list[float]()
    for depth, frame in zip(depths, frames, strict=True):
        known = frame.gt > 0
        scales.append(float(np.median(np.log(depth.numpy()[known] / frame.gt[known]))))
    return float(np.diff(scales).std())


def geometric_mean(values: Sequence[float]) -> float:
    """Returns the geometric mean of positive values."""
    return float(np.exp(np.log(values).mean()))


def print_tables(runs: Sequence[Run]) -> None:
    """Prints a table for each stage's MAE, and for its change of scale from frame to frame.

    A line is the mean of the runs with the same set and number of points, and in a second table
    also with the same kind of errors and drift; a column is an alignment.
    """
    names = list(dict.fromkeys(run["alignment"] for run in runs))
    # What the runs of a line have in common.
    groupings = {
        "all": ("set", "points"),
        "by drift": ("set", "points", "faults", "drift"),
    }
    for what in (*STAGES, *(f"shake, {stage}" for stage in STAGES)):
        for title, keys in groupings.items():
            print(f"\n{what}: {title}\n")
            print_row("set", "points", "errors, drift", *names, head=True)
            for case in dict.fromkeys(tuple(run[key] for key in keys) for run in runs):
                of_case = [run for run in runs if tuple(run[key] for key in keys) == case]
                cells = list[str]()
                for name in names:
                    of_name = [run for run in of_case if run["alignment"] == name]
                    cells.append(_cell(of_name, what))
                set_name, points, *faults_and_drift = case
                print_row(set_name, points, ", ".join(faults_and_drift), *cells)


def print_changes(runs: Sequence[Run]) -> None:
    """Prints by how much MAE changes where the alignment is tied and the residual's mean held."""
    print("\nchange of MAE of the result, tied and held (95 % over frames)\n")
    print_row("set", "points", "against alone", "against disparity alone", head=True)
    for case in dict.fromkeys((run["set"], run["points"]) for run in runs):
        of_case = [run for run in runs if (run["set"], run["points"]) == case]
        tied = _log_errors(of_case, "tied", "held")
        cells = [
            change_with_interval(tied - _log_errors(of_case, name, "result"))
            for name in ("alone", "disparity")
        ]
        print_row(*case, *cells)


def change_with_interval(log_ratios: Line) -> str:
    """Returns the mean change in percent and its 95 % interval, of log ratios (N,) of frames."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(log_ratios), size=(RESAMPLED, len(log_ratios)))
    means = log_ratios[drawn].mean(axis=1)
    ends = np.quantile(means, (0.025, 0.975))
    mean, low, high = 100 * np.expm1([log_ratios.mean(), *ends])
    return f"{mean:+.1f} % ({low:+.1f} … {high:+.1f})"


def _log_errors(runs: Sequence[Run], alignment: str, what: str) -> Line:
    """Mean log MAE of each frame (N,) over the runs of an alignment."""
    of_name = [run[what] for run in runs if run["alignment"] == alignment]
    errors: Line = np.log(of_name).mean(axis=0)
    return errors


def _cell(runs: Sequence[Run], what: str) -> str:
    """Returns the mean shake in per cent, or of a stage the geometric mean MAE in metres."""
    if what.startswith("shake"):
        return f"{100 * float(np.mean([run[what] for run in runs])):.2f} %"
    return f"{geometric_mean([value for run in runs for value in run[what]]):.4f}"


def _depth(x: Tensor, points: SparsePoints, tried: Sequence[Candidate]) -> Tensor:
    """Returns depth (H, W) in metres of a map x (H, W), aligned with the points of its frame."""
    return align(points.sample(x), points, tried).depth(x)


def main() -> None:
    """Measures every alignment on every sequence, and prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="+", default=[*CHOOSING, *REPORTED])
    parser.add_argument("--points", nargs="+", type=int, default=COUNTS)
    parser.add_argument("--drifts", nargs="+", default=[*DRIFTS, STRETCHED])
    parser.add_argument("--frames", type=int, help="only so many of each sequence")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="keeps every run")
    arguments = parser.parse_args()
    runs = list[Run]()
    for name in arguments.sets:
        frames = sequence_of(name, arguments.data, arguments.frames)
        for faults in FAULTS:
            disparity = weakened_disparity(frames, faults, 0)
            for drift in arguments.drifts:
                for count in arguments.points:
                    for seed in range(arguments.seeds):
                        found = measure(frames, disparity, drift, count, seed)
                        runs += [run | {"set": name, "faults": faults} for run in found]
            if arguments.json is not None:
                arguments.json.write_text(json.dumps(runs))
    print_tables(runs)
    print_changes(runs)


if __name__ == "__main__":
    main()
