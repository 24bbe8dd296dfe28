"""The files of a frame: read, then interpreted and checked against each other.

Each file is read once, into what it holds. Functions that take what was read decide what it means.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.completion.image_registration import better_orientation, evidence
from pnpdepth_cli.dataset import arrays, stored_depth
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.dataset.ground_truth import GroundTruth, compare_with_sparse, read_ground_truth
from pnpdepth_cli.dataset.neighbours import read_neighbours
from pnpdepth_cli.dataset.predicted_depth import read_predicted_depth
from pnpdepth_cli.dataset.sparse_depth import SparseDepth
from pnpdepth_cli.dataset.sparse_sources import read_sparse_depth, sample_truth
from pnpdepth_cli.dataset.stored_frame import NotedFile, StoredFrame, read_stored_frame
from pnpdepth_cli.dataset.time_stamps import time_warning
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import registration_to_make, tensor_of
from pnpdepth_cli.io.rgb import orientation_in
from pnpdepth_cli.points import Size, SparsePoints
from pnpdepth_cli.sensors.projection import Points
from pnpdepth_cli.settings import Settings


def read_frame(
    files: FrameFiles,
    options: ReadOptions,
    *,
    seed: int = 0,
    holdout: float = 0.0,
    needs_camera: bool = False,
) -> ReadFrame:
    """Returns the frame of these files.

    Args:
        files: The files of the frame.
        options: Options of reading, such as scales and the sampling of points.
        seed: Random seed of points that are sampled, and of those that are held out.
        holdout: Fraction of the points that is held out.
        needs_camera: Whether the camera must be known, if need be from EXIF.

    Raises:
        InputError: A file cannot be used, or the files do not fit together.
    """
    if files.min_confidence is not None and files.sparse_mask is None:
        raise UsageError("--min-confidence needs --sparse-mask, the confidence of the sparse depth")
    # Each file is read once.
    stored = read_stored_frame(files, options)
    # The ground truth, the sparse depth and the camera are made of what was read.
    truth = read_ground_truth(files, options, stored)
    size = stored.size if truth is None else truth.size
    sparse = read_sparse_depth(files, options, stored, truth, size, seed)
    given = sparse.points.tensors()
    size = size or given.size
    gt = None if truth is None else files.part.apply(truth.values)
    compared = list[str]()
    if truth is not None and gt is not None:
        compared = compare_with_sparse(files, options, gt, truth.reading, sparse, given)
    compared += _time_warnings(files)
    camera, of_camera = _camera_of(files, options, sparse.camera, size, needs_camera)
    # Points are held out, and those of neighbouring frames join.
    used, held_out = _hold_out(given, holdout, seed)
    moved = read_neighbours(
        files, used, camera, lambda neighbour: _points_of(neighbour, options, size, seed)
    )
    # Points that wrong poses moved say nothing of the image.
    contradicted = any(neighbour.contradicts_images for neighbour in moved.records)
    is_stated = sparse.camera is not None or files.one_view or options.registration == "off"
    one_view = contradicted or is_stated
    rgb = None if stored.rgb is None else files.part.apply(stored.rgb)
    if rgb is not None and not one_view and files.is_first:
        compared += _orientation_warning(files, rgb, given)
    predicted = _read_predicted(files, stored, size)
    # What a record and a person should know.
    sources = _sources_of(stored, truth, sparse, predicted)
    notes = [note for source in sources.values() for note in source.notes]
    notes += [*compared, *of_camera, *moved.notes]
    if files.masks and truth is None:
        notes.append(
            f"mask {files.masks[0]} is of ground truth, of which there is none, so it is not used;"
            " a mask of the sparse depth is --sparse-mask, or sparse_mask in a list"
        )
    return ReadFrame(
        rgb=None if rgb is None else tensor_of(np.ascontiguousarray(rgb)),
        points=moved.points,
        own=given,
        of_matches=sparse.record.kind == "colmap",
        held_out=held_out,
        register=None if one_view else registration_to_make(options.registration, Settings()),
        one_view=one_view,
        gt=None if gt is None else np.ascontiguousarray(gt),
        predicted=tuple(torch.from_numpy(network.values) for network in predicted),
        depth_scale=sparse.reading.scale,
        sources={name: source.record for name, source in sources.items()},
        neighbours=tuple(moved.records),
        notes=tuple(notes),
        unit=sparse.unit,
        camera=camera,
        pose=np.array(files.pose) if sparse.pose is None and files.pose else sparse.pose,
    )


def _time_warnings(files: FrameFiles) -> list[str]:
    """Warnings where the image and its depth are of two moments by their names."""
    if files.image_file is None:
        return []
    depths = [depth for depth in (files.sparse, files.gt) if depth is not None]
    warnings = [time_warning(files.image_file, depth) for depth in depths]
    return [warning for warning in warnings if warning is not None]


class _Predicted(NamedTuple):
    """A depth map of a network, in the part of the frame that the protocol keeps."""

    values: NDArray[np.float32]
    source: NotedFile


def _read_predicted(files: FrameFiles, stored: StoredFrame, size: Size) -> list[_Predicted]:
    """The depth maps of networks, which are resized to the whole image."""
    found = list[_Predicted]()
    for path in files.depths:
        network = read_predicted_depth(path, stored.size or size, stored.rgb)
        values = np.ascontiguousarray(files.part.apply(network.values))
        found.append(_Predicted(values, NotedFile(network.source, network.notes)))
    return found


def _sources_of(
    stored: StoredFrame,
    truth: GroundTruth | None,
    sparse: SparseDepth,
    predicted: Sequence[_Predicted],
) -> Mapping[str, NotedFile]:
    """The files of a frame by what they are of, in the order of records and lines."""
    sources = dict[str, NotedFile]()
    if stored.image is not None:
        sources["image"] = stored.image
    sources["sparse"] = NotedFile(sparse.record, sparse.notes)
    for number, network in enumerate(predicted, 1):
        name = "depth" if len(predicted) == 1 else f"depth {number}"
        sources[name] = network.source
    if truth is not None:
        sources["gt"] = truth.source
    return sources


def _orientation_warning(
    files: FrameFiles, rgb: NDArray[np.float32], points: SparsePoints
) -> list[str]:
    """A warning if the points fit the image clearly better mirrored or turned."""
    known = evidence(np.ascontiguousarray(rgb), points)
    turned = None if known is None else better_orientation([known])
    if turned is None:
        return []
    way_out = "; give both as they are stored, or both turned"
    if files.image_file is not None and orientation_in(files.image_file) != 1:
        way_out = f": the EXIF orientation of {files.image_file} is applied, that of depth is not"
    return [
        f"warning: the image's edges meet the depth of {files.sparse or files.gt} better if it is"
        f" {turned}{way_out}"
    ]


def _camera_of(
    files: FrameFiles, options: ReadOptions, known: Camera | None, size: Size, is_needed: bool
) -> tuple[Camera | None, list[str]]:
    """The camera of a frame's part, None if unknown; it is from EXIF only where it is needed."""
    image = files.image_file
    scan = options.scan.over(files)
    notes = list[str]()
    if known is None and scan.calib is not None:
        known, notes = arrays.camera_of_file(scan.calib, scan.camera, size, image)
    if known is None and is_needed:
        lacking = f"--html-3d needs the camera, and {image or files.sparse} has no calibration"
        known, notes = arrays.camera_of_exif(image, size, lacking)
    return None if known is None else files.part.camera_in_crop(known, size), notes


