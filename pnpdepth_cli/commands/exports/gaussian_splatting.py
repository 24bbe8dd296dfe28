"""`gaussian-splatting`: inverse depth and depth_params.json for depth-regularised 3DGS.

The code of Kerbl et al. 2023 takes the inverse depth, in the unit of the COLMAP model, as
png / 2^16 · scale + offset. NAME.png has 16 bits and lies in the folder of its option -d. Scale and
offset of each image are in sparse/0/depth_params.json. The code ignores images whose scale is below
0.2 or above 5 times the median, so all images have one scale here.

The code takes 0 for infinitely far and reads no masks, so every pixel has a depth. A pixel that is
not valid keeps its own. An unknown one has that of the nearest known pixel. With `unknown` "zero"
both are 0, as is right of a sky, and as trainers that leave out pixels without depth read it.
Unless a model is there, sparse/0/ gets one of the refined images with points of their depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from pnpdepth_cli.commands.exports import Export, ExportFrame, distortion_note
from pnpdepth_cli.commands.shared.tables import write_text
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.colmap_model import MODEL_PARTS, model_files
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.io.formats import LARGEST_CODE

_CODES = 2**16
"""What 3DGS divides the codes of a 16-bit PNG by."""
_PARAMETERS = "depth_params.json"
_OURS = b"# Of pnpdepth export: the refined images, points of their depth\n"
"""First line of the files of a model that an earlier export wrote, and that may be replaced."""
_NEAREST_PERCENTILE = 99.9
"""Percentile of an image's inverse depth, so that few near pixels do not set the scale."""


def _depth_image(folder: Path, frame: ExportFrame) -> Path:
    """The PNG of a frame's inverse depth."""
    return folder / "inverse_depths" / f"{frame.stem}.png"


def _model(folder: Path) -> Path:
    """The folder in which 3DGS looks for the COLMAP model."""
    return folder / "sparse" / "0"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    """The inverse depth of all frames, its scale, and the model unless there is one already."""
    names = [_PARAMETERS]
    if _needs_model(folder, frames):
        names += [f"{file}.txt" for file in MODEL_PARTS]
    depths = [_depth_image(folder, frame) for frame in frames]
    return [*depths, *(_model(folder) / name for name in names)]


def _needs_model(folder: Path, frames: Sequence[ExportFrame]) -> bool:
    """Whether a model is written: it can be made, and none but one of ours is in sparse/0/.

    It can be made if all poses are known and no image is distorted, as 3DGS has no lenses.
    """
    can_be_made = all(frame.pose is not None and not frame.camera.has_lens for frame in frames)
    if not can_be_made:
        return False
    present = model_files(_model(folder))
    return not present or present[0].read_bytes().startswith(_OURS)


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    """Writes inverse depth, its scale, and a model if it needs one; returns lines for a person.

    Args:
        folder: Output folder; the folders of the files are there.
        frames: The frames.
        done: Callback after each frame.

    Raises:
        InputError: No frame has known depth.
    """
    # One scale for the inverse depth of all frames.
    scale = max(np.percentile(_inverse(frame)[0], _NEAREST_PERCENTILE) for frame in frames)
    if scale == 0:
        raise InputError("no frame has a pixel with known depth; refine them again")
    if _needs_model(folder, frames):
        _write_model(_model(folder), frames)
    # The inverse depth of each frame. Code 0 is infinitely far, so every pixel has 1 or more.
    largest = scale * LARGEST_CODE / _CODES
    masked = clipped = 0
    for frame in frames:
        inverse, valid = _inverse(frame)
        masked += int((~valid).sum())
        clipped += int((inverse > largest).sum())
        in_range = np.clip(inverse, scale / _CODES, largest).astype(np.float32)
        if frame.unknown == "zero":
            in_range = np.where(valid, in_range, np.float32(0))
        write_depth(_depth_image(folder, frame), in_range, scale=_CODES / scale)
        done()
    # What the program reads the codes with.
    parameters = {"scale": float(scale), "offset": 0.0}
    write_json(_model(folder) / _PARAMETERS, {frame.stem: parameters for frame in frames})
    # What was changed, and what the program lacks.
    notes = [f"depth: {clipped:,} pixels are nearer than 1/{scale:.4g}, and clipped"]
    if masked:
        content = "the depth before the mask or that of the nearest pixel, as 3DGS reads no masks"
        if frames[0].unknown == "zero":  # the same for all frames
            content = "0, which 3DGS reads as infinitely far"
        notes.append(f"warning: {masked:,} pixels are unknown or not valid; they have {content}")
    if not model_files(_model(folder)):
        notes.append(
            "warning: sparse/0 has no model, which 3DGS needs to train; refine undistorted images"
            " with poses"
        )
    return [*notes, *distortion_note(frames, "3DGS")]


def _inverse(frame: ExportFrame) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(H, W) inverse depth in units of the model, and (H, W) where the depth is known and valid.

    Unknown pixels have the inverse depth of the nearest known one; 0 if no pixel is known.
    """
    depth, valid = frame.result.read()
    known = depth > 0
    if not known.any():
        return np.zeros(depth.shape), valid
    if not known.all():
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        depth = depth[tuple(nearest)]
    return frame.unit_scale / depth.astype(np.float64), valid


def _write_model(folder: Path, frames: Sequence[ExportFrame]) -> None:
    """Writes cameras, images with poses, and points of the depth as COLMAP's text files.

    Lengths are in units of the model. Camera, image and frame have one number, from 1.

    Args:
        folder: The folder of the model.
        frames: The frames, whose poses are known and whose cameras have no lens.
    """
    # The lines of each file, below one by which a later export knows the file as its own.
    lines = {file: [_OURS.decode()] for file in MODEL_PARTS}
    for number, frame in enumerate(frames, 1):
        # The camera; COLMAP counts pixels from the image's corner, not from a pixel's centre.
        (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics
        height, width = frame.size
        lens = f"{fx} {fy} {cx + 0.5} {cy + 0.5}"
        lines["cameras"].append(f"{number} PINHOLE {width} {height} {lens}\n")
        # The image; COLMAP's poses lead from the world to the camera. Its second line, of points
        # in the image, is empty.
        unit = frame.unit_scale
        pose = frame.known_pose()
        to_camera = pose[:, :3].T
        x, y, z, w = Rotation.from_matrix(to_camera).as_quat()
        shift = " ".join(map(str, -to_camera @ pose[:, 3] / unit))
        lines["images"].append(f"{number} {w} {x} {y} {z} {shift} {number} {frame.image_name}\n\n")
        # The points, with a colour and no error. Their numbers count from 1, as the first line is
        # no point.
        cloud = frame.start_points(len(frames))
        assert cloud.rgb is not None  # the image colours all of them
        for point, (red, green, blue) in zip(cloud.xyz / unit, cloud.rgb, strict=True):
            place = " ".join(f"{value:.7g}" for value in point)
            point_number = len(lines["points3D"])
            lines["points3D"].append(f"{point_number} {place} {red} {green} {blue} 0\n")
    for file, text in lines.items():
        write_text(folder / f"{file}.txt", "".join(text))


EXPORT = Export(needs_pose=False, files=_files, write=_write, copies_images=True)
