"""Memory and time of a batch: `python -m benchmarks.batch [--frames 2000] [--size 48x64] [--html]`.

Makes that many small frames, refines them with the embedded network, and prints the memory that the
process holds as frames go by, its peak, where the time goes, and what a second run costs that has
nothing to do.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.pipeline.batch.batch import run_batch
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.refinement.request import NetworkChoice, RefineRequest
from pnpdepth_cli.pipeline.stopwatch import peak_memory_mb

PAGE = 4096
POINTS = 200


class Watcher:
    """Notes the memory in use after 100, 200, 400, … frames, and when each was done."""

    def __init__(self) -> None:
        self.memory_mb: dict[int, float] = {}
        self.notes: list[str] = []
        self.done = 0

    def say(self, text: str) -> None:
        """Keeps notes on frames that go together."""
        if "batch size" in text:
            self.notes.append(text)

    def begin(self, to_do: int) -> None:
        """The network is loaded."""
        self.to_do = to_do

    def frame(self, row: dict[str, Any]) -> None:
        """One more."""
        self.done += 1
        hundreds, rest = divmod(self.done, 100)
        if self.done == self.to_do or (not rest and hundreds.bit_count() == 1):
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
            self.memory_mb[self.done] = resident / 1e6


def make_frames(root: Path, count: int, height: int, width: int) -> None:
    """rgb/ sparse/ gt/ with smooth images and slanted depth, no two alike."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width] / max(height, width)
    for part in ("rgb", "sparse", "gt"):
        (root / part).mkdir(parents=True)
    for number in range(count):
        a, b, c = rng.uniform(0.5, 2, 3)
        depth = (1 + a * x + b * y).astype(np.float32)
        image = 127 + 120 * np.sin(6 * np.stack([a * x, b * y, c * (x + y)], axis=-1))
        cv2.imwrite(str(root / "rgb" / f"{number:06}.png"), image.astype(np.uint8))
        points = np.zeros(depth.size, np.float32)
        chosen = rng.choice(depth.size, POINTS, replace=False)
        points[chosen] = depth.reshape(-1)[chosen]
        write_depth(root / "sparse" / f"{number:06}.png", points.reshape(depth.shape), scale=1000)
        write_depth(root / "gt" / f"{number:06}.png", depth, scale=1000)


def measure(root: Path, workers: int, model: str, batch_size: int, html: bool) -> dict[str, Any]:
    """The figures of one batch over the folder, and of a second run."""
    request = BatchRequest(
        source=root,
        output=root / "out",
        refine=RefineRequest(network=NetworkChoice(model=model)),
        workers=workers,
        batch_size=batch_size,
        profile=True,
        html=root.parent / "report" if html else None,
    )
    watcher = Watcher()
    profile = run_batch(request, watcher).summary["profile"]
    peak = peak_memory_mb(torch.device("cpu"))["process"]
    start = time.perf_counter()
    run_batch(request, Watcher())
    again = time.perf_counter() - start
    return {
        "frames": watcher.done,
        "memory_mb": watcher.memory_mb,
        "peak_mb": peak,
        "notes": watcher.notes,
        "profile": profile,
        "seconds_of_nothing_to_do": again,
    }


def main() -> None:
    """Make the frames, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--size", default="48x64", help="HxW")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--model", default="compact")
    parser.add_argument("--batch-size", type=int, default=1)
    parser.add_argument("--html", action="store_true", help="with a report")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    height, width = (int(side) for side in args.size.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        make_frames(Path(folder) / "frames", args.frames, height, width)
        root = Path(folder) / "frames"
        result = measure(root, args.workers, args.model, args.batch_size, args.html)
    if args.json:
        print(json.dumps(result, indent=2))
        return
    print(f"{result['frames']:,} frames of {width}×{height}, {args.workers} workers")
    for count, memory in result["memory_mb"].items():
        print(f"  after {count:6,} frames: {memory:6.1f} MB in use")
    print(f"  peak: {result['peak_mb']:.1f} MB")
    for text in result["notes"]:
        print(f"  {text}")
    profile = result["profile"]
    for stage, seconds in profile["seconds"].items():
        print(f"  {stage.replace('_', ' ')}: {1000 * seconds / result['frames']:.1f} ms a frame")
    print(
        f"  {profile['frames_per_second']:.2f} frames a second;"
        f" network busy {profile['network_busy']:.1%}"
    )
    print(f"  a second run, with nothing to do: {result['seconds_of_nothing_to_do']:.1f} s")


if __name__ == "__main__":
    main()
