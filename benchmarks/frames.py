"""Real frames for measuring: folders in the layout of the data's own README, or rendered ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.completion.image_registration import estimated, evidence
from pnpdepth_cli.frames.frame import Refined, tensor_of
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.batch.frames import registering
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import Points, occluded_in_map
from pnpdepth_cli.settings import Settings

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class EvalFrame:
    """rgb (H, W, 3) in 0..1, gt (H, W) metres with 0 unknown, sensor depth (H, W) or None."""

    name: str
    rgb: NDArray[np.float32]
    gt: Depth
    sensor: Depth | None = None


def seven_scenes(root: Path) -> Iterator[EvalFrame]:
    """Kinect frames of one kitchen; 0 and 65535 are unknown."""
    for path in sorted((root / "7scenes").glob("*.color.jpg")):
        depth = path.with_name(path.name.replace("color.jpg", "depth.png"))
        yield EvalFrame(path.stem, read_rgb(path).values, read_depth(depth, scale=1000).values)


def icl_nuim(root: Path) -> Iterator[EvalFrame]:
    """Frames of a rendered living room with perfect depth."""
    for path in sorted((root / "icl_nuim" / "image").glob("*.jpg")):
        depth = root / "icl_nuim" / "depth" / f"{path.stem}.png"
        yield EvalFrame(path.stem, read_rgb(path).values, read_depth(depth, scale=1000).values)


def kitti_dc(root: Path) -> Iterator[EvalFrame]:
    """Street frames with one LiDAR scan each and the accumulated ground truth."""
    folder = root / "kitti_dc"
    for path in sorted((folder / "image").glob("*.jpg")):
        gt, scan = (
            read_depth(folder / kind / f"{path.stem}.png", scale=256).values
            for kind in ("groundtruth", "velodyne_raw")
        )
        yield EvalFrame(path.stem, read_rgb(path).values, gt, scan)


def nyu(root: Path) -> Iterator[EvalFrame]:
    """Two Kinect frames of 224×224 and 480×640 pixels."""
    ready = (np.load(root / "nyu" / f"{name}.npy").squeeze() for name in ("rgb", "depth"))
    rgb, gt = (np.ascontiguousarray(values.astype(np.float32)) for values in ready)
    yield EvalFrame("nyu", rgb, gt)
    for path in sorted((root / "nyu" / "metric3d").glob("rgb_*.jpg")):
        depth = path.with_name(path.name.replace("rgb", "sync_depth")).with_suffix(".png")
        yield EvalFrame(path.stem, read_rgb(path).values, read_depth(depth, scale=1000).values)


def rgbd(folder: str, scale: float) -> Callable[[Path], Iterator[EvalFrame]]:
    """Returns the frames of a folder with `image/*.jpg` and `depth/*.png` of this scale."""

    def frames(root: Path) -> Iterator[EvalFrame]:
        for path in sorted((root / folder / "image").glob("*.jpg")):
            depth = root / folder / "depth" / f"{path.stem}.png"
            yield EvalFrame(path.stem, read_rgb(path).values, read_depth(depth, scale=scale).values)

    return frames


SETS = {
    "7scenes": seven_scenes,
    "icl_nuim": icl_nuim,
    "kitti_dc": kitti_dc,
}
MORE_SETS = {
    "tum_fr1_rpy": rgbd("tum_fr1_rpy", 5000),
    "tum_fr3_cabinet": rgbd("tum_fr3_cabinet", 5000),
    "realsense": rgbd("realsense_unregistered", 1000),
}
"""Sets on which nothing was chosen."""


def sampled(gt: Depth, count: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of `count` pixels with known ground truth, drawn uniformly."""
    rows, columns = np.nonzero(gt > 0)
    chosen = np.random.default_rng(seed).choice(len(rows), min(count, len(rows)), replace=False)
    return rows[chosen], columns[chosen]


def frame_pixels(
    frame: EvalFrame, count: int | None, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Depth]:
    """Rows, columns and depths of the sensor's points, or of `count` pixels of the ground truth."""
    if count is None:
        assert frame.sensor is not None
        rows, columns = np.nonzero(frame.sensor > 0)
        return rows, columns, frame.sensor[rows, columns]
    rows, columns = sampled(frame.gt, count, seed)
    return rows, columns, frame.gt[rows, columns]


def points_on_grid(
    rows: NDArray[np.int64], columns: NDArray[np.int64], depth: Depth, shape: tuple[int, int]
) -> SparsePoints:
    """The depths at these pixels as points of a frame of this shape."""
    xy = np.stack([columns, rows], axis=1).astype(np.float32)
    return SparsePoints(
        xy=torch.from_numpy(xy), depth=torch.from_numpy(depth.astype(np.float32)), size=shape
    )


def without_occluded(frame: EvalFrame) -> EvalFrame:
    """The frame without the LiDAR points that the program drops as occluded from the camera."""
    assert frame.sensor is not None
    rows, columns, depth = frame_pixels(frame, None, 0)
    xy = np.stack([columns, rows], axis=1).astype(np.float32)
    hidden = occluded_in_map(Points(xy=xy, depth=depth, size=frame.gt.shape))
    if hidden is None:
        return frame
    sensor = frame.sensor.copy()
    sensor[rows[hidden], columns[hidden]] = 0.0
    return replace(frame, sensor=sensor)


REGISTRATIONS = ("off", "frame", "set")
"""Images as they are, moved as `refine` moves each alone, and as `batch` moves those of a set."""


def registered(
    frames: Sequence[EvalFrame], count: int | None, seed: int, how: str
) -> list[EvalFrame]:
    """The frames with their images moved into the frame of these points, as the program does."""
    if how == "off":
        return list(frames)
    known = []
    for frame in frames:
        points = points_on_grid(*frame_pixels(frame, count, seed), frame.gt.shape)
        known.append(evidence(frame.rgb, points))
    if how == "set":
        found = [estimated(registering(known, 0))] * len(frames)
    else:
        found = [estimated([each]) for each in known]
    return [
        frame if one is None else replace(frame, rgb=one.applied(frame.rgb))
        for frame, one in zip(frames, found, strict=True)
    ]


def frame_inputs(rgb: NDArray[np.float32], points: SparsePoints, gt: Depth) -> Inputs:
    """A frame in memory, as the program reads one from files."""
    return Inputs(rgb=tensor_of(rgb), points=points, own=points, gt=gt)


def drawn_inputs(frame: EvalFrame, count: int | None, seed: int) -> Inputs:
    """The frame with points of its ground truth, or with all points of its LiDAR (None)."""
    points = points_on_grid(*frame_pixels(frame, count, seed), frame.gt.shape)
    return frame_inputs(frame.rgb, points, frame.gt)


def refined(network: Network, layer: str, settings: Settings, inputs: Inputs) -> Refined:
    """The refinement of a frame with all of its points."""
    with network.cut_at(layer) as split:
        return refine_frame(network, split, settings, inputs.registered())
