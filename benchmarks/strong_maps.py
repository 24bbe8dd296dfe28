"""Frames and networks of `benchmarks.strong`: stored maps of strong networks, simulated ones, weak.

The stored maps are read as the README of their folder says. A set that is not there is left out.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks import frames
from benchmarks.frames import EvalFrame, opened, without_occluded
from benchmarks.simulated import simulated_network, stored_network
from pnpdepth_cli.choices import OutputKind, OutputScale
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.registry import find_definition

Map = NDArray[np.float32]
Networks = Callable[[EvalFrame, Path], Iterator[tuple[str, Network]]]
"""Gives the networks of a frame, each with the row of the table that it belongs to. The path is the
folder of data."""


@dataclass(frozen=True, kw_only=True)
class StrongFrame:
    """A frame, a network, and the row of the table that they belong to."""

    set: str
    row: str
    frame: EvalFrame
    network: Network


@dataclass(frozen=True, kw_only=True)
class StoredSet:
    """A folder of K_rgb.*, K_gt.* and K_pred*.*, one size each."""

    row: str
    kind: OutputKind
    scale: OutputScale
    gt_scale: float = 1000.0  # integers per metre, where truth is a PNG
    unknown: tuple[float, ...] = ()  # values of the map that say nothing, such as those of the sky
    inverted: bool = False  # whether the file holds 1 / what the network gave


STORED = {
    "prior_da_nyu": StoredSet(
        row="Depth Anything, room", kind="inverse", scale="affine", inverted=True
    ),
    "unidepth_nyu": StoredSet(row="UniDepth, NYU", kind="depth", scale="metric"),
    "weison_kitti_dav2": StoredSet(
        row="Depth Anything V2, KITTI", kind="inverse", scale="affine", gt_scale=256, unknown=(0,)
    ),
    "mmaj1_synthetic_dptlarge": StoredSet(
        row="DPT-Large, table tops", kind="inverse", scale="affine"
    ),
    "nuscenes_composites": StoredSet(
        row="Metric3D, UniDepth, DA3, nuScenes",
        kind="depth",
        scale="affine",
        gt_scale=256,
        unknown=(0, 255),
    ),
    "adri721_realsense_zoe": StoredSet(row="ZoeDepth, RealSense", kind="depth", scale="affine"),
    "eungihan_depthformer": StoredSet(
        row="DepthFormer, another car", kind="depth", scale="metric", gt_scale=256
    ),
}
"""By folder of `strong/`."""
LEAST_TRUTH = 10
"""Pixels with ground truth for each point that is drawn; most of the truth is left to score on."""
LINE_ROWS = 8
"""Rows from scan line to scan line, of lines that are drawn from truth."""
LINE_COLUMNS = 2
"""Columns from point to point on such a line."""

ERRORS = {"simulated, 2 %": 0.02, "simulated, 4 %": 0.04, "simulated, 9 %": 0.09}
"""Errors after alignment of the simulated networks, by row."""
TINY = ("fcrn-tiny", "eigen-tiny", "sfmlearner-tiny")
RANDOM = ("fcrn-tiny", "eigen-tiny")
"""Networks that are given random weights."""
RENDERED_SIZE = (240, 320)
RENDERED = {"rendered rooms": "room", "rendered streets": "street", "rendered desks": "desk"}
"""Kinds of rendered scenes, by set."""
RENDER_SEED = 7100
"""Random seed of the scenes; none of the training's."""
TRUTH_SETS = ("7scenes", "icl_nuim", "nyu", "kitti_dc", "tum_fr1_rpy", "tum_fr3_cabinet")
"""Sets with truth that networks are simulated from. Nothing was chosen on the last two."""
GROUPS = ("stored", "simulated", "fastdepth", "tiny", "random")


def strong_frames(
    data: Path, groups: Sequence[str], sets: Sequence[str] | None, count: int
) -> Iterator[StrongFrame]:
    """Returns frames with networks, `count` evenly spaced frames of each set; stored maps are all.

    Args:
        data: The folder of real frames.
        groups: Kinds of networks, of `GROUPS`.
        sets: Names of sets. None: all.
        count: Frames of each set.
    """
    if "stored" in groups:
        for name in STORED:
            if (sets is None or name in sets) and (data / "strong" / name).is_dir():
                yield from stored_frames(data / "strong" / name)
    makers = [MAKERS[group] for group in groups if group in MAKERS]
    if not makers:
        return
    for name in (*RENDERED, *TRUTH_SETS):
        if sets is not None and name not in sets:
            continue
        of_set = frames.frames_of(name, data, count)
        if name in RENDERED:
            of_set = rendered(RENDERED[name], count)
        for frame in of_set:
            for make in makers:
                for row, network in make(frame, data):
                    yield StrongFrame(set=name, row=row, frame=frame, network=network)


