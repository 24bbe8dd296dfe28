"""Plans and writes the files of a refined frame, with its 3D view for the report of a batch."""

from __future__ import annotations

import base64
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.requests.refine_request import Outputs, RefineRequest, endings_of
from pnpdepth_cli.completion.interpolation import in_hull, linear
from pnpdepth_cli.dataset.depth_files import integer_scale, write_sigma
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.file_record import FigureRecord
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.io.atomic import remove_file
from pnpdepth_cli.io.colours import depth_scale
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, write_depth
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.io.formats import LARGEST_CODE
from pnpdepth_cli.io.visualisation import (
    PointErrors,
    improvement,
    improvement_at_points,
    preview,
    write_mask,
)
from pnpdepth_cli.measures import AFTER, BEFORE, LINEAR
from pnpdepth_cli.scan_pattern import scan_pattern
from pnpdepth_cli.sensors.lens import rays_of
from pnpdepth_cli.sensors.point_cloud import kept_pixels

_LEAST_NOTED = 0.1
"""Fraction of an image outside of the points above which a note says so."""

LARGEST_VIEW = 200_000
"""Most points of a 3D view, but for what its borders round."""

_RAY_NODES = 64
"""Nodes of the grid of directions along the longer side: exact to 1e-4 of it for strong lenses."""

_LEAST_RATIO = 1.001
"""Least ratio of the farthest depth of a 3D view to the nearest, so that codes differ."""


def plan_outputs(request: RefineRequest) -> Outputs:
    """Returns the files of the result by kind: the depth alone for `-o FILE.exr`, all in a folder.

    Without -o, the folder is named after the image, or the first other input.

    Raises:
        OutputError: One exists and may not be replaced, or is one of the inputs; or -o names
            another file than a depth file.
        UsageError: A standard deviation is asked for, and a file is named and no folder.
    """
    # Where results go without -o.
    files = request.files
    sources = [files.image, files.sparse, *files.depths, files.gt, request.reading.scan.calib]
    inputs = [path for path in sources if isinstance(path, Path)]
    output = request.output or Path(f"{inputs[0].stem}_refined")
    suffix = output.suffix.lower()
    formats = " ".join(DEPTH_SUFFIXES)
    # A depth file alone, or all files in a folder. A name that ends in a dot and letters is taken
    # for another file, unless there is such a folder.
    if suffix in DEPTH_SUFFIXES:
        if request.uncertainty:
            raise UsageError(f"--uncertainty writes a second file; name a folder, not {output}")
        outputs: Outputs = {"depth": output}
    elif output.is_file() or (suffix[1:].isalpha() and not output.is_dir()):
        raise OutputError(f"{output} is no folder; name one, or a depth file ({formats})")
    else:
        outputs = request.outputs_in(output, inputs[0].stem)
    # No input is replaced, and no result unless it may be.
    check_outputs(outputs.values(), inputs, overwrite=request.overwrite)
    return outputs


def remove_outdated(outputs: Outputs) -> None:
    """Removes the record of an earlier result, and its files that are not written again.

    The record goes first, so that none names files of two runs.

    Args:
        outputs: The files of the new result, by kind. Without a record, nothing is removed.
    """
    record = outputs.get("record")
    if record is None:
        return
    # An earlier result may have another format, so files with the endings of every format go.
    endings = {end for suffix in DEPTH_SUFFIXES for end in endings_of(suffix).values()}
    # An improvement map may not be written this time, so an earlier one goes as well.
    written = {path for kind, path in outputs.items() if kind != "improvement"}
    outdated = {record.with_name(record.stem + end) for end in endings} - written
    for path in (record, *sorted(outdated)):
        remove_file(path)


