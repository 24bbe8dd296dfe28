"""The points of a COLMAP model that one image observes, as its sparse depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.dataset.arrays import check_same_view, moved_note
from pnpdepth_cli.dataset.plausible import far_values
from pnpdepth_cli.dataset.sparse_depth import SparseDepth
from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.colmap_model import (
    ColmapModel,
    find_model,
    model_files,
    name_in_model,
    read_model,
)
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.io.formats import SATURATED_CODE, Reading
from pnpdepth_cli.points import METRES, MODEL_UNITS
from pnpdepth_cli.sensors.lens import pixels_of
from pnpdepth_cli.sensors.pixels import DropCounter, Points, describe_dropped
from pnpdepth_cli.sensors.projection import hidden_among

_SIZES_IN_RANGE = 8.0
"""A 16-bit file in model units holds depths up to at least so many times the model's extent."""

_LEAST_TRACK = 3
"""Points that fewer images observe are dropped: two rays meet anywhere along one of them."""

_MOST_REPROJECTION_PX = 2.0
"""Points with a larger mean reprojection error are dropped; COLMAP itself keeps up to 4 pixels."""


def read_colmap_points(
    path: Path, image: Path, size: tuple[int, int], *, unit_scale: float | None = None
) -> SparseDepth:
    """Returns the points that COLMAP matched in an image, projected into it.

    An image of a model of known poses may have no matches. All points are projected into it that no
    nearer ones occlude.

    The camera's own lens distortion is applied to the points, so the photo stays as it was taken.

    Args:
        path: Folder of the model.
        image: The photo.
        size: (H, W) of the photo.
        unit_scale: Metres per unit of the model. None: depth is in its units.

    Raises:
        InputError: The model cannot be read, or lacks the image.
        SizeError: The photo does not show the camera's view.
        NoPointsError: No point is left.
    """
    # The image in the model, whose camera must have the photo's view.
    model = read_model(path)
    name = name_in_model(model, image)
    camera = model.images[name].camera
    assert camera.size is not None  # of every camera of a model
    check_same_view(f"the camera of {image} in {model.folder}", camera.size, size)
    # Its points, without far values.
    points, notes = _points_in(model, name, unit_scale or 1.0)
    dropped = points.dropped
    unit = MODEL_UNITS if unit_scale is None else METRES
    far, lines = far_values(points.depth, unit)
    points = points.select(~far)
    # What a person should know.
    turn, shift = model.images[name].pose.inverse()
    reading = Reading(
        f"COLMAP model, image {name}, {camera.source}",
        scale=_output_scale(model) if unit == MODEL_UNITS else None,
    )
    notes = [f"sparse: {describe_range(points.depth, reading, unit=unit)}", *notes]
    if camera.size != size:
        notes.append(f"sparse: {moved_note(camera.size, size)}")
    if camera.has_lens:
        notes.append("sparse: lens distortion is applied to the points; the image stays distorted")
    lost = describe_dropped(dropped)
    notes += [f"sparse: dropped {lost}"] if lost else []
    notes += [f"sparse: {line}" for line in lines]
    if unit == MODEL_UNITS:
        notes.append("unit: depth is in model units; --unit-scale M gives metres per unit")
    return SparseDepth(
        points=points.resized(*size),
        calibrated=True,
        camera=replace(camera.resized(*size), source=f"COLMAP model {path}"),
        pose=np.column_stack([turn, shift * (unit_scale or 1.0)]),
        unit=unit,
        reading=reading,
        record=FileRecord(
            path=str(model.folder),
            sha256={p.name: fingerprint(p).sha256 for p in model_files(find_model(path))},
            read_as=reading.source,
            image=name,
            unit_scale=unit_scale,
            dropped=dict(dropped),
        ),
        notes=tuple(notes),
    )


def _points_in(model: ColmapModel, name: str, unit_scale: float) -> tuple[Points, list[str]]:
    """The points of an image, in its camera's size, that pass the filters; lines for a person."""
    image, points = model.images[name], model.points
    camera = image.camera
    assert camera.size is not None
    # The points of the image's tracks, else all.
    row = np.flatnonzero(np.isin(points.number, image.points))
    untracked = not len(row)
    if untracked:
        row = np.arange(len(points.number))
    # Points of short tracks and with large reprojection errors go.
    total, drops = len(row), DropCounter()
    least = min(_LEAST_TRACK, len(model.images))
    if points.track.any():
        row = row[drops.keep(points.track[row] >= least, f"seen in fewer than {least} images")]
    why = f"with a reprojection error above {_MOST_REPROJECTION_PX:g} px"
    row = row[drops.keep(points.error[row] <= _MOST_REPROJECTION_PX, why)]
    # The others are projected.
    seen = image.pose.apply(points.xyz[row])
    front = drops.keep(seen[:, 2] > 0, "behind the camera")
    if len(row) and not front.any():
        raise InputError(
            f"all {len(row):,} points of {name!r} in {model.folder} are behind its camera; the"
            " model is damaged, or its poses are inverted"
        )
    seen = seen[front]
    seen, xy = drops.keep_seen(seen, pixels_of(camera, seen), camera.size)
    # Without tracks, nothing else tells which points the camera sees.
    notes = list[str]()
    if untracked:
        visible = drops.keep(~hidden_among(xy, seen[:, 2], camera.size), "hidden by foreground")
        seen, xy = seen[visible], xy[visible]
        notes = [f"sparse: {name} has no tracks; all {total:,} points of the model are projected"]
    # What is left must be some.
    if not len(xy):
        raise NoPointsError(
            f"none of the {total:,} points of {name!r} in {model.folder} is left ({drops});"
            " register it with more matches"
        )
    return drops.points(seen * unit_scale, xy, camera.size), notes


def _output_scale(model: ColmapModel) -> float:
    """A power of two, one for the whole model, so that its depths use the codes of 16 bits."""
    centre = np.median(model.points.xyz, axis=0)
    extent = float(np.median(np.linalg.norm(model.points.xyz - centre, axis=1)))
    poses = model.images.values()
    path = [np.linalg.norm(image.pose.inverse().translation - centre) for image in poses]
    farthest = _SIZES_IN_RANGE * max(extent, float(np.median(path)), 1e-9)
    return float(2.0 ** np.floor(np.log2(SATURATED_CODE / farthest)))
