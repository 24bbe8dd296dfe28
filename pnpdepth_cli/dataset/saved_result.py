"""Writes a frame that was refined in Python, as the command line writes one of files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.dataset.depth_files import integer_scale, within_range, write_sigma
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.result_record import record_of_frame, record_of_result
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.io.atomic import all_or_none, make_folder, remove_file
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.formats import format_of_suffix
from pnpdepth_cli.io.visualisation import write_mask


def save(refined: Refined, path: Path, *, overwrite: bool) -> None:
    """Writes the depth and its record, and σ with its mask if they are known: all or none.

    Args:
        refined: The refined frame.
        path: The depth file; its suffix names the format.
        overwrite: Whether existing files are replaced.

    Raises:
        OutputError: A file exists, cannot be written, or has the suffix of no format.
    """
    # The files: NAME.json is the record of NAME_depth.png and of NAME.png.
    format_of_suffix(path)
    name = path.stem.removesuffix("_depth")
    outputs = {"depth": path}
    if refined.sigma is not None and refined.valid is not None:
        outputs["sigma"] = path.with_name(f"{name}_sigma{path.suffix}")
        outputs["valid"] = path.with_name(f"{name}_valid.png")
    outputs["record"] = path.with_name(f"{name}.json")
    for file in outputs.values():
        if file.exists() and not overwrite:
            raise OutputError(f"{file} exists; overwrite=True replaces it, or name another file")
    # The record of a frame of arrays has no files.
    points = refined.used
    frame = ReadFrame(
        rgb=None,
        points=points,
        own_points=points,
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
    record = replace(record_of_frame(refined, frame, name=name), result=result)
    # An earlier record goes first and the new one comes last, so that none is of two results.
    make_folder(path.parent)
    remove_file(outputs["record"])
    with all_or_none(outputs.values()):
        write_depth(path, refined.depth, scale=scale)
        if refined.sigma is not None and refined.valid is not None:
            write_sigma(outputs["sigma"], refined.sigma)
            write_mask(outputs["valid"], refined.valid)
        record.write(outputs["record"])
