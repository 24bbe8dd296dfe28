"""The sparse depth of a frame as it was read: of a depth map, a list or a COLMAP model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset import arrays
from pnpdepth_cli.dataset.frame_files import ReadOptions, ScanOptions
from pnpdepth_cli.dataset.plausible import (
    check_pixels,
    check_rows,
    divisor_to_metres,
    interpolation_warning,
    named,
)
from pnpdepth_cli.dataset.range_ends import far_values
from pnpdepth_cli.errors import InputError, NoPointsError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.colmap_model import (
    ColmapModel,
    find_model,
    model_files,
    name_in_model,
    read_model,
)
from pnpdepth_cli.io.depth import describe_range, read_sparse
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.io.formats import SATURATED_CODE, DepthFile, Reading
from pnpdepth_cli.points import METRES, MODEL_UNITS, Size, in_frame
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors.lens import unproject
from pnpdepth_cli.sensors.projection import (
    DropCounter,
    Points,
    as_depth_image,
    behind_foreground,
    describe_dropped,
    hidden_among,
    occluded_in_map,
    pixel_index,
)

# A 16-bit file in model units holds depths up to at least so many times the model's extent.
_SIZES_IN_RANGE = 8.0
_FEW_TO_HIDE = 100  # points; so few are no surface that could hide others
_LEAST_TRACK = 3  # images that observe a point: two rays meet anywhere along one of them
_MOST_REPROJECTION_PX = 2.0  # mean error of a point; COLMAP itself keeps up to 4 pixels


@dataclass(frozen=True, kw_only=True)
class SparseDepth:
    """The sparse depth of a frame, as it was read."""

    points: Points
    """The points in the image."""
    record: FileRecord
    notes: tuple[str, ...]
    reading: Reading
    """How the file was read; its scale is integers per unit, None if the file holds none."""
    unit: str = METRES
    camera: Camera | None = None
    """The camera of the whole image, by which a calibration or a model projects the points."""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's coordinates to the world's, in `unit`. None: unknown."""

    def confident(self, path: Path, least: float | None) -> SparseDepth:
        """Returns the points whose confidence in a file is `least` or more, above 0 for None.

        Raises:
            InputError: The file holds no confidence of this view.
            NoPointsError: No point is left.
        """
        levels = arrays.read_levels(path)
        size = (levels.shape[0], levels.shape[1])
        arrays.check_same_view(str(path), size, self.points.size)
        pixel = pixel_index(self.points.resized(*size).xy, (size[0], size[1]))
        own = levels.ravel()[pixel.clip(0, levels.size - 1)]
        kept = own > 0 if least is None else own >= least
        numbers = own[~np.isnan(own)]
        given = f"{numbers.min():g} to {numbers.max():g}" if len(numbers) else "no number"
        if 0 < len(numbers) < len(own):
            given += f", and no number to {len(own) - len(numbers):,} of them"
        fact = (
            f"{np.count_nonzero(kept):,} of {len(own):,} points have a confidence"
            f" {'above 0' if least is None else f'of {least:g} or more'} in {path},"
            f" which gives them {given}"
        )
        if not kept.any():
            way_out = "lower --min-confidence"
            if least is None or not len(numbers):
                way_out = "use another mask"
            raise NoPointsError(f"{fact}; {way_out}")
        dropped = self.record.dropped | {"of low confidence": int((~kept).sum())}
        record = replace(self.record, mask=str(path), least=least, dropped=dropped)
        notes = (*self.notes, f"sparse: {fact}")
        return replace(self, points=self.points.select(kept), record=record, notes=notes)

    def in_part(self, part: FramePart) -> SparseDepth:
        """Returns the points in a part of the frame. Raises NoPointsError if there is none."""
        points = part.points_in_crop(self.points)
        if not len(points):
            fact = f"none of its {len(self.points)} points lies in the image"
            raise NoPointsError(f"{self.record.path}: {fact}")
        return replace(self, points=points)


