"""Real frames for measuring: folders in the layout of the data's own README."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.commands.many_frames.running import spread
from pnpdepth_cli.completion.image_registration import estimate_registration
from pnpdepth_cli.completion.registration_evidence import evidence
from pnpdepth_cli.frames.frame import Frame, Refined, Register, tensor_of
from pnpdepth_cli.frames.method import Method, pipeline_of
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.refine_frame import refine_frame
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.measures import score
from pnpdepth_cli.models.definition import Normalisation
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors.projection import Points, occluded_in_map
from pnpdepth_cli.settings import ClosedSettings, Settings

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class EvalFrame:
    """rgb (H, W, 3) in 0..1; depths (H, W) in metres, 0 = unknown.

    sensor: a LiDAR's points on their pixels. pool: the pixels that uniform points are drawn from,
    None for those of the ground truth.
    """

    name: str
    rgb: NDArray[np.float32]
    gt: Depth
    sensor: Depth | None = None
    pool: Depth | None = None
    register: Register = None

    def points(self, count: int | None, seed: int = 0) -> Points:
        """Returns sparse points of the frame, at pixels of its image, with depth in metres.

        Args:
            count: Number of points, drawn at random from the pixels of `pool`; all if there are
                fewer. None: all points of `sensor`.
            seed: Random seed of the draw.
        """
        if count is None:
            assert self.sensor is not None
            depth = self.sensor
            rows, columns = np.nonzero(depth > 0)
        else:
            depth = self.gt if self.pool is None else self.pool
            rows, columns = np.nonzero(depth > 0)
            count = min(count, len(rows))
            generator = np.random.default_rng(seed)
            chosen = generator.choice(len(rows), count, replace=False)
            rows, columns = rows[chosen], columns[chosen]
        xy = np.stack([columns, rows], axis=1).astype(np.float32)
        return SparsePoints(xy=xy, depth=depth[rows, columns], size=depth.shape)


def kitti_dc(root: Path) -> Iterator[EvalFrame]:
    """Yields street frames with one LiDAR scan each and the accumulated ground truth."""
    folder = root / "kitti_dc"
    for path in sorted((folder / "image").glob("*.jpg")):
        gt, scan = (
            read_depth(folder / kind / f"{path.stem}.png", scale=256).values
            for kind in ("groundtruth", "velodyne_raw")
        )
        yield EvalFrame(path.stem, read_rgb(path).values, gt, scan)


def nyu(root: Path) -> Iterator[EvalFrame]:
    """Yields Kinect frames of 224×224 and 480×640 pixels."""
    ready = (np.load(root / "nyu" / f"{name}.npy").squeeze() for name in ("rgb", "depth"))
    rgb, gt = (np.ascontiguousarray(values.astype(np.float32)) for values in ready)
    yield EvalFrame("nyu", rgb, gt)
    yield from _pairs(root / "nyu" / "metric3d", "rgb_*.jpg", ("rgb", "sync_depth"), 1000)


def _pairs(folder: Path, images: str, change: tuple[str, str], scale: float) -> Iterator[EvalFrame]:
    """Yields the frames of a folder.

    Args:
        folder: The folder.
        images: Pattern of the images' paths below it.
        change: Text of an image's path, and what replaces it in that of its depth, a PNG.
        scale: Integers a metre in the depth.
    """
    for path in sorted(folder.glob(images)):
        name = path.relative_to(folder).as_posix().replace(*change)
        depth = (folder / name).with_suffix(".png")
        yield EvalFrame(path.stem, read_rgb(path).values, read_depth(depth, scale=scale).values)


def rgbd(folder: str, scale: float) -> Callable[[Path], Iterator[EvalFrame]]:
    """Returns the frames of a folder with `image/*.jpg` and `depth/*.png` of this scale."""
    return lambda root: _pairs(root / folder, "image/*.jpg", ("image/", "depth/"), scale)


SETS: dict[str, Callable[[Path], Iterator[EvalFrame]]] = {
    "7scenes": lambda root: _pairs(root / "7scenes", "*.color.jpg", (".color", ".depth"), 1000),
    "icl_nuim": rgbd("icl_nuim", 1000),
    "kitti_dc": kitti_dc,
}
"""Kinect frames of one kitchen (0 and 65535 are unknown), of a rendered room, and of streets."""
MORE_SETS: dict[str, Callable[[Path], Iterator[EvalFrame]]] = {
    "nyu": nyu,
    "tum_fr1_rpy": rgbd("tum_fr1_rpy", 5000),
    "tum_fr3_cabinet": rgbd("tum_fr3_cabinet", 5000),
    "realsense": rgbd("realsense_unregistered", 1000),
}
"""Sets on which nothing was chosen."""
ALL_SETS = SETS | MORE_SETS
HALVES = {"even": slice(0, None, 2), "odd": slice(1, None, 2)}
"""Constants were chosen on the even frames of a set; the odd ones are for reporting."""


def frames_of(name: str, data: Path, count: int, half: str | None = None) -> list[EvalFrame]:
    """`count` evenly spaced frames of a set, or of one of its `HALVES`; none if it is not there."""
    if not any(data.glob(f"{name}*")):
        return []
    frames = list(ALL_SETS[name](data))
    return evenly(frames if half is None else frames[HALVES[half]], count)


def evenly(frames: Sequence[EvalFrame], count: int) -> list[EvalFrame]:
    """`count` evenly spaced frames, the first and the last among them; all if they are fewer."""
    places = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return [frames[round(place)] for place in places]


def without_occluded(frame: EvalFrame) -> EvalFrame:
    """The frame without the LiDAR points that the program drops as occluded from the camera."""
    assert frame.sensor is not None
    points = frame.points(None)
    hidden = occluded_in_map(points)
    if hidden is None:
        return frame
    sensor = frame.sensor.copy()
    columns, rows = points.xy[hidden].astype(int).T
    sensor[rows, columns] = 0.0
    return replace(frame, sensor=sensor)


REGISTRATIONS = ("off", "frame", "set")
"""Images as they are, moved as `refine` moves each alone, and as `batch` moves those of a set."""


def registered(
    frames: Sequence[EvalFrame], count: int | None, seed: int, how: str
) -> list[EvalFrame]:
    """Returns the frames with the registration of their images that the program estimates.

    Args:
        frames: Frames of one set.
        count: Number of points of each; None: all of its LiDAR.
        seed: Random seed of the points.
        how: Whose registration it is, of `REGISTRATIONS`.
    """
    if how == "off":
        return list(frames)
    of_frames = [evidence(frame.rgb, frame.points(count, seed).tensors()) for frame in frames]
    if how == "set":
        chosen = [of_frames[number] for number in spread(len(of_frames))]
        registrations = [estimate_registration(chosen)] * len(frames)
    else:
        registrations = [estimate_registration([of_frame]) for of_frame in of_frames]
    pairs = zip(frames, registrations, strict=True)
    return [replace(frame, register=registration) for frame, registration in pairs]


def drawn_inputs(frame: EvalFrame, count: int | None, seed: int) -> Frame:
    """The frame as the program reads one, with `count` points, or all of its LiDAR (None)."""
    points = frame.points(count, seed).tensors()
    return Frame(rgb=tensor_of(frame.rgb), points=points, register=frame.register)


def refined(network: Network, layer: str, settings: ClosedSettings, inputs: Frame) -> Refined:
    """Returns a frame refined at a layer by the paper's method, with all of its points."""
    pipeline = pipeline_of(Settings(method="paper", propagate=settings.propagate))
    with OpenNetwork(network, layer, settings, always_updated=True) as opened:
        return refine_frame([opened], inputs.registered(), pipeline)


