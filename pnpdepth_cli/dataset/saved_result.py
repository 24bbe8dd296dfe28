"""Writes a frame that was refined in Python, as the command line writes one of files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.dataset.depth_files import integer_scale, within_range, write_sigma
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.result_record import record_of_frame, record_of_result
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.io.atomic import all_or_none, make_folder
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.formats import format_of_suffix
from pnpdepth_cli.io.visualisation import write_mask


def save(refined: Refined, path: str | Path, *, overwrite: bool = False) -> None:
    """Writes the depth of a refined frame, and its record beside it, as the command line does.

    `room.png` gets the record `room.json`; with a standard deviation also `room_sigma.png` and the
    mask `room_valid.png`. A 16-bit PNG has 256 integers per metre, or as many as the points need,
    in its text chunk and the record; depth that it cannot hold is clipped, which the record says.

    Args:
        refined: Refined frame, as `refine` returns it.
        path: The depth file; its suffix names the format, such as .png, .exr, .npy or .tiff.
        overwrite: Whether existing files are replaced.

    Raises:
        OutputError: A file exists, cannot be written, or has the suffix of no format.
    """
    path = Path(path)
    format_of_suffix(path)
    # The files, none of which may exist.
    outputs = {"depth": path}
    if refined.sigma is not None and refined.valid is not None:
        outputs["sigma"] = path.with_name(f"{path.stem}_sigma{path.suffix}")
        outputs["valid"] = path.with_name(f"{path.stem}_valid.png")
    outputs["record"] = path.with_suffix(".json")
    for file in outputs.values():
        if file.exists() and not overwrite:
            raise OutputError(f"{file} exists; give overwrite=True, or another path")
    # The record of a frame of arrays has no files.
    points = refined.used
    frame = ReadFrame(
        rgb=None,
        points=points,
        own=points,
        held_out=points.select(slice(0)),
        camera=refined.camera,
    )
    scale = integer_scale(points)
    refined = within_range(refined, path, scale)
    result = replace(
        record_of_result(refined, frame),
        outputs={kind: str(file) for kind, file in outputs.items()},
        depth_scale=scale if format_of_suffix(path).integer else None,
    )
    record = replace(record_of_frame(refined, frame, name=path.stem), result=result)
    # The record is written last, so that none names files that are not there.
    make_folder(path.parent)
    with all_or_none(outputs.values()):
        write_depth(path, refined.depth, scale=scale)
        if refined.sigma is not None and refined.valid is not None:
            write_sigma(outputs["sigma"], refined.sigma)
            write_mask(outputs["valid"], refined.valid)
        record.write(outputs["record"])
