"""Each protocol of the completion papers on a made-up data set: frames, points, scored pixels."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.eval import evaluate
from pnpdepth_cli.commands.evaluation.scoring import scores_of
from pnpdepth_cli.commands.many_frames.find_frames import find_frames, request_of
from pnpdepth_cli.commands.refinement.requested import read_requested
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.protocols import PROTOCOLS, FramePart
from pnpdepth_cli.sensors.projection import behind_foreground
from tests.builders import result_record
from tests.commands.predictions import code_image, depth_file
from tests.data_sets import SELECTED, codes, eth3d, ibims, image, void

KITTI = (352, 1216)


def nyu(root: Path) -> None:
    for name in ("0001", "0009"):
        image(root / f"image/{name}.png", 480, 640)
        depth_file(root / f"depth/{name}.npy", np.full((480, 640), 2.0))


def scannet(root: Path) -> None:
    image(root / "scene0707_00/color/0.jpg", 480, 640)
    codes(root / "scene0707_00/depth/0.png", 2000, 480, 640)
    (root / "scene0707_00/intrinsic").mkdir()


def kitti(root: Path) -> None:
    """A frame with points in 20 m on every 4th pixel of every 4th row, and one point in 5 m."""
    truth = np.zeros(KITTI, np.uint16)
    points = np.zeros(KITTI, np.uint16)
    truth[100:] = points[100::4, ::4] = 20 * 256
    points[201, 601] = 5 * 256
    image(root / f"image/{SELECTED.format('image')}.png", *KITTI)
    for kind, values in (("groundtruth_depth", truth), ("velodyne_raw", points)):
        code_image(root / kind / f"{SELECTED.format(kind)}.png", values)
    (root / "intrinsics").mkdir()
    text = " ".join(map(str, (700, 0, 608, 0, 700, 176, 0, 0, 1)))
    (root / f"intrinsics/{SELECTED.format('image')}.txt").write_text(text)


# by protocol: the data set, its frames, the points and the scored pixels of each frame
BY_HAND: dict[str, tuple[Callable[[Path], None], int, int, int]] = {
    "marigold-dc-nyu": (nyu, 2, 500, 304 * 228),
    "omni-dc-nyu": (nyu, 2, 500, 304 * 228),
    "marigold-dc-ibims": (partial(ibims, height=480, width=640), 1, 1000, 480 * 320),
    "marigold-dc-scannet": (scannet, 1, 500, 480 * 640),
    "marigold-dc-void": (void, 1, 6 * 8, 24 * 32),
    # the near point stays, and removes the four around it
    "marigold-dc-lidar": (kitti, 1, 63 * 304 + 1 - 4, 252 * 1216),
    "omni-dc-kitti": (kitti, 1, 63 * 304 + 1, 252 * 1216),
    "omni-dc-eth3d": (partial(eth3d, height=3840, width=5120), 1, 2150, 480 * 320),
    # input points are excluded
    "capa-100": (scannet, 1, 100, 480 * 640 - 100),
    "streamtto-rings": (scannet, 1, 8 * 640, 472 * 640),
    "streamtto-pixels": (scannet, 1, 48 * 640, 432 * 640),
}


def read_as_batch(root: Path, protocol: str) -> dict[str, Frame]:
    """The frames of a data set by name, as `batch` reads them."""
    request = BatchRequest(
        source=root, output=root / "out", refine=RefineRequest(), protocol=protocol
    )
    frames = find_frames(request).chosen
    return {frame.name: read_requested(request_of(request, frame)) for frame in frames}


SLOW = {"omni-dc-eth3d": pytest.mark.slow}  # it has 20 megapixels


@pytest.mark.parametrize("name", [pytest.param(n, marks=SLOW.get(n, ())) for n in BY_HAND])
def test_frames_points_and_scored_pixels_are_those_of_the_paper(name: str, tmp_path: Path) -> None:
    maker, frames, points, pixels = BY_HAND[name]
    root = tmp_path / "data"
    maker(root)
    read = read_as_batch(root, name)
    assert [len(frame_read.points) for frame_read in read.values()] == [points] * frames
    for frame, frame_read in read.items():
        depth_file(tmp_path / "out" / f"{frame}_depth.npy", np.full(frame_read.gt.shape, 2.0))
        height, width = frame_read.gt.shape
        result = result_record(size=(width, height))
        record = FrameRecord(inputs={"sparse": frame_read.sources["sparse"]}, result=result)
        record.write(tmp_path / "out" / f"{frame}.json")
    found = evaluate(EvalRequest(prediction=tmp_path / "out", ground_truth=root, protocol=name))
    assert [scores_of(frame)["pixels"] for frame in found.frames] == [pixels] * frames


def test_every_protocol_of_a_completion_paper_is_worked_out() -> None:
    own = {"paper", "whole", "nyu", "kitti-odometry", "kitti", "kitti-devkit"}
    assert PROTOCOLS.keys() - {*own, "nyu-eigen", "eigen", "garg"} == BY_HAND.keys()


def test_blocks_of_pixels_are_averaged_over_those_with_depth() -> None:
    part = FramePart(blocks=2, crop=(1, 2))
    depth = np.array([[1, 3, 0, 0, 9], [0, 5, 0, 0, 9], [9, 9, 9, 9, 9]], np.float32)
    assert part.apply(depth).tolist() == [[3, 0]]
    image = np.stack([depth] * 3, axis=2)
    assert part.apply(image)[0, :, 0].tolist() == [9 / 4, 0]
    xy = np.array([[0.5, 0.5], [2, 0], [4, 0]], np.float32)
    inside = part.points_in_crop(SparsePoints(xy=xy, depth=xy[:, 0], size=(3, 5)))
    assert inside.xy.tolist() == [[0, 0], [0.75, -0.25]]
    assert inside.size == (1, 2)


def test_the_points_of_ibims_are_those_that_marigold_dc_draws(tmp_path: Path) -> None:
    ibims(tmp_path, 480, 640)
    known = np.zeros((480, 640), bool)
    known[:, :320] = True
    pixels = np.argwhere(known)
    np.random.seed(2024)  # as the paper's code draws them
    np.random.shuffle(pixels)
    expected = {(x, y) for y, x in pixels[:1000].tolist()}
    (read,) = read_as_batch(tmp_path, "marigold-dc-ibims").values()
    assert {(int(x), int(y)) for x, y in read.points.xy.tolist()} == expected


def test_points_behind_the_foreground_are_those_of_two_windows() -> None:
    rng = np.random.default_rng(0)
    rows, columns = np.nonzero(rng.random((30, 40)) < 0.3)
    values = rng.uniform(2, 12, len(rows)).astype(np.float32)
    points = SparsePoints(
        xy=np.stack([columns, rows], axis=1).astype(np.float32), depth=values, size=(30, 40)
    )
    near = (abs(rows[:, None] - rows) <= 3) & (abs(columns[:, None] - columns) <= 3)
    lowest = np.array([values[window].min() for window in near])
    expected = [
        depths - lowest[window].min() > 1.5 for window, depths in zip(near, values, strict=True)
    ]
    assert behind_foreground(points, 7, 1.5).tolist() == expected
    assert 0 < sum(expected) < len(values)
