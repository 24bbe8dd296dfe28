"""`pnpdepth export`: results for reconstruction programs, by the entries of `choices.EXPORTS`."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from pnpdepth_cli.choices import EXPORTS
from pnpdepth_cli.commands.exports import Export, ExportFrame
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.shared.results import ResultFrame, result_frames
from pnpdepth_cli.commands.shared.tables import count_of
from pnpdepth_cli.dataset.frame_files import ImageSource, name_problem
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.atomic import all_or_none, make_folder
from pnpdepth_cli.io.rgb import sizes_of
from pnpdepth_cli.points import MODEL_UNITS

_LEAST_SCALE = 1e-9
_LARGEST_SCALE = 1e9
"""Units of depth per unit of a COLMAP model, outside of which no real one is."""


def export_results(
    results: Path,
    output: Path,
    *,
    to: str,
    overwrite: bool = False,
    unknown: str = "keep",
    show: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[str, list[str]]:
    """Writes the files of a program; returns what they hold in words, and lines for a person.

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
    frames = [
        replace(_frame(result, export, output), unknown=unknown)
        for result in result_frames(results)
    ]
    _check_units(frames)
    # Files of different names, none of which is there. Images in the folder stay where they are.
    copied = list[ExportFrame]()
    if export.copies_images:
        copied = [frame for frame in frames if frame.image_path != frame.image]
    written = [*(frame.image_path for frame in copied), *export.files(output, frames)]
    if len(set(written)) < len(written):
        raise InputError(f"{results}: two frames have one image name; refine them again")
    check_outputs(written, overwrite=overwrite)
    # All files, or none.
    for folder in {path.parent for path in written}:
        make_folder(folder)
    numbers = itertools.count(1)

    def on_frame() -> None:
        """Shows that one more frame is written."""
        show(next(numbers), len(frames))

    show(0, len(frames))
    with all_or_none(written):
        for frame in copied:
            frame.copy_image()
        notes = export.write(output, frames, on_frame)
    # The unit of the depths, which the files themselves do not say.
    unit = frames[0].result.record.unit
    if export.in_model_units and frames[0].unit_scale != 1:
        unit = MODEL_UNITS
    return f"{count_of(len(frames), 'frame')} in {unit}", notes


def _check_units(frames: Sequence[ExportFrame]) -> None:
    """Raises InputError unless the depths of all frames are in one unit."""
    units = sorted(
        {f"{frame.result.record.unit} (unit-scale {frame.unit_scale:g})" for frame in frames}
    )
    if len(units) > 1:
        raise InputError(f"the depths are in different units: {', '.join(units)}; refine all alike")


def _frame(result: ResultFrame, export: Export, output: Path) -> ExportFrame:
    """The result with its image, camera and pose, as an export needs it.

    Args:
        result: The depth file, and what lies beside it.
        export: The export, which may need a pose.
        output: The output folder; an image that is not in it gets a place there.

    Raises:
        InputError: The record lacks what is needed or is damaged, or the depth is of a part of the
            image.
    """
    image = result.image
    camera, pose = result.camera_and_pose
    # What the program needs must be in the record.
    if camera is None:
        raise InputError(
            f"{result.depth} lacks a record with its camera; refine it with a COLMAP model or"
            " --calib"
        )
    if image is None:
        raise InputError(f"{result.depth} lacks its image: {result.lost_image}")
    if export.needs_pose and pose is None:
        raise InputError(f"{result.depth} lacks a pose in its record; `batch --poses` gives it")
    # Where the points are a COLMAP model's, the record has its unit and its name of the image.
    # Both must be usable.
    sparse = result.record.inputs.get("sparse")
    unit_scale = 1.0
    name = _image_name(result, image)
    if sparse is not None:
        unit_scale = sparse.unit_scale or unit_scale
        name = sparse.image or name
    is_scale_usable = _LEAST_SCALE < unit_scale < _LARGEST_SCALE
    is_name_usable = name_problem(name) is None and name.isprintable()
    if not is_scale_usable or not is_name_usable:
        raise InputError(f"{result.depth}: the record beside it is damaged; refine it again")
    # The depth must be of the whole image, whose size only a file tells without being read. A
    # record with a camera has a size.
    size = result.size or (0, 0)
    if isinstance(image, Path) and size not in sizes_of(image):
        raise InputError(
            f"{result.depth} is not of the size of {image}; refine the whole image (--protocol"
            " whole)"
        )
    return ExportFrame(
        result=result,
        image=image,
        image_path=_image_path(image, output, name),
        image_name=name,
        size=size,
        camera=camera,
        pose=pose,
        unit_scale=unit_scale,
    )


def _image_path(image: ImageSource, output: Path, name: str) -> Path:
    """Where a program reads the image: where it is, if that is in the output folder, else a copy.

    Args:
        image: The image: a file, or a frame of a video.
        output: The output folder.
        name: Name of the image below the folder of images.
    """
    folder = Path(os.path.realpath(output))
    if isinstance(image, Path) and Path(os.path.realpath(image)).is_relative_to(folder):
        return image
    return output / "images" / name


def _image_name(result: ResultFrame, image: ImageSource) -> str:
    """The path of the image below the folder of images, with slashes.

    Its folder is that of the result's name. An image keeps its file name. A frame of a video gets
    the name of its result, as a PNG.
    """
    frame = PurePosixPath(result.name)
    file_name = image.name if isinstance(image, Path) else f"{frame.name}.png"
    return (frame.parent / file_name).as_posix()
