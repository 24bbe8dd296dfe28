"""Which folds rank methods as the ground truth does: python -m benchmarks.scan_line_folds DATA.

On KITTI's projected LiDAR maps: baselines and `compact`, scored at one fold of held-out points and
against the accumulated ground truth, with folds of whole scan lines and of image cells.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from pnpdepth_cli.auto import cross_validation
from scipy.stats import kendalltau
from torch import Tensor

from benchmarks.frames import (
    EvalFrame,
    frame_inputs,
    frame_pixels,
    kitti_dc,
    points_on_grid,
    without_occluded,
)
from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement.request import MethodOptions
from pnpdepth_cli.pipeline.refinement.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.points import SparsePoints

INTERPOLATIONS = ("linear", "nearest", "linear-log", "idw", "morphological")
FOLDS = 4


def depths(network: Network, frame: EvalFrame, points: SparsePoints) -> Iterator[Tensor]:
    """Depth (H, W) of each method, linear interpolation first."""
    for name in INTERPOLATIONS:
        yield BASELINES[name].depth(points, None)
    settings = resolve_settings(network.definition, MethodOptions())
    inputs = frame_inputs(frame.rgb, points, frame.gt)
    with network.cut_at(resolve_layer(network.definition, None)) as split:
        result = refine_frame(network, split, settings, inputs.frame())
    yield torch.from_numpy(result.before)
    yield torch.from_numpy(result.after)


def held_out_errors(
    network: Network, frame: EvalFrame, points: SparsePoints, *, lines: bool
) -> list[float]:
    """Mean absolute error of each method at the first fold, weighted as the default choice does."""
    if lines:
        fold = cross_validation.spatial_folds(points, FOLDS)
    else:
        with patch.object(cross_validation, "scan_lines", lambda xy, size: None):
            fold = cross_validation.spatial_folds(points, FOLDS)
    kept, held = points.select(fold != 0), points.select(fold == 0)
    predicted = torch.stack([held.sample(depth) for depth in depths(network, frame, kept)])
    weights = inlier_weights(held, held.depth.double().log() - predicted[0].double().log()).float()
    return (((predicted - held.depth).abs() * weights).sum(dim=1) / weights.sum()).tolist()


def main() -> None:
    """Print a line for each half of the frames and each kind of folds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with kitti_dc")
    network = load_network("compact", None, "cpu")
    rows: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for number, frame in enumerate(kitti_dc(parser.parse_args().data)):
        visible = without_occluded(frame)
        points = points_on_grid(*frame_pixels(visible, None, 0), frame.gt.shape)
        gt = torch.from_numpy(frame.gt)
        known = gt > 0
        gt_errors = [
            float((depth - gt)[known].abs().mean()) for depth in depths(network, frame, points)
        ]
        for kind in ("lines", "cells"):
            errors = held_out_errors(network, frame, points, lines=kind == "lines")
            excess = gt_errors[int(np.argmin(errors))] / min(gt_errors) - 1
            key = ("odd" if number % 2 else "even", kind)
            rows.setdefault(key, []).append((kendalltau(errors, gt_errors)[0], excess))
    for (half, kind), values in rows.items():
        correlation, excess = np.mean(values, axis=0)
        print(
            f"{len(values)} {half} frames, folds of {kind}: Kendall's tau {correlation:.2f},"
            f" MAE of the one ranked first {excess:.1%} above the best one's"
        )


if __name__ == "__main__":
    main()
