"""The files of a refined frame: planned before it is computed, and written."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.frames.frame import Refined, is_dense
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.cloud_files import write_cloud
from pnpdepth_cli.io.dataset.frame import IMAGE_SUFFIXES, SCAN_ONLY_SUFFIXES
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, write_depth
from pnpdepth_cli.io.depth_range import metres
from pnpdepth_cli.io.formats import format_of_suffix
from pnpdepth_cli.io.formats.png import LARGEST_CODE
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.io.visualisation import (
    improvement,
    improvement_at_points,
    preview,
    sigma_preview,
    write_mask,
)
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.view_3d import write_view
from pnpdepth_cli.sensors.cloud import cloud_from_depth

Image = NDArray[np.float32]

INTEGER_SCALE = 256.0
"""KITTI's codes per metre, for points that have none of their own and fit."""

_COARSER = (100.0, 10.0, 1.0, 0.1)  # codes per metre where 256 cannot hold the points
_FINER = (1000.0, 10_000.0, 100_000.0)  # where 256 would round them
_BEYOND_POINTS = 1.5  # depths up to this multiple of the farthest point fit
_LEAST_CODES = 25.6  # of the nearest point: 2 % of rounding

_FILE_SUFFIXES = {
    *(*IMAGE_SUFFIXES, *DEPTH_SUFFIXES, *SCAN_ONLY_SUFFIXES),
    *(".hdr", ".bmp", ".mat", ".h5", ".csv", ".json"),
}
"""Suffixes that are taken for those of a file, though a folder's name may have a dot in it."""


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Paths of a frame's results. All but the depth are None when only a depth file is wanted."""

    depth: Path
    sigma: Path | None = None
    sigma_preview: Path | None = None
    valid: Path | None = None
    """Mask of the pixels whose depth is valid."""
    preview: Path | None = None
    """Image of the depth before and after."""
    improvement: Path | None = None
    """Image of what became better and worse."""
    cloud: Path | None = None
    view: Path | None = None
    """3D view for a report."""
    record: Path | None = None
    """JSON of settings and scores."""
    scale: float | None = None
    """Codes per metre of an integer depth file. None: what suits the frame."""
    colors: str = "blue-orange"
    """Colours of better and worse, one of `choices.COLORS`."""
    previews: str = "all"
    """Which results get their images, one of `choices.PREVIEWS`."""

    @classmethod
    def in_folder(cls, folder: Path, name: str, request: RefineRequest) -> Outputs:
        """Returns the paths in a folder, those of σ if wanted; slashes in names are subfolders."""
        sigma = request.hold_out.uncertainty
        return cls(
            depth=folder / f"{name}_depth.{request.outputs.format}",
            sigma=folder / f"{name}_sigma.exr" if sigma else None,
            valid=folder / f"{name}_valid.png" if sigma else None,
            sigma_preview=folder / f"{name}_sigma_preview.png" if sigma else None,
            preview=folder / f"{name}_preview.png",
            improvement=folder / f"{name}_improvement.png",
            previews=request.outputs.previews,
            cloud=folder / f"{name}.ply" if request.outputs.ply else None,
            view=folder / f"{name}_view.json" if request.outputs.view_3d else None,
            record=folder / f"{name}.json",
            scale=request.outputs.output_scale,
            colors=request.outputs.colors,
        )

    def by_kind(self) -> dict[str, Path]:
        """Returns every file that will be written, by its kind."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {kind: path for kind, path in values.items() if isinstance(path, Path)}

    def paths(self) -> list[Path]:
        """Returns every file that will be written."""
        return list(self.by_kind().values())

    def optional(self) -> list[Path]:
        """Returns the images that some results lack."""
        images = (self.preview, self.improvement, self.sigma_preview)
        return [path for path in images if path is not None and self.previews != "all"]

    def without_previews(self, *, worse: bool) -> Outputs:
        """Returns the files to write for a result, without the images that it does not get.

        Args:
            worse: Whether it is worse than linear interpolation.
        """
        if self.previews == "all" or (self.previews == "worst" and worse):
            return self
        return replace(self, preview=None, improvement=None, sigma_preview=None)

    def write_record(self, record: dict[str, Any]) -> None:
        """Writes the record, if it is wanted."""
        if self.record is not None:
            write_json(self.record, record)


def plan_outputs(request: RefineRequest) -> Outputs:
    """Returns the paths of the results: `-o FILE.exr` for the depth alone, a folder for all.

    Raises:
        OutputError: One exists and may not be replaced, or is one of the inputs.
    """
    files, options = request.files, request.outputs
    sources = [files.image, files.sparse, files.gt, files.scan.calib]
    inputs = [path for path in sources if isinstance(path, Path)]
    stem = inputs[0].stem
    output = options.output or Path(f"{stem}_refined")
    if f".{options.format}" not in DEPTH_SUFFIXES:
        raise UsageError(f"format {options.format!r} is not one of {' '.join(DEPTH_SUFFIXES)}")
    added = {"--uncertainty": request.hold_out.uncertainty, "--ply": options.ply}
    if output.suffix.lower() in DEPTH_SUFFIXES and any(added.values()):
        flag = next(flag for flag, requested in added.items() if requested)
        raise UsageError(f"{flag} writes a second file; name a folder, not {output}, with -o")
    if output.suffix.lower() in DEPTH_SUFFIXES:
        outputs = Outputs(depth=output, scale=options.output_scale)
    elif output.suffix.lower() in _FILE_SUFFIXES and not output.is_dir():
        raise OutputError(
            f"{output}: depth is written as {' '.join(DEPTH_SUFFIXES)}, or into a folder"
        )
    elif output.is_file():
        raise OutputError(
            f"{output} is a file; name a folder, or a depth file ({' '.join(DEPTH_SUFFIXES)})"
        )
    else:
        outputs = Outputs.in_folder(output, stem, request)
    resolved = {path.resolve() for path in inputs}
    for path in outputs.paths():
        if path.resolve() in resolved:
            raise OutputError(f"{path} is one of the inputs; name another output with -o")
        if path.exists() and not options.overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, -o names another path")
    return outputs


def output_scale(outputs: Outputs, inputs: Inputs) -> float:
    """Returns the codes per metre of an integer depth file for this frame.

    What the user asks for, else the sparse depth file's own, else 256 unless the points do not fit;
    known before refinement.
    """
    if outputs.scale is not None:
        return outputs.scale
    if inputs.sparse_scale is not None:
        return inputs.sparse_scale
    nearest, farthest = float(inputs.own.depth.min()), float(inputs.own.depth.max())
    scale = INTEGER_SCALE
    for coarser in _COARSER:
        if _BEYOND_POINTS * farthest * scale > LARGEST_CODE:
            scale = coarser
    for finer in _FINER:
        if nearest * scale < _LEAST_CODES and _BEYOND_POINTS * farthest * finer <= LARGEST_CODE:
            scale = finer
    return scale


def within_range(outputs: Outputs, inputs: Inputs, frame: Refined) -> Refined:
    """Returns the frame with depths that the format can hold, with a note if any is clipped."""
    depth_format = format_of_suffix(outputs.depth.suffix)
    if depth_format is None or not depth_format.integer:
        return frame
    scale = output_scale(outputs, inputs)
    nearest, farthest = np.float32(1 / scale), np.float32(LARGEST_CODE / scale)
    known = np.isfinite(frame.after) & (frame.after > 0)
    beyond, below = known & (frame.after > farthest), known & (frame.after < 0.5 / scale)
    notes = [
        f"output: {int(mask.sum()):,} of {mask.size:,} pixels clipped to {metres(float(limit))} m,"
        f" the {extreme} depth of a 16-bit PNG with {scale:g} codes per metre; --format exr holds"
        " every depth"
        for mask, limit, extreme in ((beyond, farthest, "largest"), (below, nearest, "smallest"))
        if mask.any()
    ]
    if not notes:
        return frame
    after = np.where(beyond, farthest, np.where(below, nearest, frame.after))
    return replace(frame, after=after, notes=(*frame.notes, *notes))


def write_outputs(outputs: Outputs, inputs: Inputs, frame: Refined) -> dict[str, Any]:
    """Writes the depth and its images. Returns their entries of the record."""
    image = replace(inputs, register=frame.registration).registered().image
    make_folder(outputs.depth.parent)
    write_depth(outputs.depth, frame.after, scale=output_scale(outputs, inputs))
    if outputs.sigma is not None and frame.sigma is not None:
        write_depth(outputs.sigma, frame.sigma)
    if outputs.sigma_preview is not None and frame.sigma is not None:
        sigma_preview(frame.sigma, frame.valid, outputs.sigma_preview, inputs.unit)
    if outputs.valid is not None and frame.valid is not None:
        write_mask(outputs.valid, frame.valid)
    record: dict[str, Any] = {"improved_fraction": None}
    if outputs.preview is not None:
        preview(
            image,
            inputs.own.xy.numpy(),
            inputs.own.depth.numpy(),
            frame.before,
            frame.after,
            outputs.preview,
            inputs.unit,
            valid=frame.valid,
            linear=None if is_dense(frame.used) else linear(frame.used).numpy(),
        )
    if outputs.improvement is not None:
        record["improved_fraction"] = _write_improvement(
            outputs.improvement, image, inputs, frame, outputs.colors
        )
    if outputs.cloud is not None:
        record["cloud"] = _write_cloud(outputs.cloud, image, inputs, frame)
    if outputs.view is not None:
        write_view(outputs.view, image, inputs, frame)
    kinds = ("depth", "sigma", "valid", "preview", "improvement", "cloud", "view")
    written = outputs.by_kind()
    record["outputs"] = {kind: str(written[kind]) if kind in written else None for kind in kinds}
    return record


def _write_cloud(path: Path, image: Image | None, inputs: Inputs, frame: Refined) -> dict[str, Any]:
    """Writes the cloud of the refined depth, in the world's frame if the pose is known."""
    assert inputs.camera is not None
    cloud = cloud_from_depth(frame.after, inputs.camera.camera, rgb=image, keep=frame.valid)
    pose = inputs.camera.pose
    cloud = cloud if pose is None else cloud.transformed(pose)
    write_cloud(path, cloud.xyz, cloud.normals, cloud.rgb)
    return {"points": len(cloud), "frame": "camera" if pose is None else "world"}


def _write_improvement(
    path: Path, image: Image | None, inputs: Inputs, frame: Refined, colors: str
) -> float:
    if inputs.gt is not None:
        return improvement(frame.before, frame.after, inputs.gt, path, rgb=image, colors=colors)
    points = frame.held_out if len(frame.held_out) else frame.used
    return improvement_at_points(
        image if image is not None else frame.before,
        points.xy.numpy(),
        points.depth.numpy(),
        points.sample(torch.from_numpy(frame.before)).numpy(),
        points.sample(torch.from_numpy(frame.after)).numpy(),
        held_out=bool(len(frame.held_out)),
        path=path,
        unit=inputs.unit,
        colors=colors,
    )
