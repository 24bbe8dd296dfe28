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
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.io.formats import SATURATED_CODE, DepthFile, Reading
from pnpdepth_cli.io.point_files import points_from_stored
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

# Points of a COLMAP model.
_EXTENTS_IN_RANGE = 8.0
"""A 16-bit file in model units holds depths up to at least so many times the model's extent."""
_FEW_TO_HIDE = 100
"""Points; fewer are no surface that could hide others."""
_LEAST_TRACK = 3
"""Images that observe a point: two rays meet anywhere along one of them."""
_MOST_REPROJECTION_PX = 2.0
"""Mean reprojection error of a point; COLMAP itself keeps up to 4 pixels."""


@dataclass(frozen=True, kw_only=True)
class SparseDepth:
    """The sparse depth of a frame, as it was read."""

    points: Points
    """The points in the image."""
    record: FileRecord
    """What a record keeps of the file."""
    notes: tuple[str, ...]
    """Lines for a person."""
    reading: Reading
    """How the file was read; its scale is integers per unit, None if the file holds none."""
    unit: str = METRES
    """Unit of the depth: `METRES`, or `MODEL_UNITS` of a COLMAP model without scale."""
    camera: Camera | None = None
    """The camera of the whole image, by which a calibration or a model projects the points."""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's coordinates to the world's, in `unit`. None: unknown."""
    whole_size: Size | None = None
    """(H, W) of the whole image, if the points are of a part of it. None: they are of all of it."""

    def confident(self, path: Path, least: float | None) -> SparseDepth:
        """Returns the points whose confidence in a file is large enough; NaN is never.

        Args:
            path: The confidence of each pixel, of this view at any resolution.
            least: The smallest confidence that is enough. None: any above 0 is.

        Raises:
            InputError: The file holds no confidence of this view.
            NoPointsError: No point is left.
        """
        # The confidence of each point is that of its pixel, at the file's resolution.
        levels = arrays.read_levels(path)
        size = (levels.shape[0], levels.shape[1])
        arrays.check_same_view(str(path), size, self.points.size)
        pixel = pixel_index(self.points.resized(*size).xy, size)
        # Rounding may put a point beyond the last pixel.
        levels_of_points = levels.ravel()[pixel.clip(0, levels.size - 1)]
        is_kept = levels_of_points > 0 if least is None else levels_of_points >= least
        # How many there are, of which confidence: a line for a person, or why none is left.
        numbers = levels_of_points[~np.isnan(levels_of_points)]
        extent = f"{numbers.min():g} to {numbers.max():g}" if len(numbers) else "no number"
        if 0 < len(numbers) < len(is_kept):
            extent += f", and no number to {len(is_kept) - len(numbers):,} of them"
        fact = (
            f"{np.count_nonzero(is_kept):,} of {len(is_kept):,} points have a confidence"
            f" {'above 0' if least is None else f'of {least:g} or more'} in {path},"
            f" which gives them {extent}"
        )
        if not is_kept.any() and (least is None or not len(numbers)):
            raise NoPointsError(f"{fact}; use another mask")
        if not is_kept.any():
            raise NoPointsError(f"{fact}; lower --min-confidence")
        dropped = self.record.dropped | {"of low confidence": int((~is_kept).sum())}
        record = replace(self.record, mask=str(path), least=least, dropped=dropped)
        notes = (*self.notes, f"sparse: {fact}")
        return replace(self, points=self.points.select(is_kept), record=record, notes=notes)

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
    """Number of the points that it does not see, by the reason."""
    notes: list[str]
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
    """Returns the points of a depth map or a list that the camera sees, in metres.

    Args:
        stored: The file, and the numbers in it.
        options: Options of reading, which say what happens to occluded points.
        size: (H, W) of the image. None: it is that of the map.
        scale: Numbers per metre that the user or the data set states. None: the file's own.
        of_integers: Where the integers are that `scale` is stated for, if not here: path of the
            frame's other file, or `plausible.OF_DATA_SET`. Floats are then divided only where they
            cannot be metres. Empty: it is stated for these very numbers.
        inverse: For a file of disparity or 1/depth, the constant that depth × number is: baseline ×
            focal length in metres × pixels, or 1. None: the file holds depth.

    Raises:
        InputError: Its numbers are no depth of this image.
        NoPointsError: No point is left.
    """
    # The points as they are stored, without extreme values that are no depth.
    path = stored.path
    points, reading = points_from_stored(path, stored.file, size=size, scale=scale)
    if inverse is not None:
        numbers = DepthFile(values=points.depth, reading=reading)
        depths = arrays.depth_of_inverse(numbers, inverse, scale)
        # The numbers are metres by now, of which no scale is stated.
        scale = None
        reading = depths.reading
        points = replace(points, depth=depths.values).select(depths.values > 0)
    is_no_depth, lines = far_values(points.depth)
    points = points.select(~is_no_depth)
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
    # Points that the camera does not see are dropped.
    stored_depth = points.depth
    visible = _visible_points(points, options)
    lines += visible.notes
    # The others must be pixels of the image. The unit is told by the depth of all, also of hidden
    # ones.
    points = visible.points.resized(*size)
    is_inside, pixel_notes = check_pixels(path, points.xy, size)
    divisor, unit_notes = divisor_to_metres(
        stored_depth, reading, "sparse", "--depth-scale", scale, of_integers=of_integers
    )
    points = points.select(is_inside)
    # Numbers that grow towards the bottom of the image may be disparity. What is known to be
    # disparity or 1/depth has become depth above.
    if inverse is None:
        unit_notes += check_rows(points)
    return SparseDepth(
        points=replace(points, depth=points.depth / np.float32(divisor)),
        reading=reading,
        record=replace(arrays.record_of(path, reading), dropped=visible.dropped),
        notes=(*(named("sparse", line) for line in lines), *pixel_notes, *unit_notes),
    )


def _is_map(points: Points) -> bool:
    """Whether all points are at centres of pixels of the image, as those of a depth map."""
    are_whole = bool((points.xy == np.floor(points.xy)).all())
    return are_whole and bool(in_frame(points.xy, points.size).all())


def _visible_points(points: Points, options: ReadOptions) -> _Visible:
    """The points without those that nearer ones hide from the camera.

    Args:
        points: Points of a map or a list, at its own resolution.
        options: Options that state the protocol's filter of foreground, or that hidden points stay.
    """
    hidden: Mask | None
    if options.foreground is not None:
        window_px, distance_m = options.foreground
        hidden = behind_foreground(points, window_px, distance_m)
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
        note = f"dropped {count:,} points behind others, as the protocol does"
    else:
        note = (
            f"a projected LiDAR scan; dropped {count:,} points occluded from the camera by nearer"
            " ones; --method paper keeps them"
        )
    return _Visible(points.select(~hidden), {reason: count}, [note])


def depth_of_distances(sparse: SparseDepth, scan: ScanOptions, image: Path | None) -> SparseDepth:
    """Returns the points with depth z instead of their distances from the camera.

    Points on pixels where the lens shows nothing are dropped.

    Args:
        sparse: Points whose depth is the distance from the camera.
        scan: Options with the calibration of that camera.
        image: File of the image, for messages. None: there is none.

    Raises:
        InputError: The calibration is of another image.
        UsageError: There is no calibration.
    """
    if scan.calib is None:
        raise UsageError("--sparse-range needs the camera of the distances; give --calib")
    points = sparse.points
    camera, _ = arrays.camera_of_file(scan.calib, scan.camera, points.size, image)
    # The distance of a point of depth 1 on each pixel's ray.
    at_depth_1 = unproject(camera, points.xy, np.ones(len(points)))
    ratio = np.linalg.norm(at_depth_1, axis=1)
    is_seen = np.isfinite(ratio)
    points = replace(points, depth=(points.depth / ratio).astype(np.float32)).select(is_seen)
    note = (
        f"sparse: distances became depth, ÷ {ratio[is_seen].min():.3f} to"
        f" {ratio[is_seen].max():.3f} by the camera of {scan.calib}"
    )
    record = replace(sparse.record, read_as=f"{sparse.record.read_as}, distances")
    return replace(sparse, points=points, record=record, notes=(*sparse.notes, note))


def read_colmap_points(
    path: Path, image: Path, size: Size, *, unit_scale: float | None = None
) -> SparseDepth:
    """Returns the points that COLMAP matched in an image, projected into it.

    An image of a model of known poses may have no matches. Then all points of the model are
    projected into it, but for those that nearer ones occlude.

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
    is_no_depth, lines = far_values(points.depth, unit)
    points = points.select(~is_no_depth)
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
    described = describe_dropped(dropped)
    if described:
        notes.append(f"sparse: dropped {described}")
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
            sha256={file.name: fingerprint(file).sha256 for file in model_files(find_model(path))},
            read_as=reading.source,
            image=name,
            unit_scale=unit_scale,
            dropped=dict(dropped),
        ),
        notes=tuple(notes),
    )


