"""Scores a refined frame, and writes its depth with its companions and record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.commands.refinement.outputs import (
    remove_outdated,
    without_unknown,
    write_outputs,
)
from pnpdepth_cli.commands.requests.refine_request import Outputs, RefineRequest
from pnpdepth_cli.commands.shared.pipeline import peak_memory_mb, timed
from pnpdepth_cli.commands.shared.tables import names_of_depths
from pnpdepth_cli.dataset.depth_files import integer_scale, within_range
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.frame_record import BatchState, FrameRecord
from pnpdepth_cli.dataset.result_record import record_of_frame, record_of_result
from pnpdepth_cli.file_record import FigureRecord
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.io.atomic import all_or_none, make_folder
from pnpdepth_cli.io.formats import format_of_suffix


def write_refined(
    request: RefineRequest,
    outputs: Outputs,
    method: Method,
    inputs: ReadFrame,
    frame: Refined,
    seconds: dict[str, float],
    *,
    batch: BatchState | None = None,
    folder: Path | None = None,
) -> FrameRecord:
    """Scores the refined frame and writes it in place of an earlier result; returns its record.

    The record is written last, so that it names no file that is not there. It is the same from run
    to run, except `seconds` and `peak_memory_mb`.

    Args:
        request: How the frame was refined.
        outputs: The files to write, by kind.
        method: The method that refined it.
        inputs: The frame as it was read.
        frame: The refined frame.
        seconds: Seconds by what they were spent on; gets those of writing.
        batch: What the record keeps for the batch that the frame is of.
        folder: Output folder of that batch, which the record's paths start from.

    Raises:
        OutputError: A file cannot be written.
    """
    # Depth as the file can hold it, and scores of that.
    scale = integer_scale(inputs.own_points, inputs.depth_scale)
    frame = without_unknown(request, inputs, frame)
    frame = within_range(frame, outputs["depth"], scale)
    record = _score(request, method, inputs, frame)
    result = record_of_result(
        frame,
        inputs,
        spec=str(request.files.depths[0]) if frame.networks[0].is_map else request.model,
        holdout=request.holdout,
    )
    make_folder(outputs["depth"].parent, below=folder)
    remove_outdated(outputs)
    with all_or_none(outputs.values()):
        # The depth and its companions.
        with timed(seconds, "write"):
            figures = write_outputs(outputs, inputs, frame, names_of_depths(result))
        # The record, which says which of them there are.
        result = replace(
            result,
            outputs=_outputs_in_record(outputs, figures, folder),
            depth_scale=scale if format_of_suffix(outputs["depth"]).integer else None,
            figures=figures,
            seconds=seconds,
            peak_memory_mb=peak_memory_mb(method.first_member.network.device),
        )
        record = replace(record, batch=batch, result=result)
        if "record" in outputs:
            record.write(outputs["record"])
    return record


def _score(
    request: RefineRequest, method: Method, inputs: ReadFrame, frame: Refined
) -> FrameRecord:
    """The record of the refined frame with its errors and notes, without its result.

    Args:
        request: How the frame was refined.
        method: The method that refined it, whose networks have notes.
        inputs: The frame as it was read.
        frame: The refined frame.
    """
    files = request.files
    name = files.name
    if not name:  # as of a frame that is of no data set
        source = files.image_file or files.sparse
        name = "" if source is None else source.stem
    notes_of_networks = [note for member in method.members for note in member.network.notes]
    return record_of_frame(
        frame,
        inputs,
        name=name,
        group=files.group,
        notes=(*inputs.notes, *notes_of_networks),
        with_baselines=request.baselines,
    )


def _outputs_in_record(
    outputs: Outputs, figures: Mapping[str, FigureRecord], folder: Path | None
) -> dict[str, str]:
    """The files that were written, by kind, as a record names them.

    Args:
        outputs: The files that were to be written. Not every frame can have an improvement map.
        figures: The figures that were written, by kind.
        folder: Output folder of a batch, from which the names start. None: they are as given.
    """
    written = {
        kind: path for kind, path in outputs.items() if kind != "improvement" or kind in figures
    }
    if folder is None:
        return {kind: str(path) for kind, path in written.items()}
    return {kind: path.relative_to(folder).as_posix() for kind, path in written.items()}
