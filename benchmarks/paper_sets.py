"""The frames of `benchmarks.paper_tables`: rendered for it, or the real ones at hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.frames import SETS, Depth, EvalFrame, points_on_grid, sampled
from pnpdepth_cli.camera import Camera
from pnpdepth_cli.errors import NoPointsError, UsageError
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.protocols import NYU_PART, FramePart
from pnpdepth_cli.sensors.pixels import as_depth_image
from pnpdepth_cli.sensors.simulation import LIDARS, simulate_lidar

ROOM_LIMIT, STREET_LIMIT = 10.0, 80.0
"""Metres beyond which rendered ground truth counts as unknown: a Kinect's range, and KITTI's."""

SCANNER = LIDARS["hdl-64e"]
VIEWS = 4  # of one scene; frames are rendered a scene at a time


@dataclass(frozen=True, kw_only=True)
class TableFrame:
    """rgb (H, W, 3) in 0..1; depths (H, W) in metres, 0 = unknown.

    pool: the pixels that uniform points are drawn from. scan: a LiDAR's points on their pixels,
    None where there is none besides the ground truth.
    """

    rgb: NDArray[np.float32]
    gt: Depth
    pool: Depth
    scan: Depth | None = None

    def cut_by(self, part: FramePart) -> TableFrame:
        """What a protocol leaves of the frame."""
        return TableFrame(
            rgb=np.ascontiguousarray(part.apply(self.rgb)),
            gt=np.ascontiguousarray(part.apply(self.gt)),
            pool=part.apply(self.pool),
            scan=None if self.scan is None else part.apply(self.scan),
        )

    def points(self, count: int | None, seed: int) -> SparsePoints:
        """`count` pixels of the pool, or all of the scan; the same seed gives the same."""
        if count is None:
            assert self.scan is not None
            rows, columns = np.nonzero(self.scan)
            return points_on_grid(rows, columns, self.scan[rows, columns], self.scan.shape)
        rows, columns = sampled(self.pool, count, seed)
        if not len(rows):
            raise NoPointsError(f"frame {seed} has no pixel with known depth to draw points from")
        return points_on_grid(rows, columns, self.pool[rows, columns], self.pool.shape)


@dataclass(frozen=True, kw_only=True)
class FrameSet:
    """frames(): in a fixed order, `count` of them. street: for table II.

    beside_paper: its figures stand beside the paper's.
    """

    name: str
    street: bool
    count: int
    frames: Callable[[], Iterator[TableFrame]]
    beside_paper: bool = True


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """A kind of scene to render, and a seed that is used for these tables alone."""

    name: str
    camera: str
    kind: str
    size: tuple[int, int]
    seed: int
    limit: float

    def folder(self, cache: Path) -> Path:
        """Where the frames lie."""
        return cache / f"{self.kind}-{self.size[0]}x{self.size[1]}-seed{self.seed}"


ROOMS = Scenes(
    name="rendered rooms", camera="nyu", kind="room", size=(228, 304), seed=900041, limit=ROOM_LIMIT
)
STREETS = Scenes(
    name="rendered streets", camera="kitti", kind="street", size=(228, 912), seed=900022,
    limit=STREET_LIMIT,
)  # fmt: skip


def rendered(scenes: Scenes, cache: Path, count: int, workers: int) -> FrameSet:
    """`count` frames of these scenes; what of them is not in the cache is rendered first."""
    folder, files = scenes.folder(cache), -(-count // VIEWS)
    shards = [folder / f"shard_{number:05d}.npz" for number in range(files)]
    if not all(shard.exists() for shard in shards):
        _render(scenes, folder, files * VIEWS, workers)
    return FrameSet(
        name=scenes.name,
        street=scenes.kind == "street",
        count=count,
        frames=partial(_rendered_frames, scenes, shards, count),
    )


def _render(scenes: Scenes, folder: Path, count: int, workers: int) -> None:
    try:
        from model_zoo_defs.training.rendering.render import Job, render_all
    except ImportError as error:
        raise UsageError(f"rendering needs {error.name}: pip install 'pnpdepth[train]'") from error
    job = Job(
        out=folder,
        seed=scenes.seed,
        height=scenes.size[0],
        width=scenes.size[1],
        frames=count,
        shard_frames=VIEWS,
        kinds=(scenes.kind,),
        camera=scenes.camera,
    )
    render_all(job, workers=workers)


def _rendered_frames(scenes: Scenes, shards: list[Path], count: int) -> Iterator[TableFrame]:
    for first, path in zip(range(0, count, VIEWS), shards, strict=True):
        with np.load(path) as shard:
            views = list(zip(shard["rgb"], shard["depth"], shard["intrinsics"], strict=True))
        for number, (rgb, depth, lens) in enumerate(views[: count - first], start=first):
            gt = within(depth, scenes.limit)
            yield TableFrame(
                rgb=rgb.astype(np.float32) / 255,
                gt=gt,
                pool=gt,
                scan=scan_of(gt, lens, number) if scenes.kind == "street" else None,
            )


def within(depth: Depth, limit: float) -> Depth:
    """The depth map with what is beyond `limit` unknown."""
    return np.where(depth <= limit, depth, np.float32(0))


def scan_of(gt: Depth, lens: NDArray[np.float32], seed: int) -> Depth:
    """(H, W) one turn of 64 scan lines from the camera's place; lens: fx, fy, cx, cy in pixels."""
    fx, fy, cx, cy = (float(value) for value in lens)
    camera = Camera(intrinsics=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    return as_depth_image(simulate_lidar(gt, camera, SCANNER, seed))


def shared(root: Path, most: int) -> list[FrameSet]:
    """The real frames at hand, at most so many of each, evenly taken."""
    sets = []
    for name, read in SETS.items():
        every = [_shared_frame(frame) for frame in read(root)]
        if every:
            chosen = _evenly(every, most)
            sets.append(
                FrameSet(
                    name=name,
                    street=every[0].scan is not None,
                    count=len(chosen),
                    frames=partial(iter, chosen),
                    beside_paper=False,
                )
            )
    if not sets:
        raise UsageError(f"{root} holds none of {', '.join(SETS)}; check --shared")
    return sets


def _evenly(every: Sequence[TableFrame], most: int) -> list[TableFrame]:
    count = min(most, len(every))
    return [every[index] for index in np.linspace(0, len(every) - 1, count).astype(int)]


def _shared_frame(frame: EvalFrame) -> TableFrame:
    if frame.sensor is None:
        gt = within(frame.gt, ROOM_LIMIT)
        return TableFrame(rgb=frame.rgb, gt=gt, pool=gt).cut_by(NYU_PART)
    gt, scan = (within(depth, STREET_LIMIT) for depth in (frame.gt, frame.sensor))
    return TableFrame(rgb=frame.rgb, gt=gt, pool=scan, scan=scan)
