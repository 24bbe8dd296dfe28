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

The tables have geometric means over frames and seeds of the MAE in metres, aligned and with the
residual propagated, and the shake: the standard deviation of the change from frame to frame of
median log(depth / true depth). Nothing is to be chosen on the two sets of TUM.

    python -m benchmarks.steady --data PATH --sets icl_nuim --frames 10 --json FILE
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from benchmarks.frames import MORE_SETS, SETS, EvalFrame, print_row
from benchmarks.simulated import weakened
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
START = tuple(np.log([1e-3, 1e-3, 1e-3, 1e-3, ERROR**2]))
"""Logarithms of variances: of the walk's steps of level and slope, of a frame's own level and
slope, and of the points' errors, all relative."""
BOUNDS = [(-18.0, 3.0)] * len(START)

Run = dict[str, Any]


class Sequenced(NamedTuple):
    """A sequence as a method sees it: the network's maps (H, W), and the points of each frame."""

    maps: list[Tensor]
    points: list[SparsePoints]


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
        order = [number, *(other for other in near if other != number)]
        together = sequence.points[number]
        for other in order[1:]:
            together = together.joined(sequence.points[other])
        values = torch.cat([at_points[other] for other in order])
        fit = align(values, together, [Candidate("disparity", "affine", 1)])
        depths.append(fit.depth(x))
    return depths


def aligned_tied(sequence: Sequenced, *, behind: bool = False) -> list[Tensor]:
    """Returns depth (H, W) in metres by lines that follow a random walk.

    Args:
        sequence: The frames.
        behind: Whether a frame knows only those before it.
    """
    tried = [TiedLines(sequence.maps, sequence.points)]
    tried.append(TiedLines([standardised(x) for x in sequence.maps], sequence.points))
    likeliest = max(tried, key=lambda lines: lines.log_likelihood)
    return likeliest.depths(behind=behind)


ALIGNMENTS: dict[str, Callable[[Sequenced], list[Tensor]]] = {
    "alone": aligned_alone,
    "disparity": aligned_as_disparity,
    **{f"pooled ±{reach}": partial(aligned_pooled, reach=reach) for reach in REACHES},
    "tied": aligned_tied,
    "behind": partial(aligned_tied, behind=True),
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
        self._centre, self._spread = float(np.median(together)), float(together.std())
        disparity = [1 / p.depth.double().numpy() for p in points]
        self._typical = float(np.median(np.concatenate(disparity)))
        # A row for each point: (level, slope)·row is 1 where the line is exact.
        self._rows = [
            self._typical / y[:, None] * np.stack([np.ones_like(x), self._moved(x)], axis=1)
            for x, y in zip(at_points, disparity, strict=True)
        ]
        self._weights = [np.ones(len(rows)) for rows in self._rows]
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
            self._weights = [1 / (1 + (error / width) ** 2) for error in errors]

    def depths(self, *, behind: bool) -> list[Tensor]:
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
        return (x - self._centre) / self._spread

    def _normal(self, count: int, variances: Line) -> tuple[Line, Line, Line, float]:
        """Factor of the prior's covariance, the normal matrix and side, and the sum of weights."""
        variance = np.exp(variances)
        number = np.arange(count)
        steps = np.minimum(number[:, None], number[None])
        factor = np.zeros((2 * count, 2 * count))
        for part in (0, 1):
            covariance = DIFFUSE + variance[part] * steps
            covariance = covariance + (variance[2 + part] + LEAST_VARIANCE) * np.eye(count)
            factor[part::2, part::2] = np.linalg.cholesky(covariance)
        matrix = np.zeros((2 * count, 2 * count))
        side = np.zeros(2 * count)
        total = 0.0
        for place in range(count):
            rows, weights = self._rows[place], self._weights[place]
            here = slice(2 * place, 2 * place + 2)
            matrix[here, here] = rows.T @ (weights[:, None] * rows)
            side[here] = rows.T @ weights
            total += float(weights.sum())
        return factor, matrix, side, total

    def _cost(self, variances: Line) -> float:
        """Minus the log likelihood of the points, up to a constant."""
        count = len(self._rows)
        factor, matrix, side, total = self._normal(count, variances)
        error = np.exp(variances[4])
        inner = np.eye(2 * count) + factor.T @ matrix @ factor / error
        root = np.linalg.cholesky(inner)
        reduced = np.linalg.solve(root, factor.T @ side) / error
        squares = total / error - reduced @ reduced
        points = sum(map(len, self._rows))
        cost = squares + points * variances[4] + 2 * np.log(np.diag(root)).sum()
        return float(cost) / 2

    def _lines(self, count: int) -> Line:
        """(count, 2) level and slope of the first frames, given their points."""
        factor, matrix, side, _ = self._normal(count, self._variances)
        error = np.exp(self._variances[4])
        inner = np.eye(2 * count) + factor.T @ matrix @ factor / error
        lines: Line = factor @ np.linalg.solve(inner, factor.T @ side / error)
        return lines.reshape(count, 2)


# --- measuring ---


def sequence_of(name: str, data: Path, count: int | None) -> list[EvalFrame]:
    """Returns the first frames of a set, in order, of fewer rows and columns."""
    frames = list((SETS | MORE_SETS)[name](data))[:count]
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
    for alignment, aligned in ALIGNMENTS.items():
        depths = aligned(Sequenced(maps, points))
        results = [
            ResidualField(depth, sparse, tensor_of(frame.rgb)).depth()
            for frame, depth, sparse in zip(frames, depths, points, strict=True)
        ]
        runs.append(
            {
                "alignment": alignment,
                "points": count,
                "drift": drift,
                "seed": seed,
                "aligned": [mae(d, f) for d, f in zip(depths, frames, strict=True)],
                "result": [mae(d, f) for d, f in zip(results, frames, strict=True)],
                "shake": shake(depths, frames),
                "shake of result": shake(results, frames),
            }
        )
    return runs


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
    """Prints MAE and shake of every set and number of points, then by drift."""
    names = [name for name in ALIGNMENTS if any(run["alignment"] == name for run in runs)]
    groups: dict[str, Callable[[Run], tuple[Any, ...]]] = {
        "all": lambda run: (run["set"], run["points"]),
        "by drift": lambda run: (run["set"], run["points"], run["faults"], run["drift"]),
    }
    for what in ("aligned", "result", "shake", "shake of result"):
        for title, key in groups.items():
            print(f"\n{what}, {title}\n")
            print_row("set", "points", "errors, drift", *names, head=True)
            for case in dict.fromkeys(key(run) for run in runs):
                of_case = [run for run in runs if key(run) == case]
                cells = list[str]()
                for name in names:
                    cells.append(_cell([r for r in of_case if r["alignment"] == name], what))
                print_row(case[0], case[1], ", ".join(case[2:]), *cells)


def _cell(runs: Sequence[Run], what: str) -> str:
    if what.startswith("shake"):
        return f"{100 * float(np.mean([run[what] for run in runs])):.2f} %"
    return f"{geometric_mean([value for run in runs for value in run[what]]):.4f}"


def _depth(x: Tensor, points: SparsePoints, tried: Sequence[Candidate]) -> Tensor:
    return align(points.sample(x), points, tried).depth(x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="+", default=[*CHOOSING, *REPORTED])
    parser.add_argument("--points", nargs="+", type=int, default=COUNTS)
    parser.add_argument("--drifts", nargs="+", default=[*DRIFTS, STRETCHED])
    parser.add_argument("--frames", type=int, help="only so many of each sequence")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path)
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


if __name__ == "__main__":
    main()
