"""Weights adapted to a folder: `python -m benchmarks.adapt --data PATH`.

Consecutive frames of a set at half their size, with points drawn from the ground truth. `compact`
is adapted to the points of every second frame, and scored on the others: MAE in metres at all
pixels with ground truth, of its prediction without further updates.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.frames import (
    SETS,
    EvalFrame,
    drawn_inputs,
)
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.pipeline.adapt import adapt
from pnpdepth_cli.pipeline.adapt_request import AdaptRequest
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.refine import load_refiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.sensors import SamplePattern


def halved(frame: EvalFrame) -> EvalFrame:
    """The frame at half its size; of ground truth, every second pixel."""
    rgb = cv2.resize(frame.rgb, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return EvalFrame(frame.name, rgb, np.ascontiguousarray(frame.gt[1::2, 1::2]))


def write_folder(folder: Path, frames: Sequence[EvalFrame]) -> None:
    """Writes rgb/ and gt/ of the frames, and frames.csv, which lists them."""
    for part in ("rgb", "gt"):
        (folder / part).mkdir(parents=True)
    for number, frame in enumerate(frames):
        pixels = (frame.rgb[:, :, ::-1] * 255).round().astype(np.uint8)
        cv2.imwrite(str(folder / "rgb" / f"f_{number:03}.png"), pixels)
        write_depth(folder / "gt" / f"f_{number:03}.png", frame.gt, scale=1000)
    rows = (f"rgb/f_{number:03}.png,gt/f_{number:03}.png\n" for number in range(len(frames)))
    (folder / "frames.csv").write_text("image,gt\n" + "".join(rows))


def mae(frames: Sequence[Inputs], checkpoint: Path | None) -> float:
    """MAE of compact's prediction, the mean over the frames."""
    options = {"iterations": 0, "propagate": "none", "checkpoint": checkpoint}
    refiner = load_refiner(RefineRequest.from_fields(**options), frames[0])
    with refiner:
        depths = [refiner.refine_frame(frame).after for frame in frames]
    return float(np.mean([_error(d, f) for d, f in zip(depths, frames, strict=True)]))


def mae_of_linear(frames: Sequence[Inputs]) -> float:
    """MAE of linear interpolation, the mean over the frames."""
    return float(np.mean([_error(linear(f.points).numpy(), f) for f in frames]))


def _error(depth: NDArray[np.float32], frame: Inputs) -> float:
    assert frame.gt is not None
    known = frame.gt > 0
    return float(np.abs(depth - frame.gt)[known].mean())


def main() -> None:
    """Adapt for every seed, and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--set", choices=SETS, default="7scenes")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--points", type=int, default=500)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    args = parser.parse_args()
    frames = [halved(f) for f in itertools.islice(SETS[args.set](args.data), args.frames)]
    print("| seed | updates, kept | loss at hidden points | linear | compact | adapted | change |")
    print("|" + "---|" * 7)
    with tempfile.TemporaryDirectory() as temporary:
        write_folder(Path(temporary) / "even", frames[::2])
        for seed in args.seeds:
            weights = Path(temporary) / f"adapted_{seed}.safetensors"
            pattern = SamplePattern(count=args.points)
            request = AdaptRequest(
                source=Path(temporary) / "even/frames.csv",
                output=weights,
                refine=RefineRequest.from_fields(sample=pattern, seed=seed),
                steps=args.steps,
            )
            adapted = adapt(request, lambda _: None, lambda *_: None)
            tested = [drawn_inputs(frame, args.points, seed) for frame in frames[1::2]]
            before, after = mae(tested, None), mae(tested, weights)
            print(
                f"| {seed} | {args.steps}, {adapted.kept} | {adapted.change:+.1%} |"
                f" {mae_of_linear(tested):.4f} | {before:.4f} | {after:.4f} |"
                f" {after / before - 1:+.1%} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
