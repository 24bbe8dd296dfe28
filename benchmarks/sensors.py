"""Evidence for the sensors: python -m benchmarks.sensors DATA, DATA the folder of real frames.

Projection against rendered ground truth (samples/street), the occlusion filter against KITTI's
accumulated ground truth, of scans and of projected maps, the fractions of samples of the paper's
LiDARs, and the time of a projection. Without DATA, only what the samples can show.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.frames import (
    drawn_inputs,
    kitti_dc,
    refined,
    without_occluded,
)
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.pipeline.sparse.scans import camera_of
from pnpdepth_cli.sensors import (
    FORWARD_LEFT_UP,
    LIDARS,
    Camera,
    ProjectionSettings,
    project_velodyne,
    simulate_lidar,
)
from pnpdepth_cli.sensors.projection import hidden_points
from pnpdepth_cli.settings import Settings

STREET = Path(__file__).parent.parent / "samples" / "street"
KEEP_ALL = ProjectionSettings(keep_occluded=True)

# Wang et al. 2019, table on LiDAR types: per cent of the pixels of a SYNTHIA frame.
PAPER_PERCENT = {"vlp-16": 5.3, "vlp-32c": 28.8, "hdl-32e": 10.3, "hdl-64e": 18.7}

# SYNTHIA's sequences are 1280×760 with a focal length of 532.74; here at 0.4 of that size.
SYNTHIA = Camera(
    intrinsics=np.array([[213.1, 0, 255.5], [0, 213.1, 151.5], [0, 0, 1]]),
    rotation=FORWARD_LEFT_UP,
)
SYNTHIA_SIZE = (304, 512)

Floats = NDArray[np.floating]


def agreement(hidden: NDArray[np.bool_], depth: Floats, gt: Floats) -> str:
    """Fractions of points kept if they agree with ground truth within 10 %, else removed."""
    known = gt > 0
    agrees = np.abs(depth[known] - gt[known]) <= 0.1 * gt[known]
    gone = hidden[known]
    return (
        f"{agrees.sum():,} points agree with the ground truth,"
        f" {np.mean(~gone[agrees]):.1%} of them kept; {(~agrees).sum():,} do not,"
        f" {np.mean(gone[~agrees]):.1%} of them removed"
    )


def street() -> None:
    """The rendered scan, whose ground truth is exact and dense."""
    camera = camera_of(read_calibration(STREET / "calib.txt"))
    scan = read_scan(STREET / "000000.bin").points
    gt = read_depth(STREET / "gt.png").values
    points = project_velodyne(scan, camera, gt.shape, KEEP_ALL)
    column, row = np.floor(points.xy + 0.5).astype(int).T
    there = gt[row, column]
    error = np.abs(points.depth - there)[there > 0]
    print(f"samples/street, {len(points.depth):,} points: median error {np.median(error):.3f} m")
    kept = project_velodyne(scan, camera, gt.shape).index
    print("  filter:", agreement(~np.isin(points.index, kept), points.depth, there))


def kitti(data: Path) -> None:
    """Single scans, projected by the data set, against ground truth of eleven accumulated scans."""
    folder = data / "kitti_dc"
    calibration = read_calibration(folder)
    hidden, depth, gt = [], [], []
    for path in sorted((folder / "velodyne_raw").glob("*.png")):
        raw = read_depth(path).values
        row, column = np.nonzero(raw)
        depth.append(raw[row, column].astype(np.float64))
        gt.append(read_depth(folder / "groundtruth" / path.name).values[row, column])
        hidden.append(
            hidden_points(
                np.column_stack([column, row]).astype(np.float64),
                depth[-1],
                (raw.shape[0], raw.shape[1]),
                focal_px=float(calibration.intrinsics[0, 0]),
                scanner=calibration.intrinsics @ calibration.translation,
            )
        )
    joined = [np.concatenate(x) for x in (hidden, depth, gt)]
    print(f"kitti_dc, {len(hidden)} frames, {len(joined[0]):,} points")
    print(f"  filter: {agreement(*joined)}; {joined[0].mean():.1%} of all removed")


def projected_maps(data: Path) -> None:
    """MAE on KITTI's projected maps as they are and without occluded points, per half of them."""
    network = load_network("compact", None, "cpu")
    layer = resolve_layer(network.definition, None)
    settings = resolve_settings(network.definition, Settings())
    errors: dict[str, list[list[float]]] = {"even": [], "odd": []}
    for number, frame in enumerate(kitti_dc(data)):
        ground_truth = torch.from_numpy(frame.gt)
        row = []
        for given in (frame, without_occluded(frame)):
            inputs = drawn_inputs(given, None, 0)
            result = refined(network, layer, settings, inputs)
            for depth in (linear(inputs.points), torch.from_numpy(result.after)):
                row.append(score(depth, ground_truth).mae)
        errors["odd" if number % 2 else "even"].append(row)
    for half, rows in errors.items():
        means = np.mean(rows, axis=0)
        print(
            f"kitti_dc, {len(rows)} {half} frames, MAE in m with all points / without occluded:"
            f" linear {means[0]:.3f} / {means[2]:.3f}, compact {means[1]:.3f} / {means[3]:.3f}"
        )


def fractions() -> None:
    """The paper's LiDARs in SYNTHIA's view of a scene without holes."""
    depth = np.full(SYNTHIA_SIZE, 10.0)
    print("samples, % of SYNTHIA's pixels: ours (the paper's)")
    for name, percent in PAPER_PERCENT.items():
        got = [
            len(simulate_lidar(depth, SYNTHIA, LIDARS[f"paper-{name}"], seed).depth)
            for seed in range(3)
        ]
        print(f"  paper-{name:8} {100 * statistics.mean(got) / depth.size:5.1f} ({percent})")


def speed(data: Path, runs: int) -> None:
    """One projection of a whole KITTI scan, with and without the filter."""
    folder = data / "kitti_object"
    camera = camera_of(read_calibration(folder / "calib" / "000001.txt"))
    scan = read_scan(folder / "velodyne" / "000001.bin").points
    for name, settings in (("with filter", None), ("without", KEEP_ALL)):
        wall, processor = [], []
        for _ in range(runs):
            start, start_processor = time.perf_counter(), time.process_time()
            project_velodyne(scan, camera, (375, 1242), settings)
            wall.append(1000 * (time.perf_counter() - start))
            processor.append(1000 * (time.process_time() - start_processor))
        print(
            f"projection of {len(scan):,} points, {name}: median {statistics.median(wall):.0f} ms,"
            f" {statistics.median(processor):.0f} ms of processor time"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, nargs="?", help="folder with kitti_dc, kitti_object")
    parser.add_argument("--runs", type=int, default=15)
    args = parser.parse_args()
    street()
    fractions()
    if args.data is not None:
        kitti(args.data)
        projected_maps(args.data)
        speed(args.data, args.runs)


if __name__ == "__main__":
    main()
