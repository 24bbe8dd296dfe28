"""`gaussian-splatting`: inverse depth and depth_params.json for depth-regularised 3DGS.

The code of Kerbl et al. 2023 takes the inverse depth, in the unit of the COLMAP model, as
png / 2^16 · scale + offset: NAME.png of 16 bits in the folder of its option -d, scale and offset of
each image in sparse/0/depth_params.json. It ignores images whose scale is below 0.2 or above 5
times the median, so all images have one scale here. It takes 0 for infinitely far and reads no
masks, so every pixel has a depth: one that is not valid its own, one that is unknown that of the
nearest known pixel. depth_masks/NAME.png is 0 at both, for other programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from pnpdepth_cli.commands.exports import Export, ExportFrame, distortion_note, new_file
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.record import write_json

_CODES = 2**16
_NEAREST_PERCENTILE = 99.9
"""Of the inverse depth of an image; nearer pixels are clipped, so that few do not set the scale."""


def _depth_image(folder: Path, frame: ExportFrame) -> Path:
    return folder / "inverse_depths" / f"{frame.stem}.png"


def _parameters(folder: Path) -> Path:
    return folder / "sparse" / "0" / "depth_params.json"


def _mask(folder: Path, frame: ExportFrame) -> Path:
    return folder / "depth_masks" / f"{frame.stem}.png"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    images = [path(folder, frame) for frame in frames for path in (_depth_image, _mask)]
    return [*images, _parameters(folder)]


def _write(folder: Path, frames: Sequence[ExportFrame]) -> list[str]:
    scale = max(np.percentile(_inverse(frame)[0], _NEAREST_PERCENTILE) for frame in frames)
    if scale == 0:
        raise InputError("no frame has a pixel with known depth; refine them again")
    masked, clipped, pixels = 0, 0, 0
    for frame in frames:
        inverse, valid = _inverse(frame)
        codes = np.rint(inverse / scale * _CODES)
        masked += int((~valid).sum())
        clipped += int((codes > _CODES - 1).sum())
        pixels += codes.size
        _save(_depth_image(folder, frame), np.minimum(codes, _CODES - 1).astype(np.uint16))
        _save(_mask(folder, frame), valid.astype(np.uint8) * np.uint8(255))
    make_folder(_parameters(folder).parent)
    parameters = {"scale": float(scale), "offset": 0.0}
    write_json(_parameters(folder), {frame.stem: parameters for frame in frames})
    notes = [f"depth: {clipped:,} of {pixels:,} pixels are nearer than 1/{scale:.4g}, and clipped"]
    if masked:
        notes.append(
            f"warning: {masked:,} pixels are unknown or not valid; they have the depth before"
            " the mask or that of the nearest pixel, and are 0 in depth_masks/"
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


def _save(path: Path, pixels: NDArray[np.uint16] | NDArray[np.uint8]) -> None:
    from PIL import Image

    with new_file(path) as temporary:
        Image.fromarray(pixels).save(temporary, "PNG")


EXPORT = Export(needs_pose=False, files=_files, write=_write)