def read_map_points(
    path: Path,
    options: ReadOptions,
    size: Size | None,
    scale: float | None,
    *,
    of_integers: str = "",
    inverse: float | None = None,
) -> SparseDepth:
    """Returns the points of a depth map or a list that the camera sees.

    Args:
        path: The file.
        options: Which occluded points go.
        size: (H, W) of the image; None for the map's own.
        scale: Numbers per metre that the user states. None: the file's own.
        of_integers: The other file of the frame whose integers that scale is of, if there is one.
        inverse: Depth × number of a file of disparity or 1/depth. None: it holds depth.

    Raises:
        InputError: The file cannot be read, or its numbers are no depth of this image.
    """
    # The points as they are stored, without far values.
    points, reading = read_sparse(path, size=size, scale=scale)
    if inverse is not None:
        stored = DepthFile(values=points.depth, reading=reading)
        of_kind = arrays.depth_of_inverse(stored, inverse, scale)
        # these are metres now, of which no scale is stated
        scale, reading = None, of_kind.reading
        points = replace(points, depth=of_kind.values).select(of_kind.values > 0)
    far, lines = far_values(points.depth)
    points = points.select(~far)
    depth, own = points.depth, points.size
    is_map = bool((points.xy == np.floor(points.xy)).all() and in_frame(points.xy, own).all())
    size = size or own
    arrays.check_same_view(str(path), own, size)
    # What a person should know of them.
    lines = [describe_range(depth, reading), *lines]
    lines += [arrays.moved_note(own, size)] if own != size else []
    if inverse is None and is_map:
        blurred = interpolation_warning(as_depth_image(points))
        lines += [] if blurred is None else [blurred]
    # Points that the camera does not see go.
    hidden, dropped = None, dict[str, int]()
    if options.foreground is not None:
        hidden, why = behind_foreground(points, *options.foreground), "behind the foreground"
        said = "dropped {:,} points behind others, as the protocol does"
    elif not options.scan.keep_occluded:
        hidden, why = occluded_in_map(points), "hidden by foreground"
        said = (
            "a projected LiDAR scan; dropped {:,} points occluded from the camera by nearer ones;"
            " --method paper keeps them"
        )
    if hidden is not None and hidden.any():
        points, dropped = points.select(~hidden), {why: int(hidden.sum())}
        lines.append(said.format(dropped[why]))
    # The others must be pixels of the image, and plausible in metres.
    points = points.resized(*size)
    inside, of_pixels = check_pixels(path, points.xy, size)
    divisor, warnings = divisor_to_metres(
        depth, reading, "sparse", "--depth-scale", scale, of_integers=of_integers
    )
    points = points.select(inside)
    if inverse is None:
        warnings += check_rows(points)
    return SparseDepth(
        points=replace(points, depth=points.depth / np.float32(divisor)),
        reading=reading,
        record=replace(arrays.record_of(path, reading), dropped=dropped),
        notes=(*(named("sparse", line) for line in lines), *of_pixels, *warnings),
    )


def depth_of_distances(sparse: SparseDepth, scan: ScanOptions, image: Path | None) -> SparseDepth:
    """Returns the points with depth z made of distances from the camera of a calibration.

    Points where the lens shows nothing go.

    Raises:
        UsageError: There is no calibration.
    """
    if scan.calib is None:
        raise UsageError("--sparse-range needs the camera of the distances; give --calib")
    points = sparse.points
    camera, _ = arrays.camera_of_file(scan.calib, scan.camera, points.size, image)
    length = np.linalg.norm(unproject(camera, points.xy, np.ones(len(points))), axis=1)
    seen = np.isfinite(length)
    points = replace(points, depth=(points.depth / length).astype(np.float32)).select(seen)
    note = (
        f"sparse: distances became depth, ÷ {length[seen].min():.3f} to {length[seen].max():.3f}"
        f" by the camera of {scan.calib}"
    )
    record = replace(sparse.record, read_as=f"{sparse.record.read_as}, distances")
    return replace(sparse, points=points, record=record, notes=(*sparse.notes, note))


