"""The points of a depth map, or of a list of pixels and depths."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.dataset.arrays import check_same_view, moved_note, record_of
from pnpdepth_cli.dataset.frame_camera import camera_of_file
from pnpdepth_cli.dataset.plausible import check_pixels, divisor_to_metres, far_values
from pnpdepth_cli.dataset.read_options import ReadOptions, ScanOptions
from pnpdepth_cli.dataset.sparse_depth import SparseDepth
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.sparse_files import read_sparse
from pnpdepth_cli.sensors.lens import unproject
from pnpdepth_cli.sensors.projection import behind_foreground, occluded_in_map


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