def without_unknown(request: RefineRequest, inputs: ReadFrame, frame: Refined) -> Refined:
    """Returns the frame with 0 where no points support its depth, if that is asked for.

    Where it is not, a note tells how much of a scan's image lies outside of its points.

    Args:
        request: What is asked for.
        inputs: The frame as it was read.
        frame: The refined frame.
    """
    # Depth is supported where it is valid; that is known if it was asked for.
    if request.unknown == "zero" and frame.valid is not None:
        return replace(frame, depth=np.where(frame.valid, frame.depth, np.float32(0)))
    # A frame with a mask of valid depth needs no note. Nor do points of other sensors, which leave
    # no large part of an image out.
    source = inputs.sources["sparse"]
    is_scan = source.kind == "scan" or scan_pattern(frame.used.xy, frame.used.size)
    if frame.valid is not None or not is_scan:
        return frame
    fraction_outside = 1 - float(in_hull(frame.used).double().mean())
    if fraction_outside <= _LEAST_NOTED:
        return frame
    note = (
        f"note: {100 * fraction_outside:.0f} % of the pixels lie outside of the scan's points, and"
        " their depth is a guess; --unknown zero writes 0 where points do not support it"
    )
    return replace(frame, notes=(*frame.notes, note))


def write_outputs(
    outputs: Outputs, inputs: ReadFrame, frame: Refined, made_by: tuple[str, str]
) -> dict[str, FigureRecord]:
    """Writes the depth and its images; returns where the panels of the images lie, by kind.

    An improvement map needs ground truth, or points that the result has not seen; without them it
    is not written.

    Args:
        outputs: The files by kind.
        inputs: The frame as it was read.
        frame: The refined frame.
        made_by: Names of what made the depth before and the depth after, for the preview.
    """
    # The image as it was refined.
    inputs = replace(inputs, register=frame.registration).registered()
    image = inputs.image
    # Depth, its standard deviation, and where it is valid.
    write_depth(
        outputs["depth"], frame.depth, scale=integer_scale(inputs.own_points, inputs.depth_scale)
    )
    if "sigma" in outputs and frame.sigma is not None and frame.valid is not None:
        write_sigma(outputs["sigma"], frame.sigma)
        write_mask(outputs["valid"], frame.valid)
    # Images for a person.
    figures = {}
    unit = inputs.unit
    if "preview" in outputs:
        xy = inputs.own_points.xy.numpy()
        depth = inputs.own_points.depth.numpy()
        figures["preview"] = preview(
            image, xy, depth, frame.before, frame.depth, outputs["preview"], unit, made_by
        )
    path = outputs.get("improvement")
    if path is not None and inputs.gt is not None:
        figures["improvement"] = improvement(
            image, frame.before, frame.depth, inputs.gt, path, unit
        )
    elif path is not None:
        unseen = _unseen_points(inputs, frame)
        if unseen is not None:
            figures["improvement"] = improvement_at_points(image, unseen, inputs.size, path, unit)
    if "view" in outputs and inputs.camera is not None:
        _write_view(outputs["view"], inputs, frame, inputs.camera)
    return figures


def _unseen_points(inputs: ReadFrame, frame: Refined) -> PointErrors | None:
    """The held-out points, else the validation points, with the depths there; None without any.

    Held-out points have no part in the result; validation points choose and weigh what is fused,
    but the depths that are compared there were made without them.

    Args:
        inputs: The frame as it was read, with its held-out points.
        frame: The refined frame, with its validation points if the method has some.
    """
    held_out = inputs.held_out
    validation = frame.validation
    if len(held_out):
        points = held_out
        what = "held-out points"
        before = held_out.sample(torch.from_numpy(frame.before))
        after = held_out.sample(torch.from_numpy(frame.depth))
        interpolated = held_out.sample(linear(inputs.points))
    elif validation is not None and len(validation.points):
        points = validation.points
        what = "validation points"
        before = validation.predicted[BEFORE]
        after = validation.predicted[AFTER]
        interpolated = validation.predicted[LINEAR]
    else:
        return None
    return PointErrors(
        xy=points.xy.numpy(),
        truth=points.depth.numpy(),
        before=before.numpy(),
        after=after.numpy(),
        linear=interpolated.numpy(),
        what=what,
    )


