"""What bf16 changes: `python -m benchmarks.precision [--data PATH --set icl_nuim --frames 4]`.

The MAE in metres of the plain and of the refined prediction in fp32 and in bf16, with the network's
defaults, over the pixels with known ground truth: on the program's samples, or with --data on the
first frames of a set (500 points of the ground truth; KITTI's own LiDAR).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import torch

from benchmarks.frames import SETS, drawn_inputs
from benchmarks.frames import refined as refined_frame
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refinement.request import FrameFiles, MethodOptions, RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_layer, resolve_settings

PRECISIONS, DEPTHS = ("fp32", "bf16"), ("before", "after")
SAMPLES = Path(__file__).parent.parent / "samples"


def samples() -> Iterator[tuple[str, Inputs]]:
    """The frames that come with the program."""
    for name in ("indoor", "street"):
        folder = SAMPLES / name
        yield (
            name,
            read_inputs(
                RefineRequest(
                    files=FrameFiles(
                        image=folder / "rgb.png",
                        sparse=folder / "sparse.png",
                        gt=folder / "gt.png",
                    )
                )
            ),
        )


def real(data: Path, name: str, count: int) -> Iterator[tuple[str, Inputs]]:
    """The first frames of a set."""
    number = None if name == "kitti_dc" else 500
    for frame in islice(SETS[name](data), count):
        yield frame.name, drawn_inputs(frame, number, seed=0)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--set", choices=SETS, default="icl_nuim")
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--model", default="compact")
    args = parser.parse_args()
    networks = {name: load_network(args.model, None, precision=name) for name in PRECISIONS}
    definition = networks["fp32"].definition
    layer = resolve_layer(definition, None)
    settings = resolve_settings(definition, MethodOptions())
    print("| frame | plain fp32 | plain bf16 | change | refined fp32 | refined bf16 | change |")
    print("|" + "---|" * 7)
    frames = real(args.data, args.set, args.frames) if args.data else samples()
    total = {(p, depths): 0.0 for p in PRECISIONS for depths in DEPTHS}
    for name, inputs in frames:
        assert inputs.gt is not None
        gt = torch.from_numpy(inputs.gt)
        results = {p: refined_frame(networks[p], layer, settings, inputs) for p in PRECISIONS}
        cells = []
        for depths in DEPTHS:
            maes = [
                score(torch.from_numpy(getattr(results[p], depths)), gt).mae for p in PRECISIONS
            ]
            cells += compared(*maes)
            for precision, mae in zip(PRECISIONS, maes, strict=True):
                total[precision, depths] += mae
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    cells = [c for depths in DEPTHS for c in compared(*(total[p, depths] for p in PRECISIONS))]
    print("| sum | " + " | ".join(cells) + " |")


def compared(full: float, low: float) -> list[str]:
    """Both, and how much more the second is."""
    return [f"{full:.5f}", f"{low:.5f}", f"{100 * (low / full - 1):+.3f} %"]


if __name__ == "__main__":
    main()
