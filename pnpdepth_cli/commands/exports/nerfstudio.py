"""`nerfstudio`: transforms.json with poses, intrinsics and depth as 16-bit PNG in millimetres.

The data conventions are Nerfstudio's. Camera axes are x right, y up, z backwards. Principal points
count from the image's corner, so pixel centres are at .5. A depth is PNG code × 0.001 in the unit
of the poses, that of the results. Instant-NGP reads the same file; it takes that factor from
`integer_depth_scale`. Splatting begins with the points of start.ply, in the coordinates of the
poses.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pnpdepth_cli.commands.exports import Export, ExportFrame, copied_images
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.io.formats import LARGEST_CODE
from pnpdepth_cli.io.scans import write_cloud

_CODES_PER_UNIT = 1000.0
_START = "start.ply"
_COEFFICIENTS = {
    "radial-tangential": ("k1", "k2", "p1", "p2", "k3", "k4"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
_MODELS = {"radial-tangential": "OPENCV", "fisheye": "OPENCV_FISHEYE"}


def _depth_image(folder: Path, frame: ExportFrame) -> Path:
    return folder / "depths" / f"{frame.stem}.png"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    depths = [_depth_image(folder, frame) for frame in frames]
    return [*copied_images(folder, frames), *depths, folder / _START, folder / "transforms.json"]


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    # The program takes lenses of one kind.
    lenses = sorted({frame.camera.lens for frame in frames})
    if len(lenses) > 1:
        raise InputError(
            f"the cameras have lenses of different kinds ({', '.join(lenses)}), but Nerfstudio"
            " takes one; undistort the images first"
        )
    # Depth, points and image of each frame.
    clipped, entries, start = 0, [], []
    for frame in frames:
        entries.append(_entry(folder, frame))
        start.append(frame.start_points(len(frames)))
        depth = frame.valid_depth()
        fits = np.rint(depth * _CODES_PER_UNIT) <= LARGEST_CODE
        clipped += int((~fits).sum())
        write_depth(_depth_image(folder, frame), np.where(fits, depth, 0), scale=_CODES_PER_UNIT)
        frame.copy_image(folder)
        done()
    write_cloud(folder / _START, start)
    # Cameras and poses.
    content = {
        "camera_model": _MODELS[lenses[0]],
        "enable_depth_loading": True,
        "integer_depth_scale": 1 / _CODES_PER_UNIT,
        "ply_file_path": _START,
        "frames": entries,
    }
    write_json(folder / "transforms.json", content)
    if not clipped:
        return []
    limit = f"{LARGEST_CODE / _CODES_PER_UNIT:.4g} {frames[0].result.record.unit}"
    return [f"depth: {clipped:,} pixels beyond {limit}, the largest of 16 bits, are unknown"]


def _entry(folder: Path, frame: ExportFrame) -> dict[str, object]:
    """The frame's entry in transforms.json."""
    # The coefficients of the lens, if the program has all of them.
    camera, pose = frame.camera, frame.pose
    assert pose is not None
    names = _COEFFICIENTS[camera.lens]
    values = dict(zip(names, camera.distortion, strict=False))
    if any(camera.distortion[len(names) :]):
        raise InputError(
            f"{frame.image} has a lens that Nerfstudio does not know ({camera.lens},"
            f" {len(camera.distortion)} coefficients); undistort the images first"
        )
    # The pose, with Nerfstudio's axes: y up, z backwards.
    depth = _relative(_depth_image(folder, frame), folder)
    matrix = np.eye(4)
    matrix[:3] = pose
    matrix[:3, 1:3] *= -1
    # Principal points count from the image's corner.
    intrinsics = camera.intrinsics
    return {
        "file_path": _relative(frame.image_in(folder), folder),
        "depth_file_path": depth,
        "depth_path": depth,
        "transform_matrix": matrix.tolist(),
        "w": frame.size[1],
        "h": frame.size[0],
        "fl_x": intrinsics[0, 0],
        "fl_y": intrinsics[1, 1],
        "cx": intrinsics[0, 2] + 0.5,
        "cy": intrinsics[1, 2] + 0.5,
        **{name: values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2")},
    }


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


EXPORT = Export(needs_pose=True, files=_files, write=_write, in_model_units=False)