WEIGHTS = {"pncnn": "pncnn/kitti_model_best.pth.tar", "nconv": "nconv/CNN_ep0003.pth.tar"}


def opened(name: str, data: Path) -> Network:
    """Returns a network by its name, with its published or shipped weights."""
    if name == "fastdepth":
        network = load_network(str(data / "weights" / "fastdepth_nyu.onnx"), None)
        definition = replace(network.definition, normalisation=Normalisation())
        return replace(network, definition=definition)
    return load_network(name, data / "weights" / WEIGHTS[name] if name in WEIGHTS else None)


def by_default(network: Network, inputs: Frame, seed: int = 0, method: str = "fused") -> Refined:
    """Returns a frame as `pnpdepth refine` refines it by default, with its stages.

    Args:
        network: The network.
        inputs: The frame.
        seed: Random seed of the refinement.
        method: What `--method` names.
    """
    with Method([network], Settings(seed=seed, method=method), inputs) as opened_method:
        return opened_method.refine(inputs, with_stages=True)


def with_outliers(points: SparsePoints, fraction: float, seed: int) -> SparsePoints:
    """Returns the points, this fraction of them at random depths.

    They are from half the nearest depth to twice the farthest.
    """
    generator = torch.Generator().manual_seed(seed)
    outlier = torch.rand(len(points), generator=generator) < fraction
    low = float(points.depth.min()) / 2
    high = float(points.depth.max()) * 2
    random = low + (high - low) * torch.rand(len(points), generator=generator)
    return replace(points, depth=torch.where(outlier, random, points.depth))