def can_draw(frame: EvalFrame, count: int | None) -> bool:
    """Returns whether the frame has truth enough for so many points; None: for scan lines."""
    wanted = 1000 if count is None else count
    return np.count_nonzero(frame.gt) >= LEAST_TRUTH * wanted


def with_lines(frame: EvalFrame) -> EvalFrame:
    """Returns the frame with the points of a scanner: its own, or rows drawn from its truth."""
    if frame.sensor is not None:
        return without_occluded(frame)
    sensor = np.zeros_like(frame.gt)
    rows = slice(LINE_ROWS // 2, None, LINE_ROWS)
    sensor[rows, ::LINE_COLUMNS] = frame.gt[rows, ::LINE_COLUMNS]
    return replace(frame, sensor=sensor)


def stored_frames(folder: Path) -> Iterator[StrongFrame]:
    """Yields the frames of a folder, once for each network's map."""
    stored = STORED[folder.name]
    for path in sorted(folder.glob("*_rgb.*")):
        number = path.stem.removesuffix("_rgb")
        (of_gt,) = folder.glob(f"{number}_gt.*")
        gt = np.load(of_gt) if of_gt.suffix == ".npy" else None
        if gt is None:
            gt = read_depth(of_gt, scale=stored.gt_scale).values
        frame = EvalFrame(number, read_rgb(path).values, np.nan_to_num(gt).astype(np.float32))
        # A colour-mapped picture of the map, as users have it, may lie beside it.
        maps = (p for p in sorted(folder.glob(f"{number}_pred*")) if "as_stored" not in p.name)
        for file in maps:
            values = np.load(file) if file.suffix == ".npy" else _read_grey(file)
            values = values.astype(np.float32).squeeze()
            values = np.where(np.isin(values, stored.unknown), np.nan, values).astype(np.float32)
            values = 1 / values if stored.inverted else values
            network = stored_network(file.stem, values, stored.kind, stored.scale)
            named = replace(frame, name=file.stem)
            yield StrongFrame(set=folder.name, row=stored.row, frame=named, network=network)


def rendered(kind: str, count: int) -> list[EvalFrame]:
    """Returns `count` rendered frames, each of a scene of its own."""
    from model_zoo_defs.training.scenes.scenes import scene_frames  # needs the extra `train`

    height, width = RENDERED_SIZE
    scenes = (
        scene_frames(RENDER_SEED, number, height=height, width=width, kinds=(kind,))[0]
        for number in range(count)
    )
    return [
        EvalFrame(f"{kind}-{number}", scene.rgb.astype(np.float32) / 255, scene.depth)
        for number, scene in enumerate(scenes)
    ]


def _simulated(frame: EvalFrame, _data: Path) -> Iterator[tuple[str, Network]]:
    """Yields networks of each error of `ERRORS`, with their rows."""
    for row, error in ERRORS.items():
        seed = zlib.crc32(f"{frame.name} {row}".encode())
        name = f"simulated-{100 * error:g}"
        yield row, simulated_network(name, frame.gt, frame.rgb, error, seed)


def _fastdepth(_frame: EvalFrame, data: Path) -> Iterator[tuple[str, Network]]:
    """Yields FastDepth and its row, if its file is there."""
    if (data / "weights" / "fastdepth_nyu.onnx").is_file():
        yield "FastDepth", opened("fastdepth", data)


def _tiny(_frame: EvalFrame, data: Path) -> Iterator[tuple[str, Network]]:
    """Yields the networks of `TINY`, each a row of its own."""
    for name in TINY:
        yield name, opened(name, data)


def _random(frame: EvalFrame, _data: Path) -> Iterator[tuple[str, Network]]:
    """Yields the networks of `RANDOM` with weights that are drawn for the frame, in one row."""
    for name in RANDOM:
        torch.manual_seed(zlib.crc32(frame.name.encode()))
        definition = replace(find_definition(name), checkpoint=None, complete=True)
        yield "random weights", load_network(definition, None)


MAKERS: dict[str, Networks] = {
    "simulated": _simulated,
    "fastdepth": _fastdepth,
    "tiny": _tiny,
    "random": _random,
}
"""By group."""


def _read_grey(path: Path) -> Map:
    """Returns the numbers (H, W) of a picture of one channel."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image, np.float32)
