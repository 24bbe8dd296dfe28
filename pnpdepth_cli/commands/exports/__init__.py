"""`pnpdepth export`: results for reconstruction programs, one file each, in `choices.EXPORTS`.

A new export is one new file in this folder, or an entry point of the group `pnpdepth.exports`, that
holds an `Export` called `EXPORT`.
"""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.choices import EXPORTS
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.results import ResultFrame, result_frames
from pnpdepth_cli.commands.tables import count_of
from pnpdepth_cli.dataset.arrays import image_of_size, read_image
from pnpdepth_cli.dataset.frame_files import ImageSource, name_problem
from pnpdepth_cli.dataset.frame_record import Pose
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.atomic import all_or_none, atomic_path, make_folder
from pnpdepth_cli.io.rgb import sizes_of
from pnpdepth_cli.points import MODEL_UNITS
from pnpdepth_cli.sensors.point_cloud import PointCloud, cloud_from_depth

_START_POINTS = 200_000
"""Number of points of all frames together that a splatting program begins with."""


@dataclass(frozen=True, kw_only=True)
class ExportFrame:
    """A refined frame."""

    result: ResultFrame
    image: ImageSource
    image_path: Path
    """The image in the output folder, or where it is copied to: programs read it there."""
    image_name: str
    """Path of the image below the folder of images, as COLMAP names it, with slashes."""
    size: tuple[int, int]
    """(H, W)."""
    camera: Camera
    pose: Pose | None
    """Pose in the unit of the result. None: unknown."""
    unit_scale: float
    """Units of the depth per unit of the COLMAP model; 1 without a model."""
    unknown: str = "keep"
    """What a program without masks gets of pixels that are not valid: one of `choices.UNKNOWN`."""

    @property
    def stem(self) -> str:
        """The image name without its suffix."""
        return PurePosixPath(self.image_name).with_suffix("").as_posix()

    def valid_depth(self) -> NDArray[np.float32]:
        """Returns the (H, W) depth, 0 where it is unknown or not valid."""
        depth, valid = self.result.read()
        return np.where(valid, depth, np.float32(0))

    def copy_image(self) -> None:
        """Writes the image to its path."""
        from PIL import Image

        with atomic_path(self.image_path) as temporary:
            if isinstance(self.image, Path):
                shutil.copyfile(self.image, temporary)
            else:
                pixels = np.rint(255 * read_image(self.image)).astype(np.uint8)
                Image.fromarray(pixels).save(temporary, "PNG")

    def start_points(self, frames: int) -> PointCloud:
        """Returns the frame's share of the points to begin with, in the world's coordinates."""
        assert self.pose is not None
        rgb = image_of_size(self.image, self.size)
        parts = list(cloud_from_depth(self.valid_depth(), self.camera, rgb))
        step = max(1, sum(len(part.xyz) for part in parts) * frames // _START_POINTS)
        columns = (np.concatenate(column)[::step] for column in zip(*parts, strict=True))
        return PointCloud(*columns).transform(self.pose)


@dataclass(frozen=True, kw_only=True)
class Export:
    """How depth is written for a program."""

    needs_pose: bool
    files: Callable[[Path, Sequence[ExportFrame]], list[Path]]
    write: Callable[[Path, Sequence[ExportFrame], Callable[[], None]], list[str]]
    """Writes them, calls the function after each frame, and returns notes. Raises PnpDepthError.
    The folders of the files are there."""
    in_model_units: bool = True
    """Whether the files are in units of the COLMAP model, if there is one; else in those of the
    results."""
    copies_images: bool = False
    """Whether images that do not lie in the folder are copied there."""


def distortion_note(frames: Sequence[ExportFrame], taker: str) -> list[str]:
    """Returns a warning if images are distorted, for a program that takes undistorted ones."""
    count = sum(frame.camera.has_lens for frame in frames)
    if not count:
        return []
    fact = f"{count:,} of {len(frames):,} images have lens distortion, and so has their depth"
    hint = "run COLMAP's image_undistorter and refine its output"
    return [f"warning: {fact}; {taker} takes undistorted ones: {hint}"]


def export_results(
    results: Path,
    output: Path,
    *,
    to: str,
    overwrite: bool = False,
    unknown: str = "keep",
    show: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[str, list[str]]:
    """Writes the files; returns what they hold in words, and notes, lines for a person.

    Args:
        results: A folder that `refine` or `batch` wrote, or a depth file in it.
        output: The folder to write to; it may hold the images and the model already.
        to: One of `choices.EXPORTS`.
        overwrite: Whether existing files are replaced.
        unknown: One of `choices.UNKNOWN`, for programs that read no masks.
        show: Receives the numbers of frames that are written, and of all.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    export: Export = EXPORTS[to]
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; name a folder")
    # The results, all in one unit.
    found = [_frame(result, export, output) for result in result_frames(results)]
    frames = [replace(frame, unknown=unknown) for frame in found]
    units = sorted({f"{f.result.record.unit} (unit-scale {f.unit_scale:g})" for f in frames})
    if len(units) > 1:
        raise InputError(f"the depths are in different units: {', '.join(units)}; refine all alike")
    # Files of different names, none of which is there.
    copied = [f for f in frames if export.copies_images and f.image_path != f.image]
    written = [*(frame.image_path for frame in copied), *export.files(output, frames)]
    if len(set(written)) < len(written):
        raise InputError(f"{results}: two frames have one image name; refine them again")
    check_outputs(written, overwrite=overwrite)
    # All files, or none.
    for folder in {path.parent for path in written}:
        make_folder(folder)
    numbers = itertools.count(1)
    show(0, len(frames))
    with all_or_none(written):
        for frame in copied:
            frame.copy_image()
        notes = export.write(output, frames, lambda: show(next(numbers), len(frames)))
    of_model = export.in_model_units and frames[0].unit_scale != 1
    unit = MODEL_UNITS if of_model else frames[0].result.record.unit
    return f"{count_of(len(frames), 'frame')} in {unit}", notes


def _frame(result: ResultFrame, export: Export, output: Path) -> ExportFrame:
    record, image, (camera, pose) = result.record, result.image, result.camera_and_pose
    # What the program needs must be in the record.
    if camera is None:
        hint = "refine it with a COLMAP model or --calib"
        raise InputError(f"{result.depth} lacks a record with its camera; {hint}")
    if image is None:
        raise InputError(f"{result.depth} lacks its image: {result.lost_image}")
    if export.needs_pose and pose is None:
        raise InputError(f"{result.depth} lacks a pose in its record; `batch --poses` gives it")
    # The scale and the name of the record must be usable.
    (width, height), sparse = record.size or (0, 0), record.inputs.get("sparse")
    scale = (sparse and sparse.unit_scale) or 1.0
    own = image.name if isinstance(image, Path) else f"{PurePosixPath(result.name).name}.png"
    name = (sparse and sparse.image) or (PurePosixPath(result.name).parent / own).as_posix()
    if not 1e-9 < scale < 1e9 or name_problem(name) or not name.isprintable():
        raise InputError(f"{result.depth}: the record beside it is damaged; refine it again")
    # The depth must be of the whole image.
    if isinstance(image, Path) and (height, width) not in sizes_of(image):
        hint = "refine the whole image (--protocol whole)"
        raise InputError(f"{result.depth} is not of the size of {image}; {hint}")
    path = output / "images" / name
    if isinstance(image, Path):
        real_image = Path(os.path.realpath(image))
        if real_image.is_relative_to(os.path.realpath(output)):
            path = image
    return ExportFrame(
        result=result,
        image=image,
        image_path=path,
        image_name=name,
        size=(height, width),
        camera=camera,
        pose=pose,
        unit_scale=scale,
    )
