"""`pnpdepth cloud`: depth maps as one coloured point cloud."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import __version__
from pnpdepth_cli.errors import InputError, OutputError, SizeError, UsageError
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.cloud_files import CLOUD_SUFFIXES, write_cloud
from pnpdepth_cli.io.dataset.find_files import find_files
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, read_depth
from pnpdepth_cli.io.poses import read_poses
from pnpdepth_cli.io.record import read_json, write_json
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.pipeline.sparse.scans import camera_of, check_size
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.cloud import EDGE, PointCloud, VoxelGrid, cloud_from_depth, concatenated

_DEPTH_ENDING = "_depth"
_MAX_FOV_DEG = 170.0


@dataclass(frozen=True, kw_only=True)
class CloudRequest:
    """What the user asks of a cloud."""

    depth: Path
    """A depth file, or a folder with files NAME_depth.SUFFIX, as `refine` and `batch` write."""
    output: Path
    """The file to write; its suffix is one of `CLOUD_SUFFIXES`."""
    image: Path | None = None
    """The colours. None: the image that the record NAME.json beside the depth names, if any."""
    calib: Path | None = None
    """Calibration of the camera."""
    camera: int | None = None
    """KITTI's camera number."""
    fov_deg: float | None = None
    """Horizontal field of view of a camera without distortion, instead of `calib`."""
    poses: Path | None = None
    """Poses of the depth files, in their order; the cloud is in the world's frame."""
    depth_scale: float | None = None
    """Integer depth files hold metres × this."""
    min_depth: float = 0.0
    """Nearer pixels are left out."""
    max_depth: float = math.inf
    """Farther pixels are left out."""
    max_sigma: float | None = None
    """Pixels with a larger standard deviation, as a fraction of the depth, are left out."""
    edge: float = EDGE
    """Jump of depth at which the cloud is cut, see `cloud_from_depth`."""
    voxel: float | None = None
    """Side of the cubes in which points are merged. None: all points are kept."""
    overwrite: bool = False
    """Whether an existing file is replaced."""


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """The files of one depth map."""

    depth: Path
    image: Path | None
    sigma: Path | None
    valid: Path | None
    pose: NDArray[np.float64] | None


def write_depth_cloud(request: CloudRequest) -> dict[str, Any]:
    """Writes the cloud and its record beside it, and returns the record.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    _check(request)
    frames = _frames(request)
    grid = None if request.voxel is None else VoxelGrid(request.voxel)
    clouds, notes = [], []
    coloured = all(frame.image is not None for frame in frames)
    for frame in frames:
        cloud, frame_notes = _cloud(request, frame, coloured)
        notes += [note for note in frame_notes if note not in notes]
        if grid is None:
            clouds.append(cloud)
        else:
            grid.add(cloud)
    cloud = concatenated(clouds) if grid is None else grid.cloud(coloured=coloured)
    if not len(cloud):
        raise InputError(f"{request.depth}: no pixel is left; relax --max-depth, --max-sigma, …")
    make_folder(request.output.parent)
    write_cloud(request.output, cloud.xyz, cloud.normals, cloud.rgb)
    record = _record(request, frames, cloud, notes)
    write_json(record_path(request.output), record)
    return record


def record_path(output: Path) -> Path:
    """Returns the path of the record of a cloud; NAME.json may be that of a refinement."""
    return output.with_name(f"{output.name}.json")


def _check(request: CloudRequest) -> None:
    if request.output.suffix.lower() not in CLOUD_SUFFIXES:
        raise OutputError(
            f"{request.output}: a cloud is written as one of {', '.join(CLOUD_SUFFIXES)}"
        )
    for path in (request.output, record_path(request.output)):
        if path.exists() and not request.overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, -o names another path")
    if (request.calib is None) == (request.fov_deg is None):
        raise UsageError("a cloud needs the camera: give one of --calib and --fov")
    if request.fov_deg is not None and not 0 < request.fov_deg <= _MAX_FOV_DEG:
        raise UsageError(f"--fov is {request.fov_deg:g} degrees; give 0 to {_MAX_FOV_DEG:g}")
    if request.voxel is not None and not 0 < request.voxel < math.inf:
        raise UsageError(f"--voxel is {request.voxel:g}; give a length above 0")
    if not 0 <= request.edge < math.inf:
        raise UsageError(f"--edge is {request.edge:g}; give a fraction such as {EDGE}, 0 for none")


def _frames(request: CloudRequest) -> list[_Frame]:
    """The depth files with what lies beside them."""
    root = request.depth
    if root.is_dir():
        if request.image is not None:
            raise UsageError("--image is for one depth file; records name the images of a folder")
        files, _ = find_files(root, DEPTH_SUFFIXES)
        depths = [path for name, path in files.items() if name.endswith(_DEPTH_ENDING)]
        if not depths:
            raise InputError(f"{root} has no files NAME{_DEPTH_ENDING}.png or of another format")
    else:
        depths = [root]
    poses: list[NDArray[np.float64] | None] = [None] * len(depths)
    if request.poses is not None:
        rows = read_poses(request.poses)
        if len(rows) != len(depths):
            raise InputError(
                f"{request.poses} has {len(rows)} poses for {len(depths)} depth files; it needs one"
                " row for each, in the order of their names"
            )
        poses = list(rows)
    return [
        _Frame(
            depth=depth,
            image=request.image or _image_of_record(depth),
            sigma=_beside(depth, "_sigma.exr"),
            valid=_beside(depth, "_valid.png"),
            pose=pose,
        )
        for depth, pose in zip(depths, poses, strict=True)
    ]


def _beside(depth: Path, ending: str) -> Path | None:
    path = depth.with_name(depth.stem.removesuffix(_DEPTH_ENDING) + ending)
    return path if path != depth and path.is_file() else None


def _image_of_record(depth: Path) -> Path | None:
    """The image that the record beside a depth file names, if both exist."""
    record = _beside(depth, ".json")
    if record is None:
        return None
    image = read_json(record).get("inputs", {}).get("image", {})
    path = image.get("path") if isinstance(image, dict) else None
    return Path(path) if isinstance(path, str) and Path(path).is_file() else None


def _cloud(
    request: CloudRequest, frame: _Frame, coloured: bool
) -> tuple[PointCloud, tuple[str, ...]]:
    """The cloud of one depth map, in the world's frame if there is a pose, and notes."""
    depth = read_depth(frame.depth, scale=request.depth_scale).values
    camera, notes = _camera(request, frame.depth, (depth.shape[0], depth.shape[1]))
    rgb = None
    if coloured and frame.image is not None:
        rgb = read_rgb(frame.image).values
        if rgb.shape[:2] != depth.shape:
            raise SizeError(
                f"{frame.image} is {rgb.shape[1]}×{rgb.shape[0]} but {frame.depth} is"
                f" {depth.shape[1]}×{depth.shape[0]}; give the image of this depth with --image"
            )
    keep = (depth >= request.min_depth) & (depth <= request.max_depth)
    for path, mask in _masks(request, frame, depth):
        if mask.shape != depth.shape:
            raise SizeError(f"{path} is not of the size of {frame.depth}")
        keep &= mask
    cloud = cloud_from_depth(depth, camera, rgb=rgb, keep=keep, edge=request.edge)
    if frame.pose is not None:
        cloud = cloud.transformed(frame.pose)
    return cloud, notes


