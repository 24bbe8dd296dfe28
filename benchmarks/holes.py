"""Holes cut out of depth maps, filled: `python -m benchmarks.holes --data PATH`.

Ellipses of 5 to 80 pixels are cut out of the depth of Kinect frames, all other pixels are the
points, and the depth in the ellipses is the truth. For each method, the MAE in metres over the
holes of each size and over all, the fraction of the measured pixels that it changes by more than
2 mm, and seconds and peak memory of a frame. Of a network also the fractions of the pixels in holes
whose truth is within one and two of `--uncertainty`'s standard deviations, and that it calls valid.
Each method has a process of its own.

- linear: linear interpolation of the points
- telea, ns: OpenCV's inpainting (Telea 2004; Bertalmio et al. 2001) of depth in 16 bits
- the name of a network: what `pnpdepth refine` gives by default; with "alone", by `--method alone`

The odd frames are for reporting, and so is all of TUM.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.frames import (
    HALVES,
    Depth,
    EvalFrame,
    drawn_inputs,
    frames_of,
    opened,
    print_row,
)
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.uncertainty import with_uncertainty
from pnpdepth_cli.settings import Settings

SIZES = (5, 10, 20, 40, 80)
"""The longer axis of a hole, pixels."""
AREA = 5000
"""Pixels of all holes of one size in a frame, about."""
MOST = 40
"""Holes of one size in a frame, at most."""
KNOWN = 0.9
"""Fraction of the pixels of a hole that must have been measured."""
TRIES = 2000
"""Places that are tried for a hole."""
CHANGED = 0.002
"""Metres."""
SETS = ("7scenes", "tum_fr1_rpy", "tum_fr3_cabinet")
METHODS = ("linear", "telea", "ns", "compact", "fastdepth", "fastdepth alone")
INPAINTING = {"telea": cv2.INPAINT_TELEA, "ns": cv2.INPAINT_NS}
RADIUS = 5.0
"""Pixels around a hole that inpainting looks at."""
FULL_SCALE = 65535 / 10.0
"""Values of 16 bits per metre."""


@dataclass(frozen=True)
class Scores:
    """Of one method on some frames: |error| in metres by size of the hole, and what it costs."""

    errors: dict[int, NDArray[np.float32]]
    within: dict[int, NDArray[np.float32]]  # |error| in standard deviations; empty without any
    valid: NDArray[np.bool_]  # of all holes
    changed: float  # fraction of the measured pixels
    seconds: float  # CPU, a frame
    wall: float  # seconds a frame
    peak: float  # GB


def cut_holes(gt: Depth, seed: int) -> NDArray[np.uint8]:
    """Returns (H, W) the size of the hole that each pixel is in, 0 for none."""
    rng = np.random.default_rng(seed)
    height, width = gt.shape
    size_of = np.zeros(gt.shape, np.uint8)
    for size in reversed(SIZES):
        wanted = min(MOST, max(1, round(AREA / (0.55 * size * size))))
        for _ in range(TRIES):
            if not wanted:
                break
            centre = (int(rng.integers(width)), int(rng.integers(height)))
            axes = (size / 2, size / 2 * rng.uniform(0.5, 1.0))
            hole = np.zeros(gt.shape, np.uint8)
            box = (centre, (2 * axes[0], 2 * axes[1]), rng.uniform(0, 180))
            cv2.ellipse(hole, box, 1, -1)
            apart = cv2.dilate(hole, np.ones((7, 7), np.uint8)) > 0
            if (size_of[apart] > 0).any() or (gt[hole > 0] > 0).mean() < KNOWN:
                continue
            size_of[hole > 0] = size
            wanted -= 1
    return size_of


def filled(method: str, frame: EvalFrame, data: Path) -> Depth | Refined:
    """The depth (H, W) that a method gives for a frame with holes, metres; all of a network."""
    if method in INPAINTING:
        scaled = (frame.gt * FULL_SCALE).round().clip(0, 65535).astype(np.uint16)
        unknown = (scaled == 0).astype(np.uint8)
        depth = cv2.inpaint(scaled, unknown, RADIUS, INPAINTING[method])
        return (depth / FULL_SCALE).astype(np.float32)
    inputs = drawn_inputs(frame, frame.gt.size, 0)
    if method == "linear":
        return linear(inputs.points).numpy()
    name, *alone = method.split()
    settings = Settings(method="alone") if alone else Settings()
    with Method([opened(name, data)], settings, inputs) as chosen:
        return chosen.refine(replace(inputs, gt=None))


def measure(method: str, name: str, data: Path, half: str, count: int) -> Scores:
    """Returns the scores of a method on frames of a set.

    Args:
        method: Name of `METHODS`.
        name: Name of the set.
        data: The folder of real frames.
        half: Which frames of the set, of `HALVES`.
        count: Number of frames.
    """
    # One thread, so that seconds of the processor can be compared.
    torch.set_num_threads(1)
    errors: dict[int, list[Depth]] = {size: [] for size in SIZES}
    within: dict[int, list[Depth]] = {size: [] for size in SIZES}
    valid = list[NDArray[np.bool_]]()
    changed = list[float]()
    cpu = 0.0
    wall = 0.0
    frames = frames_of(name, data, count, half)
    for number, frame in enumerate(frames):
        # Holes are cut, and filled by the method.
        size_of = cut_holes(frame.gt, number)
        holed = replace(frame, gt=np.where(size_of > 0, 0, frame.gt))
        start = time.process_time()
        start_wall = time.perf_counter()
        result = filled(method, holed, data)
        cpu += time.process_time() - start
        wall += time.perf_counter() - start_wall
        # The errors in the holes, by size, and in standard deviations.
        depth = result.depth if isinstance(result, Refined) else result
        error = np.abs(depth - frame.gt)
        for size in SIZES:
            errors[size].append(error[(size_of == size) & (frame.gt > 0)])
        if isinstance(result, Refined):
            certain = with_uncertainty(result)
            for size in SIZES:
                known = (size_of == size) & (frame.gt > 0)
                within[size].append(error[known] / certain.sigma[known])
                valid.append(certain.valid[known])
        # What became of the measured pixels.
        difference = np.abs(depth - holed.gt)[holed.gt > 0]
        changed.append(float((difference > CHANGED).mean()))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        1e9 if sys.platform == "darwin" else 1e6
    )
    return Scores(
        errors={size: np.concatenate(of_frames) for size, of_frames in errors.items()},
        within={size: np.concatenate(of_frames) for size, of_frames in within.items() if of_frames},
        valid=np.concatenate(valid) if valid else np.empty(0, np.bool_),
        changed=float(np.mean(changed)),
        seconds=cpu / len(frames),
        wall=wall / len(frames),
        peak=peak,
    )


def coverage(scores: Scores) -> list[str]:
    """Returns the last cells of a row: per cent within one and two σ, and of valid pixels.

    The former are by size of the hole and in all; "—" of a method that has no σ.
    """
    if not scores.within:
        return ["—"] * (len(SIZES) + 2)
    every = np.concatenate(list(scores.within.values()))
    cells = [
        f"{(deviations <= 1).mean():.0%}, {(deviations <= 2).mean():.0%}"
        for deviations in (*scores.within.values(), every)
    ]
    return [*cells, f"{scores.valid.mean():.1%}"]


def main() -> None:
    """Measure, and print a table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--half", choices=HALVES, default="odd")
    parser.add_argument("--frames", type=int, default=3, help="frames of each set")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=SETS)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    args = parser.parse_args()
    sizes = [f"{size} px" for size in SIZES]
    costs = "changed", "CPU s", "s", "GB"
    within = *(f"±1σ, ±2σ {size}" for size in sizes), "±1σ, ±2σ", "valid"
    print_row("set, frames", "method", *sizes, "all", *costs, *within, head=True)
    for name in args.sets:
        for method in args.methods:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                task = process.submit(measure, method, name, args.data, args.half, args.frames)
                scores = task.result()
            means = [f"{scores.errors[size].mean():.4f}" for size in SIZES]
            every = np.concatenate(list(scores.errors.values())).mean()
            costs = (
                f"{scores.changed:.1%}",
                f"{scores.seconds:.1f}",
                f"{scores.wall:.1f}",
                f"{scores.peak:.2f}",
            )
            case = f"{name}, {args.frames}"
            print_row(case, method, *means, f"**{every:.4f}**", *costs, *coverage(scores))


if __name__ == "__main__":
    main()
