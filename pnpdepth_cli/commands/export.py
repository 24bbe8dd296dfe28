"""`pnpdepth export`: results for reconstruction programs, by the entries of `choices.EXPORTS`."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath

from pnpdepth_cli.choices import EXPORTS
from pnpdepth_cli.commands.exports import Export, ExportFrame
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.shared.results import ResultFrame, result_frames
from pnpdepth_cli.commands.shared.tables import count_of
from pnpdepth_cli.dataset.frame_files import name_problem
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.atomic import all_or_none, make_folder
from pnpdepth_cli.io.rgb import sizes_of
from pnpdepth_cli.points import MODEL_UNITS


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
        raise InputError(
            f"{result.depth} lacks a record with its camera; refine it with a COLMAP model or"
            " --calib"
        )
    if image is None:
        raise InputError(f"{result.depth} lacks its image: {result.lost_image}")
    if export.needs_pose and pose is None:
        raise InputError(f"{result.depth} lacks a pose in its record; `batch --poses` gives it")
    # The scale and the name of the record must be usable.
    size = result.size or (0, 0)
    sparse = record.inputs.get("sparse")
    scale = (sparse and sparse.unit_scale) or 1.0
    own = image.name if isinstance(image, Path) else f"{PurePosixPath(result.name).name}.png"
    name = (sparse and sparse.image) or (PurePosixPath(result.name).parent / own).as_posix()
    if not 1e-9 < scale < 1e9 or name_problem(name) or not name.isprintable():
        raise InputError(f"{result.depth}: the record beside it is damaged; refine it again")
    # The depth must be of the whole image.
    if isinstance(image, Path) and size not in sizes_of(image):
        raise InputError(
            f"{result.depth} is not of the size of {image}; refine the whole image (--protocol"
            " whole)"
        )
    path = output / "images" / name
    folder = Path(os.path.realpath(output))
    if isinstance(image, Path) and Path(os.path.realpath(image)).is_relative_to(folder):
        path = image
    return ExportFrame(
        result=result,
        image=image,
        image_path=path,
        image_name=name,
        size=size,
        camera=camera,
        pose=pose,
        unit_scale=scale,
    )
