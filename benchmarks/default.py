"""What `pnpdepth refine` gives without options: `python -m benchmarks.default --data PATH`.

For each network, set and number of points, means over frames and seeds of the MAE and the RMSE in
metres: linear interpolation, the network aligned with the points, its z updated and its residual
propagated (both by `--method alone`), `compact` alone, and the result. All are scored on the same
pixels, those with ground truth. `worse` is the fraction of frames where the MAE of the result is
above that of linear interpolation, `weight` the mean weight of the network in the result, its depth
as a prior of `compact` included, `no part` the fraction of frames where it is below 1 %, and
`warned` the fraction with a warning that the image does not help.

A second table has the fractions of the ground truth within multiples of `--uncertainty`'s standard
deviation, the fraction of frames with at least 60 % within one and 90 % within two, and what its
mask does with errors above a quarter of the depth: as it is, and if the least certain twentieth of
the ground truth is masked instead.

Constants of the default were chosen on the even frames of each set (`--half even`); the odd ones
are for reporting.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.frames import (
    HALVES,
    OUTLIERS,
    REGISTRATIONS,
    Depth,
    EvalFrame,
    by_default,
    drawn_inputs,
    errors_of,
    frames_of,
    opened,
    print_row,
    registered,
    without_occluded,
)
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.refine_frame import LEAST_WEIGHT_IN_RESULT
from pnpdepth_cli.frames.uncertainty import with_uncertainty
from pnpdepth_cli.measures import AFTER, ALONE, BEFORE, LINEAR, PROPAGATED, UPDATED
from pnpdepth_cli.models.network import Network

COUNTS = (20, 100, 500)
NETWORKS = {
    "7scenes": ("fastdepth", "compact", "fcrn-tiny", "eigen-tiny"),
    "icl_nuim": ("fastdepth", "compact", "fcrn-tiny", "eigen-tiny"),
    "kitti_dc": (
        "fastdepth",
        "compact",
        "sparse2dense-tiny-kitti",
        "sfmlearner-tiny",
        # Trained for KITTI's scanner.
        "pncnn",
        "nconv",
    ),
    "tum_fr1_rpy": ("fastdepth", "compact"),
    "tum_fr3_cabinet": ("fastdepth", "compact"),
    "nyu": ("fastdepth", "compact"),
    "realsense": ("fastdepth", "compact"),  # its colour is not registered
}
"""By set; nothing was chosen on the last four."""
STAGES = (LINEAR, BEFORE, UPDATED, PROPAGATED, ALONE, AFTER)
MULTIPLES = (1, 2, 3, 4)
WRONG = 0.2  # fraction of the points, with `--outliers`
LARGE_ERROR = 0.25  # of the depth
MASKED = 0.05  # of the ground truth
HEAD = (
    "network",
    "set, runs",
    "points",
    *STAGES,
    "after / linear",
    "worse",
    "weight",
    "no part",
    "warned",
    "CPU s",
)
UNCERTAINTY_HEAD = (
    "network",
    "set, runs",
    "points",
    *(f"within ± {k} σ" for k in MULTIPLES),
    "≥ 60, ≥ 90 %",
    "large errors",
    "of these masked",
    "kept",
    "masked at 95 % kept",
)


def cases(args: argparse.Namespace) -> Iterator[tuple[str, str, int | None]]:
    """Yields (network, set, number of points) of what the command line asks for.

    The number is None where the points are a LiDAR's.
    """
    for name, networks in NETWORKS.items():
        for count in (None,) if name == "kitti_dc" else COUNTS:
            for network in networks:
                if args.networks and network not in args.networks:
                    continue
                if args.sets and name not in args.sets:
                    continue
                if args.points and count is not None and count not in args.points:
                    continue
                yield network, name, count


def measure(
    network: Network, frame: EvalFrame, count: int | None, seed: int, outliers: str | None = None
) -> dict[str, Any]:
    """Returns the figures of one frame: a run of the tables.

    They are (MAE, RMSE) in metres by stage, seconds of the processor, the network's weight in the
    result, whether there was a warning about the image, and the figures of `uncertainty`.

    Args:
        network: The network.
        frame: The frame.
        count: Number of points that are drawn; None: all points of its LiDAR.
        seed: Random seed of the points, of the outliers and of the refinement.
        outliers: Kind of the outliers that a fifth of the points become, of `OUTLIERS`; None: none.
    """
    # The commands drop the occluded points of a projected scan.
    if count is None:
        frame = without_occluded(frame)
    inputs = drawn_inputs(frame, count, seed)
    if outliers is not None:
        inputs = replace(inputs, points=OUTLIERS[outliers](inputs.points, WRONG, seed))
    start = time.process_time()
    refined = by_default(network, inputs, seed)
    seconds = time.process_time() - start
    depths = {LINEAR: linear(inputs.points), AFTER: torch.from_numpy(refined.depth)}
    depths |= {name: torch.from_numpy(depth) for name, depth in refined.stages.items()}
    # By default z of some networks is not updated: the network's own steps are those of `alone`.
    if ALONE in depths:
        alone = by_default(network, inputs, seed, method="alone")
        for name in (UPDATED, PROPAGATED):
            depths.pop(name, None)
            if name in alone.stages:
                depths[name] = torch.from_numpy(alone.stages[name])
    return {
        "errors": errors_of(depths, torch.from_numpy(frame.gt)),
        "cpu_s": seconds,
        "weight": weight_of(network, refined),
        "warned": any(note.startswith("warning: the image") for note in refined.notes),
        "uncertainty": uncertainty(with_uncertainty(refined), frame.gt),
    }


def weight_of(network: Network, refined: Refined) -> float:
    """Returns the weight (0…1) of a network in the result.

    It includes the weight of `compact` with the network's depth as its prior.
    """
    name = network.definition.name
    experts = (name, f"compact with {name}")
    return sum(weight for expert, weight in refined.weights.items() if expert in experts)


def uncertainty(refined: Refined, gt: Depth) -> dict[str, Any]:
    """Returns how well the standard deviations and the mask of a result tell its errors.

    All are fractions of the pixels with depth and ground truth, or of those of them with a large
    error, above a quarter of the true depth:
        within: Error within each of `MULTIPLES` standard deviations.
        large: Large error.
        caught: Of the large errors, those that the mask hides; None if there are none.
        ranked: Of the large errors, those among the least certain twentieth of all pixels, by
            σ / depth; None if there are none.
        kept: Not hidden by the mask.
    """
    assert refined.sigma is not None
    assert refined.valid is not None
    known = (gt > 0) & (refined.depth > 0)
    error = np.abs(gt - refined.depth)[known]
    sigma = refined.sigma[known]
    relative = sigma / refined.depth[known]
    large = error > LARGE_ERROR * gt[known]
    masked = ~refined.valid[known]
    uncertain = relative > np.quantile(relative, 1 - MASKED)
    return {
        "within": [float((error <= multiple * sigma).mean()) for multiple in MULTIPLES],
        "large": float(large.mean()),
        "caught": float(masked[large].mean()) if large.any() else None,
        "ranked": float(uncertain[large].mean()) if large.any() else None,
        "kept": float(1 - masked.mean()),
    }


def uncertainty_cells(rows: list[dict[str, Any]]) -> list[str]:
    """Returns the cells of the second table, the means over the runs of `measure`."""
    of_frames = [row["uncertainty"] for row in rows]
    within = np.array([of_frame["within"] for of_frame in of_frames])
    # The frames whose σ says enough: 60 % of the pixels within one, 90 % within two.
    covered = ((within[:, 0] >= 0.6) & (within[:, 1] >= 0.9)).mean()

    def mean(name: str) -> str:
        """Returns the mean over the frames that have this figure; empty if none has."""
        fractions = [of_frame[name] for of_frame in of_frames if of_frame[name] is not None]
        return f"{np.mean(fractions):.1%}" if fractions else ""

    masks = (mean(name) for name in ("large", "caught", "kept", "ranked"))
    return [*(f"{value:.0%}" for value in within.mean(axis=0)), f"{covered:.0%}", *masks]


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns means over the runs of `measure`; of the seconds, the median."""
    errors = [row["errors"] for row in rows]
    # A stage that some frame lacks has no mean.
    stages = [stage for stage in errors[0] if all(stage in of_frame for of_frame in errors)]
    means = {stage: np.mean([of_frame[stage] for of_frame in errors], axis=0) for stage in stages}
    worse = [of_frame[AFTER][0] > of_frame[LINEAR][0] for of_frame in errors]
    return {
        "frames": len(rows),
        "mean": {stage: tuple(mean.tolist()) for stage, mean in means.items()},
        "worse": float(np.mean(worse)),
        "weight": float(np.mean([row["weight"] for row in rows])),
        "no_part": float(np.mean([row["weight"] < LEAST_WEIGHT_IN_RESULT for row in rows])),
        "warned": float(np.mean([row["warned"] for row in rows])),
        "cpu_s": float(np.median([row["cpu_s"] for row in rows])),
    }


