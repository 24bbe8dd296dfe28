"""`pnpdepth cloud`: depth maps as one coloured point cloud."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import __version__
from pnpdepth_cli.errors import InputError, OutputError, SizeError, UsageError
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.cloud_files import CLOUD_SUFFIXES, write_cloud
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.poses import read_pose_of_each
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.pipeline.refinement.frame_camera import (
    FrameCamera,
    camera_of_exif,
    camera_of_file,
    camera_of_fov,
)
from pnpdepth_cli.pipeline.results import ResultFrame, result_frames
from pnpdepth_cli.sensors.cloud import EDGE, PointCloud, VoxelGrid, cloud_from_depth, concatenated


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
    """Calibration of the camera. None: `fov_deg`, else the record's camera, else EXIF."""
    camera: int | None = None
    """KITTI's camera number."""
    fov_deg: float | None = None
    """Horizontal field of view of a camera without distortion, instead of `calib`."""
    poses: Path | None = None
    """Poses of the depth files, in their order. None: those of the records, if they have any. With
    poses, the cloud is in the world's frame."""
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


def write_depth_cloud(request: CloudRequest) -> dict[str, Any]:
    """Writes the cloud and its record beside it, and returns the record.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    _check(request)
    frames = result_frames(request.depth)
    poses = _poses(request, frames)
    grid = None if request.voxel is None else VoxelGrid(request.voxel)
    clouds, notes = [], []
    coloured = all(_image(request, frame) is not None for frame in frames)
    for frame, pose in zip(frames, poses, strict=True):
        cloud, frame_notes = _cloud(request, frame, pose, coloured)
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
    record["frame"] = "camera" if poses[0] is None else "world"
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
    if request.calib is not None and request.fov_deg is not None:
        raise UsageError("--calib and --fov both give the camera; leave one out")
    if request.image is not None and request.depth.is_dir():
        raise UsageError("--image is for one depth file; records name the images of a folder")
    if request.voxel is not None and not 0 < request.voxel < math.inf:
        raise UsageError(f"--voxel is {request.voxel:g}; give a length above 0")
    if not 0 <= request.edge < math.inf:
        raise UsageError(f"--edge is {request.edge:g}; give a fraction such as {EDGE}, 0 for none")


def _poses(request: CloudRequest, frames: list[ResultFrame]) -> list[NDArray[np.float64] | None]:
    """The pose of each frame: of the file that is given, else of the records."""
    if request.poses is None:
        cameras = [frame.camera for frame in frames]
        poses = [None if camera is None else camera.pose for camera in cameras]
        if any(pose is None for pose in poses) and any(pose is not None for pose in poses):
            without = next(f.depth for f, pose in zip(frames, poses, strict=True) if pose is None)
            raise InputError(
                f"{without} has no pose in its record, but others have; give --poses for all, or"
                " refine it again as the others"
            )
        return poses
    return list(read_pose_of_each(request.poses, len(frames), "depth files"))


def _image(request: CloudRequest, frame: ResultFrame) -> Path | None:
    return request.image or frame.image


def _cloud(
    request: CloudRequest, frame: ResultFrame, pose: NDArray[np.float64] | None, coloured: bool
) -> tuple[PointCloud, tuple[str, ...]]:
    """The cloud of one depth map, in the world's frame if there is a pose, and notes."""
    depth = read_depth(frame.depth, scale=request.depth_scale).values
    camera = _camera(request, frame, (depth.shape[0], depth.shape[1]))
    rgb, image = None, _image(request, frame)
    if coloured and image is not None:
        rgb = read_rgb(image).values
        if rgb.shape[:2] != depth.shape:  # of a photo that COLMAP read as it is stored
            rgb = read_rgb(image, upright=False).values
        if rgb.shape[:2] != depth.shape:
            raise SizeError(
                f"{image} is {rgb.shape[1]}×{rgb.shape[0]} but {frame.depth} is"
                f" {depth.shape[1]}×{depth.shape[0]}; give the image of this depth with --image"
            )
    keep = (depth >= request.min_depth) & (depth <= request.max_depth)
    for path, mask in _masks(request, frame, depth):
        if mask.shape != depth.shape:
            raise SizeError(f"{path} is not of the size of {frame.depth}")
        keep &= mask
    cloud = cloud_from_depth(depth, camera.camera, rgb=rgb, keep=keep, edge=request.edge)
    return (cloud if pose is None else cloud.transformed(pose)), camera.notes


def _masks(
    request: CloudRequest, frame: ResultFrame, depth: NDArray[np.float32]
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


def _camera(request: CloudRequest, frame: ResultFrame, size: tuple[int, int]) -> FrameCamera:
    """The camera of a depth map (H, W): as it is given, else of its record, else of EXIF."""
    if request.calib is not None:
        return camera_of_file(request.calib, request.camera, size, frame.depth)
    if request.fov_deg is not None:
        return camera_of_fov(request.fov_deg, size)
    if frame.camera is not None:
        if frame.record.get("size") != [size[1], size[0]]:
            raise SizeError(
                f"{frame.depth} is {size[1]}×{size[0]}, unlike its record; refine it again, or give"
                " --calib"
            )
        note = f"camera: {frame.camera.source} (from the record)"
        return replace(frame.camera, notes=(note,))
    image = _image(request, frame)
    camera = None if image is None else camera_of_exif(image, size)
    if camera is None:
        raise UsageError(
            f"a cloud needs the camera, and neither a record nor EXIF gives that of {frame.depth};"
            " give --calib or --fov"
        )
    return camera


def _record(
    request: CloudRequest, frames: list[ResultFrame], cloud: PointCloud, notes: list[str]
) -> dict[str, Any]:
    settings = ("fov_deg", "depth_scale", "min_depth", "max_sigma", "edge", "voxel")
    return {
        "command": "cloud",
        "version": __version__,
        "output": str(request.output),
        "points": len(cloud),
        "coloured": cloud.rgb is not None,
        "unit": frames[0].unit,
        "inputs": {
            "depth": [str(frame.depth) for frame in frames],
            "calib": None if request.calib is None else str(request.calib),
            "poses": None if request.poses is None else str(request.poses),
        },
        "settings": {name: getattr(request, name) for name in settings}
        | {"max_depth": None if math.isinf(request.max_depth) else request.max_depth},
        "notes": notes,
    }