def _points_of(files: FrameFiles, options: ReadOptions, size: Size, seed: int) -> Points:
    """The points of another frame of the sequence, read or sampled as it does itself."""
    if files.sparse is None:
        stored = read_stored_frame(files, options)
        return sample_truth(
            files, options, stored.rgb, read_ground_truth(files, options, stored), seed
        ).points
    # Of its other files, nothing is needed but whether a scale is of the ground truth's integers.
    truth = None
    if options.depth_scale is not None and files.gt is not None:
        truth = stored_depth.read_stored_truth(files.gt, files.image)
    stored = StoredFrame(
        rgb=None,
        image=None,
        truth=truth,
        sparse=stored_depth.read_stored_sparse(files.sparse, options.scan.over(files)),
    )
    later = replace(files, is_first=False)
    return read_sparse_depth(later, options, stored, None, size, seed).points


def _hold_out(
    points: SparsePoints, fraction: float, seed: int
) -> tuple[SparsePoints, SparsePoints]:
    """The points to use, and a random fraction of them, at least one unless it is 0, held out."""
    if not 0 <= fraction < 1:
        raise UsageError(f"--holdout must be a fraction, 0 <= F < 1, got {fraction}")
    mask = torch.zeros(len(points), dtype=torch.bool)
    if fraction > 0:
        if len(points) < 2:
            raise UsageError("holdout needs at least two sparse points")
        count = min(max(1, round(fraction * len(points))), len(points) - 1)
        order = np.random.default_rng(seed).permutation(len(points))
        mask[torch.from_numpy(order[:count])] = True
    return points.select(~mask), points.select(mask)
