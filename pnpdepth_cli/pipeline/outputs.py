"""The files of a refined frame: planned before the work, written whole after it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, write_depth
from pnpdepth_cli.io.pictures import improvement, improvement_at_points, preview
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.pipeline.frame import RefinedFrame
from pnpdepth_cli.pipeline.inputs import Inputs
from pnpdepth_cli.pipeline.request import RefineRequest

INTEGER_SCALE = 256.0
"""KITTI's scale, for integer output where the sparse depth brought none of its own."""


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Where a frame's results go; all but the depth are None when only a depth file is wanted."""

    depth: Path
    preview: Path | None = None
    improvement: Path | None = None
    record: Path | None = None

    def paths(self) -> list[Path]:
        """Every file that will be written."""
        return [p for p in (self.depth, self.preview, self.improvement, self.record) if p]

    def write_record(self, record: dict[str, Any]) -> None:
        """The record is on disk, if it is wanted there."""
        if self.record is not None:
            write_json(self.record, record)


def plan_outputs(request: RefineRequest) -> Outputs:
    """Where the results go: `-o FILE.exr` for the depth alone, a folder for all of them.

    OutputError if one exists already and may not be replaced, or is one of the inputs.
    """
    source = request.image or request.sparse
    output = request.output or Path(f"{source.stem}_refined")
    if f".{request.format}" not in DEPTH_SUFFIXES:
        raise UsageError(f"format {request.format!r} is not one of {' '.join(DEPTH_SUFFIXES)}")
    if output.suffix.lower() in DEPTH_SUFFIXES:
        outputs = Outputs(depth=output)
    elif output.is_file():
        raise OutputError(
            f"{output} is a file; name a folder, or a depth file ({' '.join(DEPTH_SUFFIXES)})"
        )
    else:
        outputs = Outputs(
            depth=output / f"{source.stem}_depth.{request.format}",
            preview=output / f"{source.stem}_preview.png",
            improvement=output / f"{source.stem}_improvement.png",
            record=output / f"{source.stem}.json",
        )
    given = (request.image, request.sparse, request.gt, request.scan.calib)
    inputs = {p.resolve() for p in given if p is not None}
    for path in outputs.paths():
        if path.resolve() in inputs:
            raise OutputError(f"{path} is one of the inputs; name another output with -o")
        if path.exists() and not request.overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, -o names another place")
    return outputs


def write_outputs(outputs: Outputs, inputs: Inputs, frame: RefinedFrame) -> dict[str, Any]:
    """The depth and its pictures are on disk; returns what the record says of them."""
    folder = outputs.depth.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"folder {folder} cannot be made: {error.strerror}") from None
    write_depth(outputs.depth, frame.after, scale=inputs.sparse_scale or INTEGER_SCALE)
    record: dict[str, Any] = {"improved_share": None}
    if outputs.preview is not None:
        preview(
            inputs.rgb,
            inputs.points.xy.numpy(),
            inputs.points.depth.numpy(),
            frame.before,
            frame.after,
            outputs.preview,
        )
    if outputs.improvement is not None:
        record["improved_share"] = _write_improvement(outputs.improvement, inputs, frame)
    record["outputs"] = {
        "depth": str(outputs.depth),
        "preview": str(outputs.preview) if outputs.preview else None,
        "improvement": str(outputs.improvement) if outputs.improvement else None,
    }
    return record


def _write_improvement(path: Path, inputs: Inputs, frame: RefinedFrame) -> float:
    if inputs.gt is not None:
        return improvement(frame.before, frame.after, inputs.gt, path, rgb=inputs.rgb)
    points = frame.held_out if len(frame.held_out) else frame.used
    return improvement_at_points(
        inputs.rgb if inputs.rgb is not None else frame.before,
        points.xy.numpy(),
        points.depth.numpy(),
        points.sample(torch.from_numpy(frame.before)).numpy(),
        points.sample(torch.from_numpy(frame.after)).numpy(),
        held_out=bool(len(frame.held_out)),
        path=path,
    )
