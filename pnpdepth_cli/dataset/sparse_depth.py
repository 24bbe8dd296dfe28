"""The sparse depth of a frame as it was read: of a depth map, a list or a COLMAP model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset import arrays
from pnpdepth_cli.dataset.frame_files import ReadOptions, ScanOptions
from pnpdepth_cli.dataset.pixel_checks import check_pixels, check_rows
from pnpdepth_cli.dataset.plausible import divisor_to_metres, named
from pnpdepth_cli.dataset.range_ends import far_values
from pnpdepth_cli.dataset.resized_maps import interpolation_warning
from pnpdepth_cli.dataset.stored_depth import StoredNumbers
from pnpdepth_cli.errors import InputError, NoPointsError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.colmap_model import (
    ColmapModel,
    find_model,
    model_files,
    name_in_model,
    read_model,
)
from pnpdepth_cli.io.depth import describe_range, points_from_stored
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.io.formats import SATURATED_CODE, DepthFile, Reading
from pnpdepth_cli.points import METRES, MODEL_UNITS, Size, in_frame
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors.lens import unproject
from pnpdepth_cli.sensors.projection import (
    DropCounter,
    Mask,
    Points,
    as_depth_image,
    behind_foreground,
    describe_dropped,
    hidden_among,
    occluded_in_map,
    pixel_index,
)

_SIZES_IN_RANGE = 8.0
"""A 16-bit file in model units holds depths up to at least so many times the model's extent."""
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
    whole_size: Size | None = None
    """(H, W) of the whole image, if the points are of a part of it. None: they are of all of it."""

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
        levels_of_points = levels.ravel()[pixel.clip(0, levels.size - 1)]
        kept = levels_of_points > 0 if least is None else levels_of_points >= least
        # How many there are, of which confidence: a line for a person, or why none is left.
        numbers = levels_of_points[~np.isnan(levels_of_points)]
        extent = f"{numbers.min():g} to {numbers.max():g}" if len(numbers) else "no number"
        if 0 < len(numbers) < len(kept):
            extent += f", and no number to {len(kept) - len(numbers):,} of them"
        fact = (
            f"{np.count_nonzero(kept):,} of {len(kept):,} points have a confidence"
            f" {'above 0' if least is None else f'of {least:g} or more'} in {path},"
            f" which gives them {extent}"
        )
        if not kept.any() and (least is None or not len(numbers)):
            raise NoPointsError(f"{fact}; use another mask")
        if not kept.any():
            raise NoPointsError(f"{fact}; lower --min-confidence")
        dropped = self.record.dropped | {"of low confidence": int((~kept).sum())}
        record = replace(self.record, mask=str(path), least=least, dropped=dropped)
        notes = (*self.notes, f"sparse: {fact}")
        return replace(self, points=self.points.select(kept), record=record, notes=notes)

    def in_part(self, part: FramePart) -> SparseDepth:
        """Returns the points in a part of the frame. Raises NoPointsError if there is none."""
        points = part.points_in_crop(self.points)
        if not len(points):
            raise NoPointsError(
                f"{self.record.path}: none of its {len(self.points)} points lies in the image"
            )
        return replace(self, points=points, whole_size=self.points.size)


class _Visible(NamedTuple):
    """The points of a map that the camera sees."""

    points: Points
    dropped: dict[str, int]
    """Number of the others, by the reason."""
    lines: list[str]
    """Lines on these, for a person."""


def read_map_points(
    stored: StoredNumbers,
    options: ReadOptions,
    size: Size | None,
    scale: float | None,
    *,
    of_integers: str = "",
    inverse: float | None = None,
) -> SparseDepth:
    """Returns the points of a depth map or a list that the camera sees.

    Args:
        stored: The file, and the numbers in it.
        options: Which occluded points go.
        size: (H, W) of the image; None for the map's own.
        scale: Numbers per metre that the user states. None: the file's own.
        of_integers: The other file of the frame whose integers that scale is of, if there is one.
        inverse: Depth × number of a file of disparity or 1/depth. None: it holds depth.

    Raises:
        InputError: Its numbers are no depth of this image.
    """
    # The points as they are stored, without far values.
    path = stored.path
    points, reading = points_from_stored(path, stored.file, size=size, scale=scale)
    if inverse is not None:
        numbers = DepthFile(values=points.depth, reading=reading)
        of_kind = arrays.depth_of_inverse(numbers, inverse, scale)
        # These are metres now, of which no scale is stated.
        scale = None
        reading = of_kind.reading
        points = replace(points, depth=of_kind.values).select(of_kind.values > 0)
    far, lines = far_values(points.depth)
    points = points.select(~far)
    size_of_file = points.size
    size = size or size_of_file
    arrays.check_same_view(str(path), size_of_file, size)
    # What a person should know of them.
    lines = [describe_range(points.depth, reading), *lines]
    if size_of_file != size:
        lines.append(arrays.moved_note(size_of_file, size))
    if inverse is None and _is_map(points):
        blurred = interpolation_warning(as_depth_image(points))
        if blurred is not None:
            lines.append(blurred)
    # Points that the camera does not see go.
    visible = _visible_points(points, options)
    lines += visible.lines
    # The others must be pixels of the image, and all of them plausible in metres.
    depth = points.depth
    points = visible.points.resized(*size)
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
        record=replace(arrays.record_of(path, reading), dropped=visible.dropped),
        notes=(*(named("sparse", line) for line in lines), *of_pixels, *warnings),
    )


