"""Refinement by hidden points against plain and the paper's.

Usage: `python -m benchmarks.masked --data PATH`. MAE and RMSE in metres over the pixels with known
ground truth, CPU seconds of a refinement, steps that were kept, and the fraction of frames whose
MAE is above the plain one's by more than 1 %. Points are drawn from the ground truth; KITTI's are
its own LiDAR's. Every second frame is measured, from the second on: the constants were chosen on
the others and on rendered frames.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.frames import SETS, frame_inputs, frame_pixels, points_on_grid
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.frames.refine import refine_frame, with_propagation
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.request import HoldOut, MethodOptions
from pnpdepth_cli.pipeline.refinement.resolve import is_dense, resolve_layer, resolve_settings
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import occluded_in_map

_OUTLIER_FACTORS = (0.3, 3.0)
"""Range of the factor on the depth of outliers."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method on one frame."""

    mae: float
    """Metres."""
    rmse: float
    """Metres."""
    seconds: float
    """CPU time of the refinement."""
    kept: int
    """Updates that the depth was predicted after."""


def inputs_of(
    data: Path, name: str, count: int | None, seed: int, *, frames: int, outlier_fraction: float
) -> Iterator[Inputs]:
    """Yields evenly spaced frames among every second one, with this seed's points."""
    every_second = list(SETS[name](data))[1::2]
    chosen = np.unique(np.linspace(0, len(every_second) - 1, frames).round().astype(int))
    for frame in (every_second[index] for index in chosen):
        rows, columns, depth = frame_pixels(frame, count, seed)
        rng = np.random.default_rng(seed)
        outlier = rng.random(len(depth)) < outlier_fraction
        factors = np.exp(rng.uniform(*np.log(_OUTLIER_FACTORS), len(depth)))
        depth = np.where(outlier, depth * factors, depth).astype(np.float32)
        points = points_on_grid(rows, columns, depth, frame.gt.shape)
        if count is None:  # as the program does with a projected scan
            xy, depth = points.xy.numpy(), points.depth.numpy()
            occluded = occluded_in_map(SparsePoints(xy=xy, depth=depth, size=points.size))
            points = points if occluded is None else points.select(torch.from_numpy(~occluded))
        yield frame_inputs(frame.rgb, points, frame.gt)


def measured(network: Network, method: MethodOptions, inputs: Inputs, seed: int) -> tuple[Row, Row]:
    """Returns the plain prediction's row and that of the refinement."""
    assert inputs.gt is not None
    gt, definition = torch.from_numpy(inputs.gt), network.definition
    settings = resolve_settings(
        definition, method, HoldOut(seed=seed), dense=is_dense(inputs.points)
    )
    layer = resolve_layer(definition, method.layer)
    start = time.process_time()
    with network.cut_at_points() if settings.masked else network.cut_at(layer) as split:
        frame = refine_frame(network, split, settings, inputs.frame())
    seconds = time.process_time() - start
    propagated = with_propagation(inputs.frame(), frame.after, "gp")
    seconds_propagated = time.process_time() - start
    plain, after, last = (
        score(torch.from_numpy(depth), gt) for depth in (frame.before, frame.after, propagated)
    )
    kept = frame.refinement.kept
    return (
        Row(mae=plain.mae, rmse=plain.rmse, seconds=0.0, kept=0),
        Row(mae=after.mae, rmse=after.rmse, seconds=seconds, kept=kept),
        Row(mae=last.mae, rmse=last.rmse, seconds=seconds_propagated, kept=kept),
    )


def methods(
    steps: list[int], lr: str | None = None, scale: float | None = None
) -> dict[str, MethodOptions]:
    """Returns what is compared, by the name in the table."""
    masked = MethodOptions(target="masked", lr=lr, mask_scale=scale)
    return {
        "paper's update": MethodOptions(),
        **{f"masked, {k} steps": replace(masked, iterations=k) for k in steps},
        "masked": masked,
    }


def main() -> None:
    """Measure and print one row for every method, set and number of points."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--points", nargs="+", type=int, default=[20, 100, 500])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=100, help="Of each set, at most.")
    parser.add_argument("--model", default="compact")
    parser.add_argument("--steps", nargs="*", type=int, default=[12, 40])
    parser.add_argument("--lr", help="Step size of the hidden points.")
    parser.add_argument("--scale", type=float, help="Of the image during their steps.")
    parser.add_argument("--only", nargs="*", help="Names of methods.")
    parser.add_argument(
        "--wrong", dest="outlier_fraction", type=float, default=0.0, help="Fraction of outliers."
    )
    args = parser.parse_args()
    network = load_network(args.model, None)
    print("| set, points | frames | method | MAE | RMSE | CPU s | kept | worse |")
    print("|" + "---|" * 8)
    for name in args.sets:
        for count in [None] if name == "kitti_dc" else args.points:
            _measure_set(args, network, name, count)


def _measure_set(args: argparse.Namespace, network: Network, name: str, count: int | None) -> None:
    cases = [
        (inputs, seed)
        for seed in range(args.seeds if count else 1)
        for inputs in inputs_of(
            args.data, name, count, seed, frames=args.frames, outlier_fraction=args.outlier_fraction
        )
    ]
    label = f"{name}, {count or 'LiDAR'}"
    shown_plain = False
    for title, method in methods(args.steps, args.lr, args.scale).items():
        if args.only and title not in args.only:
            continue
        rows = [measured(network, method, inputs, seed) for inputs, seed in cases]
        plain, refined, propagated = zip(*rows, strict=True)
        if not shown_plain:
            print(_line(label, "plain", plain, plain), flush=True)
            shown_plain = True
        print(_line(label, title, refined, plain), flush=True)
        print(_line(label, f"{title} + gp", propagated, plain), flush=True)


def _line(label: str, title: str, rows: Sequence[Row], plain: Sequence[Row]) -> str:
    mean = {
        name: float(np.mean([getattr(row, name) for row in rows]))
        for name in ("mae", "rmse", "seconds", "kept")
    }
    of_plain = {
        name: mean[name] / float(np.mean([getattr(row, name) for row in plain]))
        for name in ("mae", "rmse")
    }
    worse = np.mean([a.mae > 1.01 * b.mae for a, b in zip(rows, plain, strict=True)])
    errors = (f"{mean[name]:.4f} ({of_plain[name] - 1:+.1%})" for name in ("mae", "rmse"))
    cells = (label, len(rows), title, *errors, f"{mean['seconds']:.1f}", f"{mean['kept']:.0f}")
    return f"| {' | '.join(map(str, cells))} | {worse:.0%} |"


if __name__ == "__main__":
    main()