def with_wrong_factors(points: SparsePoints, fraction: float, seed: int) -> SparsePoints:
    """Returns the points, the depth of this fraction of them times exp(0.7 n), n normal."""
    generator = torch.Generator().manual_seed(seed)
    outlier = torch.rand(len(points), generator=generator) < fraction
    factor = torch.exp(0.7 * torch.randn(len(points), generator=generator))
    return replace(points, depth=torch.where(outlier, points.depth * factor, points.depth))


def with_wrong_tracks(points: SparsePoints, fraction: float, seed: int) -> SparsePoints:
    """Returns the points, this fraction of them wrong in groups of up to 6 neighbours.

    The depth of a group is multiplied by exp(0.5 n), n normal.
    """
    rng = np.random.default_rng(seed)
    xy = points.xy.numpy()
    factor = np.ones(len(xy), np.float32)
    while (factor != 1).mean() < fraction:
        squared_px = ((xy - xy[rng.integers(len(xy))]) ** 2).sum(axis=1)
        group = np.argsort(squared_px)[:6]
        # Points of an earlier group keep their factor.
        factor[group[factor[group] == 1]] = np.exp(0.5 * rng.standard_normal())
    return replace(points, depth=points.depth * torch.from_numpy(factor))


OUTLIERS = {"random": with_outliers, "factors": with_wrong_factors, "tracks": with_wrong_tracks}
"""Kinds of outliers."""


def errors_of(depths: dict[str, torch.Tensor], gt: torch.Tensor) -> dict[str, tuple[float, float]]:
    """Returns (MAE, RMSE) in metres of each depth, over the same pixels.

    Args:
        depths: Depths (H, W) in metres by name, 0 = unknown.
        gt: Ground truth (H, W) in metres, 0 = unknown. It counts where all depths are known.
    """
    seen = torch.stack([depth > 0 for depth in depths.values()]).all(dim=0)
    gt = torch.where(seen, gt, 0.0)
    scores = {name: score(depth, gt) for name, depth in depths.items()}
    return {name: (s["mae"], s["rmse"]) for name, s in scores.items()}


def table_row(*cells: object, head: bool = False) -> str:
    """A line of a Markdown table, with the line below it if it is the head."""
    line = "| " + " | ".join(map(str, cells)) + " |"
    return line + ("\n|" + "---|" * len(cells) if head else "")


def print_row(*cells: object, head: bool = False) -> None:
    """Prints a line of a Markdown table at once."""
    print(table_row(*cells, head=head), flush=True)
