"""The embedded network on real frames: `python -m benchmarks.compact --data PATH [--seeds 1]`.

Per set and number of points: nearest and linear interpolation of the points, the network's plain
prediction, and refinement with the definition's defaults; the same points and the same pixels
(all with known ground truth) for each. Mean over frames of the per-frame MAE and RMSE.

With `--fusion` only the network's plain prediction is measured: with the depth of another network
as prior (`--prior`), with an unrelated prior, and with 20 % outliers among the points: all points
are given, or those that look like outliers are left out, or all outliers.

Images are moved into the frame of the points as `refine` does (`--registration frame`), as `batch`
does for a set (`set`), or not at all (`off`). KITTI is measured with all points of its LiDAR, and
without those that `refine` drops as occluded from the camera.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.frames import (
    REGISTRATIONS,
    SETS,
    EvalFrame,
    drawn_inputs,
    frame_pixels,
    nyu,
    points_on_grid,
    refined,
    registered,
    without_occluded,
)
from model_zoo_defs.training.learning.patterns import outliers
from model_zoo_defs.training.learning.priors import nonsense
from model_zoo_defs.training.learning.train_inliers import INLIER_ERROR
from pnpdepth_cli.completion.alignment import aligned
from pnpdepth_cli.completion.interpolation import linear, nearest
from pnpdepth_cli.completion.outliers import outliers as suspected
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings as Refinement

CELLS = (
    ("7scenes", 500),
    ("7scenes", 100),
    ("7scenes", 20),
    ("icl_nuim", 500),
    ("icl_nuim", 100),
    ("icl_nuim", 20),
    ("nyu", 500),
    ("nyu", 100),
    ("nyu", 20),
    ("kitti_dc", None),
    ("kitti_dc without occluded", None),
)
FEW = {"nyu": nyu}
"""Sets of so few frames that all are taken."""
METHODS = ("nearest", "linear", "plain", "refined")
OUTLIER_DRAWS = 4
"""Sets of outliers per frame, each of one of four kinds, drawn at random."""


@dataclass(frozen=True)
class Settings:
    """Options of `pnpdepth refine`."""

    layer: str | None
    iterations: int | None
    lr: str | None
    update: str | None


def measure_frame(
    network: Network, frame: EvalFrame, count: int | None, seed: int, settings: Settings
) -> dict[str, tuple[float, float]]:
    """(MAE, RMSE) of every method on one frame."""
    inputs = drawn_inputs(frame, count, seed)
    points = inputs.points
    method = Refinement(iterations=settings.iterations, lr=settings.lr, update=settings.update)
    result = refined(
        network,
        resolve_layer(network.definition, settings.layer),
        resolve_settings(network.definition, method),
        inputs,
    )
    depths = {
        "nearest": nearest(points),
        "linear": linear(points),
        "plain": torch.from_numpy(result.before),
        "refined": torch.from_numpy(result.after),
    }
    ground_truth = torch.from_numpy(frame.gt)
    scores = {name: score(depth, ground_truth) for name, depth in depths.items()}
    return {name: (s.mae, s.rmse) for name, s in scores.items()}


def measure_cell(
    network: Network,
    frames: Sequence[EvalFrame],
    count: int | None,
    seeds: int,
    settings: Settings,
    registration: str,
) -> dict[str, float]:
    """Means over frames and seeds, gains over linear in per cent, and wins."""
    results = [
        measure_frame(network, frame, count, seed, settings)
        for seed in range(seeds if count is not None else 1)
        for frame in registered(frames, count, seed, registration)
    ]
    row: dict[str, float] = {"frames": len(results)}
    for number, measure in enumerate(("MAE", "RMSE")):
        table = np.array([[result[method][number] for method in METHODS] for result in results])
        mean = dict(zip(METHODS, table.mean(axis=0), strict=True))
        row |= {f"{measure} {method}": float(value) for method, value in mean.items()}
        row[f"{measure} refined vs linear %"] = 100 * (mean["refined"] / mean["linear"] - 1)
        row[f"{measure} refined vs plain %"] = 100 * (mean["refined"] / mean["plain"] - 1)
        row[f"{measure} wins over linear"] = float((table[:, 3] < table[:, 1]).mean())
    return row


def measure_fusion(
    network: Network, prior: Network | None, frame: EvalFrame, count: int | None, number: int
) -> dict[str, tuple[float, float]]:
    """(MAE, RMSE) of the plain prediction with and without priors and outliers.

    number: of the frame in its set; the useless prior and the outliers depend on it.
    """
    rows, columns, depth = frame_pixels(frame, count, 0)
    shape = frame.gt.shape
    points = points_on_grid(rows, columns, depth, shape)
    rgb = torch.from_numpy(frame.rgb).permute(2, 0, 1)[None]
    rng = np.random.default_rng((0, number))
    sparse = np.zeros_like(frame.gt)
    sparse[rows, columns] = depth
    useless = torch.from_numpy(nonsense(rng, shape, frame.gt[::-1, ::-1].copy()))
    depths = {
        "linear": [linear(points)],
        "plain": [predicted(network, rgb, points)],
        "useless prior": [predicted(network, rgb, points, aligned(useless, points, kind="median"))],
    }
    if prior is not None:
        dense = aligned(predicted(prior, rgb, points), points, kind="median")
        depths |= {"prior alone": [dense], "with prior": [predicted(network, rgb, points, dense)]}
    for _ in range(OUTLIER_DRAWS):
        wrong = outliers(rng, sparse, 0.2)[rows, columns]
        for name, one in depths_with_outliers(
            network, rgb, points, points_on_grid(rows, columns, wrong, shape)
        ).items():
            depths.setdefault(name, []).append(one)
    ground_truth = torch.from_numpy(frame.gt)
    scores = {name: [score(one, ground_truth) for one in each] for name, each in depths.items()}
    return {
        name: (float(np.mean([s.mae for s in each])), float(np.mean([s.rmse for s in each])))
        for name, each in scores.items()
    }


def depths_with_outliers(
    network: Network, rgb: Tensor, points: SparsePoints, with_outliers: SparsePoints
) -> dict[str, Tensor]:
    """Depths (H, W) from all of these points, and without those that are or look like outliers."""
    followed = predicted(network, rgb, with_outliers)
    fewer = with_outliers.select(~suspected(followed, with_outliers, rgb[0]))
    error = (torch.log(with_outliers.depth) - torch.log(points.depth)).abs()
    inliers = points.select(error < INLIER_ERROR)
    return {
        "20 % outliers": followed,
        "20 % outliers, suspected ones left out": predicted(network, rgb, fewer),
        "20 % outliers, known and left out": predicted(network, rgb, inliers),
        "linear, 20 % outliers": linear(with_outliers),
        "linear, suspected ones left out": linear(fewer),
    }


@torch.no_grad()
def predicted(
    network: Network, rgb: Tensor, points: SparsePoints, prior: Tensor | None = None
) -> Tensor:
    """The network's prediction (H, W) in metres.

    Args:
        network: The network.
        rgb: The image (1, 3, H, W) in 0..1.
        points: Points in the image frame.
        prior: A third argument (H, W) in metres.
    """
    frame = FrameMap.fit(network.definition.size, *points.size)
    arguments = network.arguments(frame, rgb, frame.points_to_network(points))
    if prior is not None:
        size = arguments[0].shape[-2:]
        arguments += (F.interpolate(prior[None, None], size, mode="bilinear"),)
    return frame.depth_to_image(network.depth_of(network.module(*arguments)))


def print_fusion(
    network: Network,
    prior: Network | None,
    cell: str,
    frames: Sequence[EvalFrame],
    count: int | None,
) -> None:
    """Prints rows of a Markdown table, one per variant of the input."""
    results = [
        measure_fusion(network, prior, frame, count, number) for number, frame in enumerate(frames)
    ]
    for name in results[0]:
        mae, rmse = np.array([result[name] for result in results]).mean(0)
        print(f"| {cell} | {len(frames)} | {name} | {mae:.4f} | {rmse:.4f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", default="compact")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--every", type=int, default=1, help="use every n-th frame")
    parser.add_argument("--first", type=int, default=0, help="number of the first frame")
    parser.add_argument("--fusion", action="store_true", help="priors and outliers instead")
    parser.add_argument("--prior", help="network whose prediction is the prior of --fusion")
    parser.add_argument("--registration", choices=REGISTRATIONS, default="frame")
    parser.add_argument("--layer")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--lr")
    parser.add_argument("--update")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    network = load_network(args.model, args.checkpoint)
    settings = Settings(args.layer, args.iterations, args.lr, args.update)
    prior = load_network(args.prior, None) if args.prior else None
    table = {}
    for name, count in CELLS:
        if name in FEW:
            frames = list(FEW[name](args.data))
        else:
            frames = list(SETS[name.split()[0]](args.data))[args.first :: args.every]
        if name.endswith("without occluded"):
            frames = [without_occluded(frame) for frame in frames]
        cell = f"{name}, {count} points" if count else f"{name}, its LiDAR"
        if args.fusion:
            moved = registered(frames, count, 0, args.registration)
            print_fusion(network, prior, cell, moved, count)
            continue
        table[cell] = measure_cell(network, frames, count, args.seeds, settings, args.registration)
        if not args.json:
            print_row(cell, table[cell], header=len(table) == 1)
    if args.json:
        print(json.dumps(table, indent=2))


def print_row(cell: str, row: dict[str, float], *, header: bool) -> None:
    """One line of a Markdown table, flushed, so that a long run can be watched."""
    if header:
        print("| set | " + " | ".join(row) + " |")
        print("|" + "---|" * (len(row) + 1))
    print(f"| {cell} | " + " | ".join(f"{value:.4g}" for value in row.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