def read_colmap_points(
    path: Path, image: Path, size: Size, *, unit_scale: float | None = None
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
        InputError: The model cannot be read or lacks the image, or the photo does not show the
            camera's view.
        NoPointsError: No point is left.
    """
    # The image in the model, whose camera must have the photo's view.
    model = read_model(path)
    name = name_in_model(model, image)
    camera, pose = model.images[name].camera, model.images[name].pose.inverse()
    assert camera.size is not None  # of every camera of a model
    arrays.check_same_view(f"the camera of {image} in {model.folder}", camera.size, size)
    # Its points, without far values.
    points, notes = _points_in(model, name, unit_scale or 1.0)
    dropped = points.dropped
    unit = MODEL_UNITS if unit_scale is None else METRES
    far, lines = far_values(points.depth, unit)
    points = points.select(~far)
    # What a person should know.
    reading = Reading(
        f"COLMAP model, image {name}, {camera.source}",
        scale=_output_scale(model) if unit == MODEL_UNITS else None,
    )
    notes = [f"sparse: {describe_range(points.depth, reading, unit=unit)}", *notes]
    if camera.size != size:
        notes.append(f"sparse: {arrays.moved_note(camera.size, size)}")
    if camera.has_lens:
        notes.append("sparse: lens distortion is applied to the points; the image stays distorted")
    if lost := describe_dropped(dropped):
        notes.append(f"sparse: dropped {lost}")
    notes += [named("sparse", line) for line in lines]
    if unit == MODEL_UNITS:
        notes.append("unit: depth is in model units; --unit-scale M gives metres per unit")
    return SparseDepth(
        points=points.resized(*size),
        camera=replace(camera.resized(*size), source=f"COLMAP model {path}"),
        pose=np.column_stack([pose.rotation, pose.translation * (unit_scale or 1.0)]),
        unit=unit,
        reading=reading,
        record=FileRecord(
            path=str(model.folder),
            kind="colmap",
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
    row = np.flatnonzero(np.isin(points["number"], image.points))
    untracked = not len(row)
    if untracked:
        row = np.arange(len(points["number"]))
    # Points of short tracks and with large reprojection errors go.
    total, drops = len(row), DropCounter()
    least = min(_LEAST_TRACK, len(model.images))
    if points["track"].any():
        row = row[drops.keep(points["track"][row] >= least, f"seen in fewer than {least} images")]
    why = f"with a reprojection error above {_MOST_REPROJECTION_PX:g} px"
    row = row[drops.keep(points["error"][row] <= _MOST_REPROJECTION_PX, why)]
    # The others are projected.
    seen = image.pose.apply(points["xyz"][row])
    front = drops.keep(seen[:, 2] > 0, "behind the camera")
    if len(row) and not front.any():
        raise InputError(
            f"all {len(row):,} points of {name!r} in {model.folder} are behind its camera; the"
            " model is damaged, or its poses are inverted"
        )
    seen = seen[front]
    seen, xy = drops.keep_seen(seen, camera, camera.size)
    # Without tracks, nothing else tells which points the camera sees.
    notes = list[str]()
    if untracked and len(xy) < _FEW_TO_HIDE:
        notes = [
            f"sparse: {name} has no tracks; the {len(xy):,} points are too few to tell which are"
            " hidden by others, so all are used"
        ]
    elif untracked:
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
    centre = np.median(model.points["xyz"], axis=0)
    extent = float(np.median(np.linalg.norm(model.points["xyz"] - centre, axis=1)))
    poses = model.images.values()
    path = [np.linalg.norm(image.pose.inverse().translation - centre) for image in poses]
    farthest = _SIZES_IN_RANGE * max(extent, float(np.median(path)), 1e-9)
    return float(2.0 ** np.floor(np.log2(SATURATED_CODE / farthest)))