def _size_of(camera: Camera) -> Size:
    """The size (H, W) of the images of a camera of a COLMAP model.

    Raises:
        InputError: The model states none.
    """
    if camera.size is None:
        raise InputError(f"{camera.source} states no size of its images; export the model again")
    return camera.size


def _points_in(model: ColmapModel, name: str, unit_scale: float) -> tuple[Points, list[str]]:
    """The points of a COLMAP model that one of its images shows, and lines for a person.

    Args:
        model: The model.
        name: Name of the image in it.
        unit_scale: What coordinates are multiplied by; depths have the unit that comes out.

    Returns:
        The points are in pixels of the image's camera, at the size that the model states of it.

    Raises:
        InputError: All points are behind the camera.
        NoPointsError: No point is left.
    """
    image = model.images[name]
    points = model.points
    camera = image.camera
    camera_size = _size_of(camera)
    # Rows of the points of the image's tracks, else of all points.
    rows = np.flatnonzero(np.isin(points["number"], image.points))
    is_untracked = not len(rows)
    if is_untracked:
        rows = np.arange(len(points["number"]))
    # Points of short tracks and with large reprojection errors are dropped. Models of known poses
    # may have points without any tracks; their tracks are not judged.
    total = len(rows)
    drops = DropCounter()
    least = min(_LEAST_TRACK, len(model.images))
    if points["track"].any():
        why = f"seen in fewer than {least} images"
        rows = rows[drops.keep(points["track"][rows] >= least, why)]
    why = f"with a reprojection error above {_MOST_REPROJECTION_PX:g} px"
    rows = rows[drops.keep(points["error"][rows] <= _MOST_REPROJECTION_PX, why)]
    # The others are projected: (M, 3) in the camera's coordinates, (M, 2) in pixels.
    xyz = image.pose.apply(points["xyz"][rows])
    is_in_front = drops.keep(xyz[:, 2] > 0, "behind the camera")
    if len(rows) and not is_in_front.any():
        raise InputError(
            f"all {len(rows):,} points of {name!r} in {model.folder} are behind its camera; the"
            " model is damaged, or its poses are inverted"
        )
    xyz, xy = drops.keep_seen(xyz[is_in_front], camera, camera_size)
    # Without tracks, nothing else tells which points the camera sees.
    notes = list[str]()
    if is_untracked and len(xy) < _FEW_TO_HIDE:
        notes = [
            f"sparse: {name} has no tracks; the {len(xy):,} points are too few to tell which are"
            " hidden by others, so all are used"
        ]
    elif is_untracked:
        is_visible = drops.keep(~hidden_among(xy, xyz[:, 2], camera_size), "hidden by foreground")
        xyz, xy = xyz[is_visible], xy[is_visible]
        notes = [f"sparse: {name} has no tracks; all {total:,} points of the model are projected"]
    # What is left must be some.
    if not len(xy):
        raise NoPointsError(
            f"none of the {total:,} points of {name!r} in {model.folder} is left ({drops});"
            " register it with more matches"
        )
    return drops.points(xyz * unit_scale, xy, camera_size), notes


def _output_scale(model: ColmapModel) -> float:
    """The codes per unit of a 16-bit file of depths in a model's units; one for all its images.

    It is the largest power of two by which depths of several times the model's extent fit. The
    extent is the median distance of the points, or of the cameras, from the middle of the points.
    """
    centre = np.median(model.points["xyz"], axis=0)
    of_points = float(np.median(np.linalg.norm(model.points["xyz"] - centre, axis=1)))
    of_cameras = float(
        np.median(
            [
                np.linalg.norm(image.pose.inverse().translation - centre)
                for image in model.images.values()
            ]
        )
    )
    extent = max(of_points, of_cameras, 1e-9)  # above 0 for a model of one point
    farthest = _EXTENTS_IN_RANGE * extent
    return float(2.0 ** np.floor(np.log2(SATURATED_CODE / farthest)))
