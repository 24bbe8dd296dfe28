"""Starts taken over from frame to frame: `python -m benchmarks.warm_start --data PATH`.

MAE in metres and CPU seconds a frame over the number of updates, for frames refined alone and for
windows, of z (`--target given`) or of weights by hidden points (`--target masked`); and flicker,
the change of the error from frame to frame at the same pixel, in metres. The first frame of the
window, which has no start to take, is left out. KITTI raw is scored at a fifth of the own points
that is held out, the other sets at their ground truth. Nothing was chosen on these frames.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.accuracy import opened
from benchmarks.frames import SETS, drawn_inputs
from benchmarks.sequences import inputs_of, of_used, split
from pnpdepth_cli.frames.frame import Frame, WarmStart, is_dense
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.frames.warm_start import refine_next
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame
from pnpdepth_cli.pipeline.evaluation.measures.flicker import flicker
from pnpdepth_cli.settings import Settings

KITTI = "kitti_raw"
Depth = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A frame, and what it is scored on."""

    frame: Frame
    """Image and points."""
    gt: Depth
    """(H, W) metres, 0 = unknown."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A sequence refined in one manner."""

    mae: float
    """Mean over the frames, metres."""
    flicker: float
    """Mean over the pairs of frames, metres."""
    cpu_s: float
    """A frame."""
    taken: int
    """Frames that took the start of the one before."""


def cases(data: Path, name: str, count: int, frames: int, seed: int, reach: int) -> Iterator[Case]:
    """Yields consecutive frames of a set."""
    if name != KITTI:
        for each in list(SETS[name](data))[:frames]:
            yield Case(frame=drawn_inputs(each, count, seed), gt=each.gt)
        return
    for inputs in inputs_of(data, reach)[:frames]:
        used, held = split(inputs.own, "points", seed)
        yield Case(frame=of_used(inputs, used), gt=held.scatter()[0, 0].numpy())


def refined(network: Network, method: Settings, sequence: Sequence[Case], *, warm: bool) -> Row:
    """Returns how a sequence comes out, in one window or frame by frame."""
    dense = is_dense(sequence[0].frame.points)
    settings = resolve_settings(network.definition, method, dense=dense)
    layer = resolve_layer(network.definition, method.layer)
    depths, seconds, taken, carried = [], [], 0, WarmStart()
    with network.cut_at_points() if settings.masked else network.cut_at(layer) as split_:
        for case in sequence:
            start = time.process_time()
            if warm:
                frame = refine_next(network, split_, settings, case.frame, carried)
                carried, taken = frame.carried or WarmStart(), taken + frame.refinement.warm
            else:
                frame = refine_frame(network, split_, settings, case.frame)
            seconds.append(time.process_time() - start)
            depths.append(frame.after)
    measured = [
        MeasuredFrame(depth=depth, gt=case.gt) for case, depth in zip(sequence, depths, strict=True)
    ]
    errors = [float(np.abs(m.depth - m.gt)[m.both].mean()) for m in measured[1:]]
    changes = [
        flicker(replace(after, previous=before))["flicker"]
        for before, after in itertools.pairwise(measured)
    ]
    return Row(
        mae=float(np.mean(errors)), flicker=float(np.mean(changes)),
        cpu_s=float(np.mean(seconds[1:])), taken=taken,
    )  # fmt: skip


def interval(ratios: Sequence[float]) -> str:
    """The mean change in per cent with its 95 % interval over seeds (Student's t)."""
    from scipy.stats import t

    mean, count = float(np.mean(ratios)) - 1, len(ratios)
    if count < 2:
        return f"{mean:+.1%}"
    half = t.ppf(0.975, count - 1) * float(np.std(ratios, ddof=1)) / math.sqrt(count)
    return f"{mean:+.1%} ± {half:.1%}"


def main() -> None:
    """Measure, and print a row for every number of updates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--set", choices=(KITTI, *SETS), default=KITTI)
    parser.add_argument("--model", default="sparse2dense-tiny-kitti")
    parser.add_argument("--target", default="given")
    parser.add_argument("--points", type=int, default=500)
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--iterations", type=int, nargs="+", default=[5, 10])
    parser.add_argument("--accumulate", type=int, default=0)
    args = parser.parse_args()
    network = opened(args.model, args.data)
    print(
        "| updates | seeds | alone: MAE | flicker | CPU s | window: MAE | change | flicker |"
        " CPU s | taken |"
    )
    print("|" + "---|" * 10)
    for count in args.iterations:
        method = Settings(iterations=count, target=args.target)
        alone, window = [], []
        for seed in args.seeds:
            sequence = list(
                cases(args.data, args.set, args.points, args.frames, seed, args.accumulate)
            )
            torch.manual_seed(0)
            alone.append(refined(network, method, sequence, warm=False))
            window.append(refined(network, method, sequence, warm=True))
        ratios = [b.mae / a.mae for a, b in zip(alone, window, strict=True)]
        cells = (
            *(count, len(args.seeds), *_means(alone), _means(window)[0], interval(ratios)),
            *(*_means(window)[1:], f"{np.mean([row.taken for row in window]):.1f}"),
        )
        print(f"| {' | '.join(map(str, cells))} |", flush=True)


def _means(rows: Sequence[Row]) -> tuple[str, str, str]:
    mae, change, cpu_s = (
        float(np.mean([getattr(row, name) for row in rows])) for name in ("mae", "flicker", "cpu_s")
    )
    return f"{mae:.3f}", f"{change:.3f}", f"{cpu_s:.1f}"


if __name__ == "__main__":
    main()
