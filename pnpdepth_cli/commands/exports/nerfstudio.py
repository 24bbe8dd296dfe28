"""`nerfstudio`: transforms.json with poses, intrinsics and depth as 16-bit PNG in millimetres.

The data conventions are Nerfstudio's. Camera axes are x right, y up, z backwards. Principal points
count from the image's corner, so pixel centres are at .5. A depth is PNG code × 0.001 in the unit
of the poses, that of the results; scenes that are farther than 16 bits of it have a larger factor.
Nerfstudio takes another factor from its option `--depth-unit-scale-factor`. Instant-NGP reads the
same file; it takes the factor from `integer_depth_scale`. Splatting begins with the points of
start.ply, in the coordinates of the poses.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pnpdepth_cli.commands.exports import Export, ExportFrame
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.io.formats import LARGEST_CODE
from pnpdepth_cli.io.scans import write_cloud

_FACTORS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Units of a code, of which the first is taken that all depths of the frames fit in."""
_START = "start.ply"
"""The points that splatting begins with."""
_LENSES = {
    "radial-tangential": ("OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4")),
    "fisheye": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
"""Nerfstudio's model of each lens, and the names of its coefficients."""


def _depth_image(frame: ExportFrame) -> str:
    """The frame's depth file, below the output folder."""
    return f"depths/{frame.stem}.png"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    """The depth of all frames, the start points and transforms.json."""
    names = [*map(_depth_image, frames), _START, "transforms.json"]
    return [folder / name for name in names]


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    """Writes depth, start points, cameras and poses; returns lines for a person.

    Args:
        folder: Output folder; the folders of the files are there.
        frames: The frames, whose poses are known.
        done: Callback after each frame.

    Raises:
        InputError: The program cannot take the lenses or the depths.
    """
    # The program takes lenses of one kind.
    lenses = sorted({frame.camera.lens for frame in frames})
    if len(lenses) > 1:
        raise InputError(
            f"the cameras have lenses of several kinds ({', '.join(lenses)}), but Nerfstudio takes"
            " one; undistort the images first"
        )
    # Units of a code: Nerfstudio's default, or as many as the farthest depth needs.
    farthest = max(float(frame.valid_depth().max()) for frame in frames)
    large_enough = [factor for factor in _FACTORS if np.rint(farthest / factor) <= LARGEST_CODE]
    if not large_enough:
        raise InputError(f"a depth of {farthest:.4g} is none of a scene; refine the frames again")
    factor = large_enough[0]
    # Depth, points and entry of each frame.
    entries = []
    start_points = []
    for frame in frames:
        entries.append(_entry(folder, frame))
        start_points.append(frame.start_points(len(frames)))
        write_depth(folder / _depth_image(frame), frame.valid_depth(), scale=1 / factor)
        done()
    write_cloud(folder / _START, start_points)
    # Cameras and poses.
    content = {
        "camera_model": _LENSES[lenses[0]][0],
        "enable_depth_loading": True,
        "integer_depth_scale": factor,
        "depth_unit_scale_factor": factor,
        "ply_file_path": _START,
        "frames": entries,
    }
    write_json(folder / "transforms.json", content)
    if factor == _FACTORS[0]:  # Nerfstudio's default, which needs no option
        return []
    unit = frames[0].result.record.unit
    return [
        f"depth: up to {farthest:.4g} {unit}, so a code is {factor:g} {unit}; give ns-train"
        f" `nerfstudio-data --depth-unit-scale-factor {factor:g}`"
    ]


def _entry(folder: Path, frame: ExportFrame) -> dict[str, object]:
    """The frame's entry in transforms.json: its files, pose and camera.

    Args:
        folder: Output folder, which paths of the entry start from.
        frame: The frame.

    Raises:
        InputError: Nerfstudio has no lens with so many coefficients, or the pose is unknown.
    """
    # The coefficients of the lens by name. Those that Nerfstudio has no name for must be 0.
    camera = frame.camera
    _, names = _LENSES[camera.lens]
    coefficients = dict(zip(names, camera.distortion, strict=False))
    if any(camera.distortion[len(names) :]):
        raise InputError(
            f"{frame.image}: Nerfstudio knows no lens {camera.lens} with"
            f" {len(camera.distortion)} coefficients; undistort images first"
        )
    image = os.path.relpath(os.path.realpath(frame.image_path), os.path.realpath(folder))
    # The pose, with Nerfstudio's axes: y up and z backwards, where ours are y down and z forwards.
    matrix = np.eye(4)
    matrix[:3] = frame.known_pose()
    matrix[:3, 1:3] *= -1
    # Principal points count from the image's corner, ours from the middle of the first pixel.
    intrinsics = camera.intrinsics
    return {
        "file_path": Path(image).as_posix(),
        "depth_file_path": _depth_image(frame),  # as Nerfstudio calls it
        "depth_path": _depth_image(frame),  # as Instant-NGP calls it
        "transform_matrix": matrix.tolist(),
        "w": frame.size[1],
        "h": frame.size[0],
        "fl_x": intrinsics[0, 0],
        "fl_y": intrinsics[1, 1],
        "cx": intrinsics[0, 2] + 0.5,
        "cy": intrinsics[1, 2] + 0.5,
        **{name: coefficients.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2")},
    }


EXPORT = Export(
    needs_pose=True, files=_files, write=_write, in_model_units=False, copies_images=True
)
