"""The sparse depth of a frame: of a map, a list, a scan or a COLMAP model, or sampled."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset import sparse_depth, stored_depth
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, ScanOptions, inverse_factor
from pnpdepth_cli.dataset.ground_truth import GroundTruth
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.dataset.sparse_depth import SparseDepth
from pnpdepth_cli.dataset.stored_depth import StoredDepth, StoredNumbers, StoredPoints
from pnpdepth_cli.dataset.stored_frame import StoredFrame, rgb_of_file
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.points import Size
from pnpdepth_cli.sensors.simulation import sample_points


def read_sparse_depth(
    files: FrameFiles,
    options: ReadOptions,
    stored: StoredFrame,
    truth: GroundTruth | None,
    size: Size | None,
    seed: int,
) -> SparseDepth:
    """Returns the sparse depth of the part of a frame that is used.

    Args:
        files: The files of the frame.
        options: Options of reading, such as scales and the sampling of points.
        stored: What the files hold.
        truth: The ground truth, from which points are sampled without a file of sparse depth.
        size: (H, W) of the whole image. None: it is that of the sparse depth.
        seed: Random seed of points that are sampled.

    Raises:
        InputError: Its numbers are no depth of this image, or there is nothing to sample from.
        NoPointsError: No point is left.
        UsageError: An option does not apply to its file.
    """
    if stored.sparse is None:
        return sample_truth(files, options, stored.rgb, truth, seed)
    _check_sparse_options(files, options, stored.sparse)
    # Its points in the whole image.
    if isinstance(stored.sparse, StoredNumbers):
        sparse = _points_of_numbers(files, options, stored, stored.sparse, size)
    elif stored.sparse.kind == "model":
        sparse = _points_of_model(files, options, stored.sparse.path, size)
    else:
        stated = stored_depth.scale_of_sparse(files, options, stored.truth)
        sparse = read_scan_points(
            stored.sparse.path,
            options.scan.over(files),
            size,
            files.image_file,
            rgb=rgb_of_file(files, stored),
            scale=stated.scale,
            of_integers=stated.of_integers,
            search=files.is_first,
        )
    # Those that are sure enough, in the part of the frame that is used.
    if files.sparse_mask is not None:
        sparse = sparse.confident(files.sparse_mask, files.min_confidence)
    return sparse.in_part(files.part)


def sample_truth(
    files: FrameFiles,
    options: ReadOptions,
    rgb: NDArray[np.float32] | None,
    truth: GroundTruth | None,
    seed: int,
) -> SparseDepth:
    """Returns points sampled from the ground truth, of the part of the frame that is used.

    Args:
        files: The files of the frame.
        options: Options with the pattern of the samples, and its seed if that is stated.
        rgb: (H, W, 3) in 0…1, the whole image, which some patterns need. None: there is none.
        truth: The ground truth of the whole frame.
        seed: Random seed, if the pattern states none.

    Raises:
        InputError: There is no ground truth, or too little of it for the pattern.
        UsageError: An option of files of sparse depth is given.
    """
    # What the user states must be of a sampled frame.
    if options.sparse_range:
        raise UsageError(
            "--sparse-range is of sparse depth from a file, and there is none; leave it out"
        )
    if options.sparse_kind is not None:
        raise UsageError(
            "--sparse-kind is of sparse depth from a file, and there is none; leave it out"
        )
    if options.sample is None:
        raise InputError(f"{files.image} has no sparse depth; add it, or sample the ground truth")
    if truth is None:
        raise InputError(f"{files.image} has no ground truth to sample points from; add it")
    # The points, of the part of the frame that is used.
    if options.sample.seed is not None:
        seed = options.sample.seed
    gt = files.part.apply(truth.depth)
    image = None if rgb is None else files.part.apply(rgb)
    try:
        points = sample_points(gt, options.sample, seed, image=image)
    except UsageError as error:  # the pattern itself is good, this frame is too poor for it
        raise InputError(f"{files.gt}: {error}") from error
    how = f"{options.sample.kind} of the ground truth, seed {seed}"
    reading = Reading(how, truth.reading.scale)
    sampled = replace(options.sample, seed=seed)
    return SparseDepth(
        points=points,
        reading=reading,
        record=FileRecord(path=str(files.gt), kind="sampled", sampled=sampled),
        notes=(f"sparse: {describe_range(points.depth, reading)}",),
    )


def _check_sparse_options(files: FrameFiles, options: ReadOptions, sparse: StoredDepth) -> None:
    """Raises UsageError for an option that is of another kind of file than the sparse depth."""
    path = sparse.path
    is_model = isinstance(sparse, StoredPoints) and sparse.kind == "model"
    kind = options.sparse_kind or files.kind_of_sparse
    # Beside a model, the scale may be of the ground truth.
    if options.depth_scale is not None and is_model and files.gt is None:
        raise UsageError(f"{path} is a COLMAP model; --unit-scale is its scale, not --depth-scale")
    if options.unit_scale is not None and not is_model:
        raise UsageError(f"{path} is no COLMAP model, so --unit-scale does not apply; leave it out")
    if kind is not None and isinstance(sparse, StoredPoints):
        raise UsageError(
            f"{path} is no depth map or list, so --sparse-kind does not apply; leave it out"
        )
    if options.sparse_range and kind is not None:
        raise UsageError(
            "--sparse-range is of distances, and --sparse-kind of another kind; give one of them"
        )
    if options.sparse_range and isinstance(sparse, StoredPoints):
        raise UsageError(
            f"{path} is no depth map or list, so --sparse-range does not apply; leave it out"
        )


def _points_of_model(
    files: FrameFiles, options: ReadOptions, path: Path, size: Size | None
) -> SparseDepth:
    """The points of a COLMAP model that the image shows.

    Args:
        files: The files of the frame, with the image.
        options: Options with the metres per unit of the model.
        path: Folder of the model.
        size: (H, W) of the image. None: there is none, which is an error.
    """
    if size is None or files.image_file is None:
        raise UsageError(f"{path} is a folder, taken for a COLMAP model, which needs the image")
    # `keep_occluded` is of every kind of sparse depth: the paper's method sets it.
    if replace(options.scan, keep_occluded=False) != ScanOptions():
        raise UsageError(
            f"{path} is a COLMAP model, so the options of a scan do not apply; leave them out"
        )
    return sparse_depth.read_colmap_points(
        path, files.image_file, size, unit_scale=options.unit_scale
    )


def _points_of_numbers(
    files: FrameFiles,
    options: ReadOptions,
    stored: StoredFrame,
    sparse: StoredNumbers,
    size: Size | None,
) -> SparseDepth:
    """The points of a depth map or a list, with depth z in metres.

    Args:
        files: The files of the frame.
        options: Options with what the numbers are: scale, kind, distances.
        stored: What the files hold.
        sparse: The map or list, as it is stored.
        size: (H, W) of the image. None: it is that of the map.
    """
    stated = stored_depth.scale_of_sparse(files, options, stored.truth)
    kind = options.sparse_kind or files.kind_of_sparse
    points = sparse_depth.read_map_points(
        sparse,
        options,
        size,
        stated.scale,
        of_integers=stated.of_integers,
        inverse=inverse_factor("--sparse-kind", kind),
    )
    if not options.sparse_range:
        return points
    return sparse_depth.depth_of_distances(points, options.scan.over(files), files.image_file)