def _write_view(path: Path, inputs: ReadFrame, frame: Refined, camera: Camera) -> None:
    """Writes the 3D view for a report: depths, the ground truth if known, colours and camera.

    Every depth is cut at its edges, as a cloud is, on one grid. An image of more pixels than
    `LARGEST_VIEW` is thinned to every n-th row and column. In the JSON, depths are base64 of
    uint16, 0 = unknown, else logarithmic over `range`.

    Args:
        path: The JSON file.
        inputs: The frame as it was read.
        frame: The refined frame.
        camera: The camera in pixels of the image.
    """
    # Depths without the points between surfaces, on a grid of few enough pixels.
    height, width = inputs.size
    stride = math.ceil(math.sqrt(height * width / LARGEST_VIEW))
    thinned = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    maps = {"before": frame.before, "after": frame.depth}
    if inputs.gt is not None:
        maps["gt"] = inputs.gt
    depths = {}
    for name, depth in maps.items():
        keep = frame.valid if name == "after" else None
        depths[name] = np.where(kept_pixels(depth, keep), depth, 0)[thinned]
    # Their range, and the rays of the camera.
    known = np.concatenate([depth[depth > 0] for depth in depths.values()])
    near, far = (float(known.min()), float(known.max())) if len(known) else (1.0, 1.0)
    far = max(far, near * _LEAST_RATIO)
    rays = _rays(camera, (height, width))
    write_json(
        path,
        {
            "size": [depths["after"].shape[1], depths["after"].shape[0]],
            "whole": [width, height],
            "stride": stride,
            "range": [near, far],
            "middle": float(np.median(known)) if len(known) else 1.0,
            "farthest": far,
            "spacing": stride / float(camera.intrinsics[0, 0]),  # of points at depth 1
            "unit": inputs.unit,
            "rays": {"size": [rays.shape[1], rays.shape[0]], "values": _base64(rays, "<f4")},
            "depths": {
                name: _base64(_codes(depth, near, far), "<u2") for name, depth in depths.items()
            },
            "colours": _base64(_colours(inputs.image, frame)[thinned], "|u1"),
        },
    )


def _codes(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.float64]:
    """(H, W) codes 1…65535, logarithmic from `near` to `far`; 0 where the depth is 0, unknown.

    Args:
        depth: (H, W) metres, from `near` to `far` where known.
        near: Depth of code 1, above 0.
        far: Depth of code 65535.
    """
    known = depth > 0
    position = np.log(np.where(known, depth, near) / near) / math.log(far / near)
    return np.where(known, 1 + np.rint(position * (LARGEST_CODE - 1)), 0)


def _rays(camera: Camera, size: tuple[int, int]) -> NDArray[np.float64]:
    """(rows, columns, 2) x/z and y/z at the nodes of a grid from the first to the last pixel.

    A viewer interpolates between the nodes; `_RAY_NODES` says how many there are.

    Args:
        camera: The camera in pixels of the image.
        size: (H, W) of the image.
    """
    # Nodes along each side: both end pixels, and between them as many as its length asks for.
    longer_side = max(size)
    positions = []
    for side in size:
        inner_nodes = _RAY_NODES * (side - 1) // longer_side
        positions.append(np.linspace(0, side - 1, 2 + inner_nodes))
    rows, columns = positions
    xy = np.stack(np.meshgrid(columns, rows), axis=-1)
    return rays_of(camera, xy.reshape(-1, 2)).reshape(xy.shape)


def _colours(image: NDArray[np.float32] | None, frame: Refined) -> NDArray[np.uint8]:
    """(H, W, 3) 0…255 of the image (H, W, 3) in 0…1, or of the depth where there is no image."""
    if image is not None:
        return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return depth_scale(frame.depth).paint(frame.depth)


def _base64(values: NDArray[np.number], kind: str) -> str:
    """The numbers in base64, row by row.

    Args:
        values: Numbers, of any shape.
        kind: NumPy's name of the type that they are stored as, such as `<f4`.
    """
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")
