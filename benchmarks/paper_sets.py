"""The frames of `benchmarks.paper_tables`: rendered for it, or the real ones at hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.frames import SETS, Depth, EvalFrame
from pnpdepth_cli.camera import Camera
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.protocols import NYU_PART, FramePart
from pnpdepth_cli.sensors.projection import as_depth_image
from pnpdepth_cli.sensors.simulation import HDL_64E, simulate_lidar

ROOM_LIMIT = 10.0
"""Metres beyond which the ground truth of rooms counts as unknown: a Kinect's range."""
STREET_LIMIT = 80.0
"""Metres beyond which the ground truth of streets counts as unknown, as in KITTI's protocol."""

VIEWS = 4  # of one scene; frames are rendered a scene at a time


def cut_by(frame: EvalFrame, part: FramePart) -> EvalFrame:
    """Returns the frame with all of its images cut to the part that a protocol scores."""
    images = {name: getattr(frame, name) for name in ("rgb", "gt", "sensor", "pool")}
    left = {name: part.apply(image) for name, image in images.items() if image is not None}
    return replace(frame, **{name: np.ascontiguousarray(image) for name, image in left.items()})


@dataclass(frozen=True)
class FrameSet:
    """frames(): in a fixed order, `count` of them. street: for table II.

    beside_paper: its figures stand beside the paper's.
    """

    name: str
    street: bool
    count: int
    frames: Callable[[], Iterator[EvalFrame]]
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


ROOMS = Scenes(
    name="rendered rooms", camera="nyu", kind="room", size=(228, 304), seed=900041, limit=ROOM_LIMIT
)
STREETS = Scenes(
    name="rendered streets", camera="kitti", kind="street", size=(228, 912), seed=900022,
    limit=STREET_LIMIT,
)  # fmt: skip


def rendered(scenes: Scenes, cache: Path, count: int, workers: int) -> FrameSet:
    """Returns the set of the first `count` frames of these scenes.

    They are rendered now, by so many processes, unless the cache has them.
    """
    folder = cache / f"{scenes.kind}-{scenes.size[0]}x{scenes.size[1]}-seed{scenes.seed}"
    shards = [folder / f"shard_{number:05d}.npz" for number in range(-(-count // VIEWS))]
    if not all(shard.exists() for shard in shards):
        _render(scenes, folder, len(shards) * VIEWS, workers)
    frames = partial(_rendered_frames, scenes, shards, count)
    return FrameSet(scenes.name, scenes.kind == "street", count, frames)


def _render(scenes: Scenes, folder: Path, count: int, workers: int) -> None:
    """Renders so many frames into shards in a folder. Raises UsageError without the renderer."""
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


def _rendered_frames(scenes: Scenes, shards: list[Path], count: int) -> Iterator[EvalFrame]:
    """Yields the first `count` frames of the shards, those of streets with a LiDAR scan."""
    for first, path in zip(range(0, count, VIEWS), shards, strict=True):
        with np.load(path) as shard:
            views = list(zip(shard["rgb"], shard["depth"], shard["intrinsics"], strict=True))
        for number, (rgb, depth, lens) in enumerate(views[: count - first], start=first):
            gt = within(depth, scenes.limit)
            scan = scan_of(gt, lens, number) if scenes.kind == "street" else None
            yield EvalFrame(f"{number}", rgb.astype(np.float32) / 255, gt, scan)


def within(depth: Depth, limit: float) -> Depth:
    """The depth map with what is beyond `limit` unknown."""
    return np.where(depth <= limit, depth, np.float32(0))


def scan_of(gt: Depth, lens: NDArray[np.float32], seed: int) -> Depth:
    """Returns (H, W) one turn of 64 scan lines from the camera's place.

    Args:
        gt: Depth (H, W) in metres, 0 = unknown.
        lens: fx, fy, cx, cy in pixels.
        seed: Random seed of the scan.
    """
    fx, fy, cx, cy = (float(value) for value in lens)
    camera = Camera(intrinsics=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    return as_depth_image(simulate_lidar(gt, camera, HDL_64E, seed))


def shared(root: Path, most: int) -> list[FrameSet]:
    """Returns the sets of real frames at hand, each of at most so many frames, evenly spaced.

    Raises:
        UsageError: There is none.
    """
    sets = []
    for name, read in SETS.items():
        every = [_shared_frame(frame) for frame in read(root)]
        if not every:
            continue
        count = min(most, len(every))
        # Rounded down, unlike `frames.evenly`: the published figures are of these frames.
        chosen = [every[place] for place in np.linspace(0, len(every) - 1, count).astype(int)]
        street = every[0].sensor is not None
        frames = partial(iter, chosen)
        sets.append(FrameSet(name, street, count, frames, beside_paper=False))
    if not sets:
        raise UsageError(f"{root} holds none of {', '.join(SETS)}; check --shared")
    return sets


def _shared_frame(frame: EvalFrame) -> EvalFrame:
    """Returns a real frame as its protocol scores it: near enough, and rooms without their border.

    The points of a street are drawn from its scan.
    """
    if frame.sensor is None:
        gt = within(frame.gt, ROOM_LIMIT)
        return cut_by(replace(frame, gt=gt), NYU_PART)
    gt, scan = (within(depth, STREET_LIMIT) for depth in (frame.gt, frame.sensor))
    return replace(frame, gt=gt, sensor=scan, pool=scan)
