"""`pnpdepth export`: results for reconstruction programs, one file each, in `choices.EXPORTS`.

A new export is one new file in this folder, or an entry point of the group `pnpdepth.exports`, that
holds an `Export` called `EXPORT`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import __version__
from pnpdepth_cli.camera import Camera
from pnpdepth_cli.choices import EXPORTS
from pnpdepth_cli.commands.results import ResultFrame, result_frames
from pnpdepth_cli.dataset.frame_camera import Pose
from pnpdepth_cli.errors import FileFormatError, InputError, OutputError, SizeError
from pnpdepth_cli.io.atomic import all_or_none, atomic_path, make_folder
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.io.rgb import sizes_of

_LONGEST_NAME = 200
"""Bytes of a name of a record that becomes a path."""


@dataclass(frozen=True, kw_only=True)
class ExportFrame:
    """A refined frame."""

    result: ResultFrame
    image: Path
    image_name: str
    """Its path below the folder of the images, as COLMAP names it, with slashes."""
    size: tuple[int, int]
    """(H, W)."""
    camera: Camera
    pose: Pose | None
    """In the unit of the result. None: unknown."""
    unit_scale: float
    """Units of the depth per unit of the COLMAP model; 1 without a model."""
    farthest: float

    @property
    def stem(self) -> str:
        """The image name without its suffix."""
        return PurePosixPath(self.image_name).with_suffix("").as_posix()

    def valid_depth(self) -> NDArray[np.float32]:
        """Returns the (H, W) depth, 0 where it is unknown or not valid."""
        depth, valid = self.result.read()
        return np.where(valid, depth, np.float32(0))


@dataclass(frozen=True, kw_only=True)
class Export:
    """How depth is written for a program."""

    needs_pose: bool
    files: Callable[[Path, Sequence[ExportFrame]], list[Path]]
    write: Callable[[Path, Sequence[ExportFrame]], list[str]]
    """Writes them and returns notes. Raises PnpDepthError."""


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yields a temporary file that becomes the path, whose folder is created."""
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        yield temporary


def distortion_note(frames: Sequence[ExportFrame], taker: str) -> list[str]:
    """Returns a warning if images are distorted, for a program that takes undistorted ones."""
    count = sum(frame.camera.has_lens for frame in frames)
    if not count:
        return []
    return [
        f"warning: {count:,} of {len(frames):,} images have lens distortion, and so has their"
        f" depth; {taker} takes undistorted ones: run COLMAP's image_undistorter and refine its"
        " output"
    ]


def export_results(
    results: Path, output: Path, *, to: str, overwrite: bool = False
) -> dict[str, Any]:
    """Writes the files and `export_NAME.json`, and returns what that holds.

    Args:
        results: A folder that `refine` or `batch` wrote, or a depth file in it.
        output: The folder to write to; it may hold the images and the model already.
        to: One of `choices.EXPORTS`.
        overwrite: Whether existing files are replaced.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    export: Export = EXPORTS[to]
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; name a folder")
    frames = [_frame(result, export) for result in result_frames(results)]
    units = sorted({f"{f.result.unit} (unit-scale {f.unit_scale:g})" for f in frames})
    if len(units) > 1:
        raise InputError(f"the depths are in different units: {', '.join(units)}; refine all alike")
    written = [*export.files(output, frames), output / f"export_{to}.json"]
    if len(set(written)) < len(written):
        raise InputError(f"{results}: two frames have one image name; refine them again")
    for path in written:
        if path.exists() and not overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, -o names another folder")
    make_folder(output)
    record: dict[str, Any] = {
        "command": "export",
        "version": __version__,
        "to": to,
        "results": str(results),
        "frames": len(frames),
        "unit": frames[0].result.unit,
    }
    with all_or_none(written):
        record["notes"] = export.write(output, frames)
        record["files"] = [path.as_posix() for path in written[:-1]]
        write_json(written[-1], record)
    return record


def _frame(result: ResultFrame, export: Export) -> ExportFrame:
    record, image, (camera, pose) = result.record, result.image, result.camera_and_pose
    if camera is None or not isinstance(image, Path):
        lacks = "its image; run this in the folder where it was refined, or refine it again"
        if camera is None:
            lacks = "a record with its camera; refine it with a COLMAP model or --calib"
        raise InputError(f"{result.depth} lacks {lacks}")
    if export.needs_pose and pose is None:
        raise InputError(
            f"{result.depth} has no pose in its record; refine it with a COLMAP model, as"
            " `batch --layout colmap` does"
        )
    try:
        width, height = map(operator.index, record["size"])
        sparse = dict(record["inputs"]["sparse"])
        numbers = float(record["points"]["farthest"]), float(sparse.get("unit_scale") or 1)
        name = sparse.get("image") or (PurePosixPath(result.name).parent / image.name).as_posix()
        if not all(1e-9 < number < 1e9 for number in numbers) or not _is_fit(name):
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{result.depth}: the record beside it is damaged; refine it again"
        ) from error
    if (height, width) not in sizes_of(image):
        raise SizeError(
            f"{result.depth} is not of the size of {image}; refine the whole image"
            " (--protocol whole)"
        )
    return ExportFrame(
        result=result,
        image=image,
        image_name=name,
        size=(height, width),
        camera=camera,
        pose=pose,
        unit_scale=numbers[1],
        farthest=numbers[0],
    )


def _is_fit(name: Any) -> bool:
    """Whether a name of a record is fit for a file: relative, inside, printable, not long."""
    path = PurePosixPath(name)  # TypeError if it is no text
    inside = path.parts and not path.is_absolute() and ".." not in path.parts
    long = len(name.encode("utf-8", "surrogateescape")) > _LONGEST_NAME
    return bool(inside) and name.isprintable() and "\\" not in name and not long
