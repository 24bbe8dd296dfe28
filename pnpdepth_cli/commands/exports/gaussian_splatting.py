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
_PARAMETERS = "depth_params.json"
_OURS = b"# Of pnpdepth export: the refined images, points of their depth\n"
_NEAREST_PERCENTILE = 99.9
"""Percentile of an image's inverse depth, so that few near pixels do not set the scale."""


def _depth_image(folder: Path, frame: ExportFrame) -> Path:
    return folder / "inverse_depths" / f"{frame.stem}.png"


def _model(folder: Path) -> Path:
    return folder / "sparse" / "0"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    names = [_PARAMETERS]
    if _needs_model(folder, frames):
        names += [f"{name}.txt" for name in MODEL_PARTS]
    depths = (_depth_image(folder, frame) for frame in frames)
    return [*depths, *(_model(folder) / name for name in names)]


def _needs_model(folder: Path, frames: Sequence[ExportFrame]) -> bool:
    """Whether no other's model is in sparse/0/, and one without distortion can be made."""
    usable = all(frame.pose is not None and not frame.camera.has_lens for frame in frames)
    there = model_files(_model(folder))
    return usable and (not there or there[0].read_bytes().startswith(_OURS))


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    # One scale for the inverse depth of all frames.
    scale = max(np.percentile(_inverse(frame)[0], _NEAREST_PERCENTILE) for frame in frames)
    if scale == 0:
        raise InputError("no frame has a pixel with known depth; refine them again")
    if _needs_model(folder, frames):
        _write_model(_model(folder), frames)
    # Depth and image of each frame.
    largest = scale * LARGEST_CODE / _CODES
    masked = clipped = 0
    for frame in frames:
        inverse, valid = _inverse(frame)
        masked += int((~valid).sum())
        clipped += int((inverse > largest).sum())
        fitting = np.clip(inverse, scale / _CODES, largest).astype(np.float32)
        if frame.unknown == "zero":
            fitting = np.where(valid, fitting, np.float32(0))
        write_depth(_depth_image(folder, frame), fitting, scale=_CODES / scale)
        done()
    # What the program reads the codes with.
    parameters = {"scale": float(scale), "offset": 0.0}
    write_json(_model(folder) / _PARAMETERS, {frame.stem: parameters for frame in frames})
    notes = [f"depth: {clipped:,} pixels are nearer than 1/{scale:.4g}, and clipped"]
    if masked:
        depth = "the depth before the mask or that of the nearest pixel, as 3DGS reads no masks"
        if frames[0].unknown == "zero":
            depth = "0, which 3DGS reads as infinitely far"
        notes.append(f"warning: {masked:,} pixels are unknown or not valid; they have {depth}")
    if not model_files(_model(folder)):
        notes.append(
            "warning: sparse/0 has no model, which 3DGS needs to train; refine undistorted images"
            " with poses"
        )
    return [*notes, *distortion_note(frames, "3DGS")]


def _inverse(frame: ExportFrame) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(H, W) inverse depth in units of the model, and where the depth is known and valid."""
    depth, valid = frame.result.read()
    known = depth > 0
    if not known.any():
        return np.zeros(depth.shape), valid
    if not known.all():
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        depth = depth[tuple(nearest)]
    return frame.unit_scale / depth.astype(np.float64), valid


def _write_model(folder: Path, frames: Sequence[ExportFrame]) -> None:
    """Writes cameras, poses, and points of the depth as text of COLMAP, in units of the model."""
    lines = {name: [_OURS.decode()] for name in MODEL_PARTS}
    for number, frame in enumerate(frames, 1):
        cloud = frame.start_points(len(frames))
        pose = frame.placed()
        unit = frame.unit_scale
        (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics
        height, width = frame.size
        # COLMAP counts pixels from the image's corner, and its poses lead to the camera
        lens = f"{fx} {fy} {cx + 0.5} {cy + 0.5}"
        x, y, z, w = Rotation.from_matrix(pose[:, :3].T).as_quat()
        shift = " ".join(map(str, -pose[:, :3].T @ pose[:, 3] / unit))
        lines["cameras"].append(f"{number} PINHOLE {width} {height} {lens}\n")
        lines["images"].append(f"{number} {w} {x} {y} {z} {shift} {number} {frame.image_name}\n\n")
        colours = () if cloud.rgb is None else cloud.rgb
        for point, (red, green, blue) in zip(cloud.xyz / unit, colours, strict=True):
            place = " ".join(f"{value:.7g}" for value in point)
            index = len(lines["points3D"])
            lines["points3D"].append(f"{index} {place} {red} {green} {blue} 0\n")
    for name, text in lines.items():
        write_text(folder / f"{name}.txt", "".join(text))


EXPORT = Export(needs_pose=False, files=_files, write=_write, copies_images=True)