def main() -> None:
    """Measure, and print a table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--half", choices=HALVES, default="odd")
    parser.add_argument("--frames", type=int, default=3, help="frames of each set")
    parser.add_argument("--seeds", type=int, default=1, help="draws of the points of each frame")
    parser.add_argument("--networks", nargs="+", help="only these")
    parser.add_argument("--sets", nargs="+", help="only these")
    parser.add_argument("--points", nargs="+", type=int, help="only these numbers of points")
    parser.add_argument("--outliers", choices=OUTLIERS, help="make a fifth of the points wrong")
    parser.add_argument("--registration", choices=REGISTRATIONS, default="frame")
    args = parser.parse_args()
    # Each case in turn, its line printed as it comes.
    print_row(*HEAD, head=True)
    networks: dict[str, Network] = {}
    second = list[tuple[Any, ...]]()
    for name, set_name, count in cases(args):
        network = networks.setdefault(name, opened(name, args.data))
        frames = frames_of(set_name, args.data, args.frames, args.half)
        rows = [
            measure(network, frame, count, seed, args.outliers)
            for seed in range(args.seeds if count else 1)
            for frame in registered(frames, count, seed, args.registration)
        ]
        means = summary(rows)
        *errors, result = (
            f"{mae:.4f} / {rmse:.3f}" if mae is not None else ""
            for mae, rmse in (means["mean"].get(stage, (None, None)) for stage in STAGES)
        )
        case = (name, f"{set_name}, {means['frames']}", count or "LiDAR")
        second.append((*case, *uncertainty_cells(rows)))
        print_row(
            *case,
            *errors,
            f"**{result}**",
            f"{means['mean'][AFTER][0] / means['mean'][LINEAR][0]:.3f}",
            f"{means['worse']:.0%}",
            f"{means['weight']:.0%}",
            f"{means['no_part']:.0%}",
            f"{means['warned']:.0%}",
            f"{means['cpu_s']:.1f}",
        )
    # What is said of σ.
    print()
    print_row(*UNCERTAINTY_HEAD, head=True)
    for cells in second:
        print_row(*cells)


if __name__ == "__main__":
    main()