def _masks(
    request: CloudRequest, frame: _Frame, depth: NDArray[np.float32]
) -> Iterator[tuple[Path, NDArray[np.bool_]]]:
    """Files beside the depth that say which pixels are valid, and the masks."""
    if frame.valid is not None:
        yield frame.valid, read_rgb(frame.valid).values[..., 0] > 0
    if request.max_sigma is None:
        return
    if frame.sigma is None:
        raise InputError(
            f"{frame.depth} has no standard deviation beside it; --max-sigma needs the file that"
            " `pnpdepth refine --uncertainty` writes"
        )
    sigma = read_depth(frame.sigma).values
    same_size = sigma.shape == depth.shape
    yield frame.sigma, sigma <= request.max_sigma * depth if same_size else sigma > 0


def _camera(
    request: CloudRequest, path: Path, size: tuple[int, int]
) -> tuple[Camera, tuple[str, ...]]:
    """The camera of a depth map (H, W), and notes."""
    if request.calib is not None:
        calibration = read_calibration(request.calib, request.camera)
        return camera_of(calibration), tuple(check_size(request.calib, calibration, size, path))
    assert request.fov_deg is not None
    height, width = size
    focal_px = width / 2 / math.tan(math.radians(request.fov_deg) / 2)
    intrinsics = np.array(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    )
    note = f"camera: {focal_px:.1f} pixels of focal length, no distortion (from --fov)"
    return Camera(intrinsics=intrinsics), (note,)


def _record(
    request: CloudRequest, frames: list[_Frame], cloud: PointCloud, notes: list[str]
) -> dict[str, Any]:
    settings = ("fov_deg", "depth_scale", "min_depth", "max_sigma", "edge", "voxel")
    return {
        "command": "cloud",
        "version": __version__,
        "output": str(request.output),
        "points": len(cloud),
        "coloured": cloud.rgb is not None,
        "frame": "camera" if request.poses is None else "world",
        "inputs": {
            "depth": [str(frame.depth) for frame in frames],
            "calib": None if request.calib is None else str(request.calib),
            "poses": None if request.poses is None else str(request.poses),
        },
        "settings": {name: getattr(request, name) for name in settings}
        | {"max_depth": None if math.isinf(request.max_depth) else request.max_depth},
        "notes": notes,
    }
