"""`gaussian-splatting`: inverse depth and depth_params.json for depth-regularised 3DGS.

The code of Kerbl et al. 2023 takes the inverse depth, in the unit of the COLMAP model, as
png / 2^16 · scale + offset: NAME.png of 16 bits in the folder of its option -d, scale and offset of
each image in sparse/0/depth_params.json. It ignores images whose scale is below 0.2 or above 5
times the median, so all images have one scale here.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.pipeline.exports import Export, ExportFrame, distortion_note

_CODES = 2**16
_NEAREST_PERCENTILE = 99.9
"""Of the inverse depth of an image; nearer pixels are clipped, so that few do not set the scale."""


def _depth_image(folder: Path, frame: ExportFrame) -> Path:
    return folder / "inverse_depths" / f"{frame.stem}.png"


def _parameters(folder: Path) -> Path:
    return folder / "sparse" / "0" / "depth_params.json"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    return [*(_depth_image(folder, frame) for frame in frames), _parameters(folder)]


def _write(folder: Path, frames: Sequence[ExportFrame]) -> list[str]:
    scale = max(float(np.percentile(_inverse(frame), _NEAREST_PERCENTILE)) for frame in frames)
    if scale == 0:
        raise InputError("no frame has a pixel with known depth; refine them again")
    unknown, clipped, pixels = 0, 0, 0
    for frame in frames:
        inverse = _inverse(frame)
        codes = np.rint(inverse / scale * _CODES)
        unknown += int((inverse == 0).sum())
        clipped += int((codes > _CODES - 1).sum())
        pixels += codes.size
        _save(_depth_image(folder, frame), np.minimum(codes, _CODES - 1).astype(np.uint16))
    make_folder(_parameters(folder).parent)
    write_json(
        _parameters(folder), {frame.stem: {"scale": scale, "offset": 0.0} for frame in frames}
    )
    notes = [f"depth: {clipped:,} of {pixels:,} pixels are nearer than 1/{scale:.4g}, and clipped"]
    if unknown:
        notes.append(f"warning: {unknown:,} pixels of unknown depth are taken as infinitely far")
    return [*notes, *distortion_note(frames, "3DGS")]


def _inverse(frame: ExportFrame) -> NDArray[np.float64]:
    """(H, W) inverse depth in units of the model, 0 where unknown."""
    depth = frame.read().astype(np.float64) / frame.unit_scale
    return np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)


def _save(path: Path, codes: NDArray[np.uint16]) -> None:
    from PIL import Image

    make_folder(path.parent)
    with atomic_path(path) as temporary:
        Image.fromarray(codes).save(temporary, "PNG")


EXPORT = Export(
    title="inverse depth and depth_params.json of 3D Gaussian splatting",
    needs_pose=False,
    files=_files,
    write=_write,
)
