"""The sparse depth of a frame as it was read, and how that of a depth map or a list is read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.arrays import (
    camera_of_file,
    check_same_view,
    moved_note,
    read_levels,
    record_of,
)
from pnpdepth_cli.dataset.plausible import check_pixels, divisor_to_metres, far_values
from pnpdepth_cli.dataset.read_options import ReadOptions, ScanOptions
from pnpdepth_cli.errors import NoPointsError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import describe_range, read_sparse
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.points import METRES, SparsePoints
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors.lens import unproject
from pnpdepth_cli.sensors.pixels import Points, pixel_index
from pnpdepth_cli.sensors.projection import behind_foreground, occluded_in_map


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
    calibrated: bool = False
    """Whether a calibration, or the pose in a model, says where the image shows the points."""
    camera: Camera | None = None
    """The camera of the whole image, where it came with the points."""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's coordinates to the world's, in `unit`. None: unknown."""

    def confident(self, path: Path, least: float | None) -> SparseDepth:
        """Returns the points whose confidence in a file is `least` or more, above 0 for None.

        Raises:
            InputError: The file holds no confidence of this view.
            NoPointsError: No point is left.
        """
        levels = read_levels(path)
        size = (levels.shape[0], levels.shape[1])
        check_same_view(str(path), size, self.points.size)
        pixel = pixel_index(self.points.resized(*size).xy, (size[0], size[1]))
        own = levels.ravel()[pixel.clip(0, levels.size - 1)]
        kept = own > 0 if least is None else own >= least
        fact = (
            f"{np.count_nonzero(kept):,} of {len(own):,} points have a confidence"
            f" {'above 0' if least is None else f'of {least:g} or more'} in {path},"
            f" which gives them {own.min():g} to {own.max():g}"
        )
        if not kept.any():
            raise NoPointsError(f"{fact}; lower --min-confidence")
        dropped = self.record.dropped | {"of low confidence": int((~kept).sum())}
        record = replace(self.record, mask=str(path), least=least, dropped=dropped)
        notes = (*self.notes, f"sparse: {fact}")
        return replace(self, points=self.points.select(kept), record=record, notes=notes)

    def in_part(self, part: FramePart) -> SparseDepth:
        """Returns the points in a part of the frame. Raises NoPointsError if there is none."""
        whole = self.points
        # an array of the image's size that takes no memory, to find the size of the part
        size = part.apply(np.broadcast_to(np.False_, whole.size)).shape
        if size == whole.size:
            return self
        xy = part.in_crop(whole.xy, whole.size)
        moved = SparsePoints(xy=xy, depth=whole.depth, size=(size[0], size[1]))
        points = moved.cropped(0, 0, *moved.size)
        if not len(points):
            raise NoPointsError(
                f"{self.record.path}: none of its {len(whole)} points lies in the image"
            )
        return replace(self, points=points)


def read_map_points(
    path: Path, options: ReadOptions, size: tuple[int, int] | None, scale: float | None
) -> SparseDepth:
    """Returns the points of a depth map or a list that the camera sees.

    Args:
        path: The file.
        options: Which occluded points go.
        size: (H, W) of the image; None for the map's own.
        scale: Integers per metre. None: the file's own.

    Raises:
        InputError: The file cannot be read, or its numbers are no depth of this image.
    """
    # The points as they are stored, without far values.
    points, reading = read_sparse(path, size=size, scale=scale)
    far, lines = far_values(points.depth)
    points = points.select(~far)
    depth, own = points.depth, points.size
    size = size or own
    check_same_view(str(path), own, size)
    # What a person should know of them.
    lines = [describe_range(depth, reading), *lines]
    lines += [moved_note(own, size)] if own != size else []
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
    divisor, warnings = divisor_to_metres(depth, reading, "sparse", "--depth-scale", scale)
    points = points.select(inside)
    return SparseDepth(
        points=replace(points, depth=points.depth / np.float32(divisor)),
        reading=reading,
        record=replace(record_of(path, reading), dropped=dropped),
        notes=(*(f"sparse: {line}" for line in lines), *of_pixels, *warnings),
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
    camera, _ = camera_of_file(scan.calib, scan.camera, points.size, image)
    length = np.linalg.norm(unproject(camera, points.xy, np.ones(len(points))), axis=1)
    seen = np.isfinite(length)
    points = replace(points, depth=(points.depth / length).astype(np.float32)).select(seen)
    note = (
        f"sparse: distances became depth, ÷ {length[seen].min():.3f} to {length[seen].max():.3f}"
        f" by the camera of {scan.calib}"
    )
    record = replace(sparse.record, read_as=f"{sparse.record.read_as}, distances")
    return replace(sparse, points=points, record=record, notes=(*sparse.notes, note))