def _is_map(points: Points) -> bool:
    """Whether all points are pixels of the image."""
    are_whole = bool((points.xy == np.floor(points.xy)).all())
    return are_whole and bool(in_frame(points.xy, points.size).all())


def _visible_points(points: Points, options: ReadOptions) -> _Visible:
    """The points without those that nearer ones hide from the camera."""
    if options.foreground is not None:
        hidden: Mask | None = behind_foreground(points, *options.foreground)
        reason = "behind the foreground"
    elif not options.scan.keep_occluded:
        hidden = occluded_in_map(points)
        reason = "hidden by foreground"
    else:
        return _Visible(points, {}, [])
    # Only maps of projected scans have hidden points.
    if hidden is None or not hidden.any():
        return _Visible(points, {}, [])
    count = int(hidden.sum())
    if options.foreground is not None:
        line = f"dropped {count:,} points behind others, as the protocol does"
    else:
        line = (
            f"a projected LiDAR scan; dropped {count:,} points occluded from the camera by nearer"
            " ones; --method paper keeps them"
        )
    return _Visible(points.select(~hidden), {reason: count}, [line])


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
    camera = model.images[name].camera
    pose = model.images[name].pose.inverse()
    camera_size = _size_of(camera)
    arrays.check_same_view(f"the camera of {image} in {model.folder}", camera_size, size)
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
    if camera_size != size:
        notes.append(f"sparse: {arrays.moved_note(camera_size, size)}")
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


def _size_of(camera: Camera) -> Size:
    """The size (H, W) of the images of a camera of a model, of which each states one."""
    if camera.size is None:
        raise InputError(f"{camera.source} states no size of its images; export the model again")
    return camera.size


def _points_in(model: ColmapModel, name: str, unit_scale: float) -> tuple[Points, list[str]]:
    """The points of an image, in its camera's size, that pass the filters; lines for a person."""
    image = model.images[name]
    points = model.points
    camera = image.camera
    camera_size = _size_of(camera)
    # The points of the image's tracks, else all.
    row = np.flatnonzero(np.isin(points["number"], image.points))
    untracked = not len(row)
    if untracked:
        row = np.arange(len(points["number"]))
    # Points of short tracks and with large reprojection errors go.
    total = len(row)
    drops = DropCounter()
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
    seen, xy = drops.keep_seen(seen, camera, camera_size)
    # Without tracks, nothing else tells which points the camera sees.
    notes = list[str]()
    if untracked and len(xy) < _FEW_TO_HIDE:
        notes = [
            f"sparse: {name} has no tracks; the {len(xy):,} points are too few to tell which are"
            " hidden by others, so all are used"
        ]
    elif untracked:
        visible = drops.keep(~hidden_among(xy, seen[:, 2], camera_size), "hidden by foreground")
        seen, xy = seen[visible], xy[visible]
        notes = [f"sparse: {name} has no tracks; all {total:,} points of the model are projected"]
    # What is left must be some.
    if not len(xy):
        raise NoPointsError(
            f"none of the {total:,} points of {name!r} in {model.folder} is left ({drops});"
            " register it with more matches"
        )
    return drops.points(seen * unit_scale, xy, camera_size), notes


def _output_scale(model: ColmapModel) -> float:
    """A power of two, one for the whole model, so that its depths use the codes of 16 bits."""
    centre = np.median(model.points["xyz"], axis=0)
    extent = float(np.median(np.linalg.norm(model.points["xyz"] - centre, axis=1)))
    poses = model.images.values()
    path = [np.linalg.norm(image.pose.inverse().translation - centre) for image in poses]
    farthest = _SIZES_IN_RANGE * max(extent, float(np.median(path)), 1e-9)
    return float(2.0 ** np.floor(np.log2(SATURATED_CODE / farthest)))
