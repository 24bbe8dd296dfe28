"""What `pnpdepth refine` gives without options: `python -m benchmarks.default --data PATH`.

For each network, set and number of points, means over frames and seeds of the MAE and the RMSE in
metres: linear interpolation, the stages of the default method (the network aligned with the points,
the networks fused, z updated, the residual propagated), and its result. All are scored on the same
pixels, those with ground truth. `worse` is the fraction of frames where the MAE of the result is
above that of linear interpolation, `moved` the fraction where the check moved it.

Constants of the default were chosen on the even frames of each set (`--half even`); the odd ones
are for reporting.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from benchmarks.accuracy import Case, Errors, by_default, errors_of, opened
from benchmarks.frames import (
    MORE_SETS,
    REGISTRATIONS,
    SETS,
    EvalFrame,
    drawn_inputs,
    registered,
    without_occluded,
)
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.models.network import Network

ROOMS = ("7scenes", "icl_nuim")
COUNTS = (20, 100, 500)
OF_ROOMS = ("fastdepth", "compact", "fcrn-tiny", "eigen-tiny")
OF_STREETS = ("fastdepth", "compact", "sparse2dense-tiny-kitti", "sfmlearner-tiny")
REPORT_ONLY = ("tum_fr1_rpy", "tum_fr3_cabinet")
OF_SENSORS = ("pncnn", "nconv")
"""Networks trained for KITTI's scanner."""


def cells() -> Iterator[Case]:
    """All that is measured."""
    for frames in ROOMS:
        for points in COUNTS:
            yield from (Case(network, frames, points) for network in OF_ROOMS)
    yield from (Case(network, "kitti_dc", None) for network in (*OF_STREETS, *OF_SENSORS))
    for frames in REPORT_ONLY:
        for points in COUNTS:
            yield from (Case(network, frames, points) for network in ("fastdepth", "compact"))


def measure(network: Network, frame: EvalFrame, count: int | None, seed: int) -> dict[str, object]:
    """MAE and RMSE of every column on one frame, the choice, and its time."""
    if count is None:  # as the commands read a projected scan
        frame = without_occluded(frame)
    inputs = drawn_inputs(frame, count, seed)
    start = time.process_time()
    refined = by_default(network, inputs, seed)
    seconds = time.process_time() - start
    depths = {"linear": linear(inputs.points), "result": torch.from_numpy(refined.after)}
    depths |= {name: torch.from_numpy(depth) for name, depth in refined.stages.items()}
    moved = not np.array_equal(refined.after, refined.stages["propagated"])
    return {
        "errors": errors_of(depths, torch.from_numpy(frame.gt)),
        "cpu_s": seconds,
        "moved": moved,
    }


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Means over the frames of a cell."""
    errors: list[Errors] = [row["errors"] for row in rows]  # type: ignore[misc]
    names = [name for name in errors[0] if all(name in each for each in errors)]
    mean = {n: tuple(float(np.mean([e[n][k] for e in errors])) for k in (0, 1)) for n in names}
    worse = [each["result"][0] > each["linear"][0] for each in errors]
    return {
        "frames": len(rows),
        "mean": mean,
        "worse": float(np.mean(worse)),
        "moved": float(np.mean([row["moved"] for row in rows])),
        "cpu_s": float(np.median([row["cpu_s"] for row in rows])),
    }


STAGES = ("linear", "aligned", "fused", "updated", "propagated", "result")
HEAD = ("network", "set, runs", "points", *STAGES, "result / linear", "worse", "moved", "CPU s")


def table_row(cell: Case, measured: dict[str, object]) -> str:
    """A line of the table."""
    mean: dict[str, tuple[float, float]] = measured["mean"]  # type: ignore[assignment]
    values = [f"{mean[name][0]:.4f} / {mean[name][1]:.3f}" for name in STAGES]
    values[-1] = f"**{values[-1]}**"
    cells_ = [
        *(cell.network, f"{cell.frames}, {measured['frames']}", str(cell.points or "LiDAR")),
        *values,
        f"{mean['result'][0] / mean['linear'][0]:.3f}",
        *(f"{measured[name]:.0%}" for name in ("worse", "moved")),
        f"{measured['cpu_s']:.1f}",
    ]
    return "| " + " | ".join(cells_) + " |"


def frames_of(name: str, data: Path, half: str, count: int) -> list[EvalFrame]:
    """`count` evenly spaced frames of one half of a set."""
    frames = list((SETS | MORE_SETS)[name](data))[{"even": 0, "odd": 1}[half] :: 2]
    return [frames[round(i)] for i in np.linspace(0, len(frames) - 1, min(count, len(frames)))]


def main() -> None:
    """Measure, and print a table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--half", choices=("even", "odd"), default="odd")
    parser.add_argument("--frames", type=int, default=3, help="frames of each set")
    parser.add_argument("--seeds", type=int, default=1, help="draws of the points of each frame")
    parser.add_argument("--networks", nargs="+", help="only these")
    parser.add_argument("--sets", nargs="+", help="only these")
    parser.add_argument("--points", nargs="+", type=int, help="only these numbers of points")
    parser.add_argument("--registration", choices=REGISTRATIONS, default="frame")
    parser.add_argument("--json", type=Path, help="everything, to this file")
    args = parser.parse_args()
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    networks: dict[str, Network] = {}
    everything = []
    for cell in cells():
        if args.networks and cell.network not in args.networks:
            continue
        if args.sets and cell.frames not in args.sets:
            continue
        if args.points and cell.points is not None and cell.points not in args.points:
            continue
        network = networks.setdefault(cell.network, opened(cell.network, args.data))
        frames = frames_of(cell.frames, args.data, args.half, args.frames)
        seeds = range(args.seeds if cell.points else 1)
        rows = [
            measure(network, frame, cell.points, seed)
            for seed in seeds
            for frame in registered(frames, cell.points, seed, args.registration)
        ]
        measured = summary(rows)
        print(table_row(cell, measured), flush=True)
        everything.append({"cell": vars(cell), "summary": measured, "frames": rows})
        if args.json:
            args.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
