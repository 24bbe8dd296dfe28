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
from pnpdepth_cli.completion.image_registration import better_orientation
from pnpdepth_cli.completion.registration_evidence import evidence
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
        holdout: Fraction of the points that is held out, 0 to below 1.
        needs_camera: Whether the camera must be known, if need be from EXIF.

    Raises:
        InputError: A file cannot be used, or the files do not fit together.
        UsageError: An option does not apply to these files.
    """
    if files.min_confidence is not None and files.sparse_mask is None:
        raise UsageError("--min-confidence needs --sparse-mask, the confidence of the sparse depth")
    # Each file is read once.
    stored = read_stored_frame(files, options)
    # The ground truth, the sparse depth and the camera are made of what was read.
    truth = read_ground_truth(files, options, stored)
    size = stored.size if truth is None else truth.size
    sparse = read_sparse_depth(files, options, stored, truth, size, seed)
    points = sparse.points.tensors()
    size = size or sparse.whole_size or points.size
    gt = None if truth is None else files.part.apply(truth.depth)
    findings = list[str]()
    if truth is not None and gt is not None:
        findings = compare_with_sparse(files, options, gt, truth.reading, sparse)
    findings += _time_warnings(files)
    camera, camera_notes = _camera_of(files, options, sparse.camera, size, is_needed=needs_camera)
    # Points are held out, and those of neighbouring frames join.
    used, held_out = _hold_out(points, holdout, seed)

    def points_of_neighbour(neighbour: FrameFiles) -> Points:
        """The points of a neighbouring frame, read as those of this one."""
        return _points_of(neighbour, options, size, seed)

    joined = read_neighbours(files, used, camera, points_of_neighbour)
    # Whether the image may be moved to the points. Points that wrong poses moved say nothing of it.
    is_contradicted = any(record.contradicts_images for record in joined.records)
    is_stated = sparse.camera is not None or files.one_view or options.registration == "off"
    one_view = is_contradicted or is_stated
    rgb = None if stored.rgb is None else files.part.apply(stored.rgb)
    if rgb is not None and not one_view and files.is_first:
        findings += _orientation_warning(files, rgb, points)
    predicted = _read_predicted(files, stored, size)
    # What a record and a person should know.
    sources = _sources_of(stored, truth, sparse, predicted)
    notes = [note for source in sources.values() for note in source.notes]
    notes += [*findings, *camera_notes, *joined.notes, *_unused_mask_note(files)]
    # A COLMAP model has the pose of its image, which goes before that of the data set.
    pose = sparse.pose
    if pose is None and files.pose:
        pose = np.array(files.pose)
    return ReadFrame(
        rgb=None if rgb is None else tensor_of(np.ascontiguousarray(rgb)),
        points=joined.points,
        own_points=points,
        of_matches=sparse.record.kind == "colmap",
        held_out=held_out,
        register=None if one_view else registration_to_make(options.registration, Settings()),
        one_view=one_view,
        gt=None if gt is None else np.ascontiguousarray(gt),
        predicted=tuple(torch.from_numpy(network.depth) for network in predicted),
        depth_scale=sparse.reading.scale,
        sources={name: source.record for name, source in sources.items()},
        neighbours=tuple(joined.records),
        notes=tuple(notes),
        unit=sparse.unit,
        camera=camera,
        pose=pose,
    )


def _time_warnings(files: FrameFiles) -> list[str]:
    """Warnings where the image and its depth are of two moments by their names."""
    if files.image_file is None:
        return []
    depths = [depth for depth in (files.sparse, files.gt) if depth is not None]
    warnings = [time_warning(files.image_file, depth) for depth in depths]
    return [warning for warning in warnings if warning is not None]


def _unused_mask_note(files: FrameFiles) -> list[str]:
    """A line for a person on masks without ground truth, of which nothing is masked; else none."""
    if not files.masks or files.gt is not None:
        return []
    return [
        f"mask {files.masks[0]} is of ground truth, of which there is none, so it is not used; a"
        " mask of the sparse depth is --sparse-mask, or sparse_mask in a list"
    ]


class _Predicted(NamedTuple):
    """The depth map of a network, in the part of the frame that is used."""

    depth: NDArray[np.float32]
    """(H, W) in the network's own numbers, NaN where unknown."""
    source: NotedFile
    """What a record keeps of its file, and lines on it."""


def _read_predicted(files: FrameFiles, stored: StoredFrame, size: Size) -> list[_Predicted]:
    """The depth maps of networks, resized to the whole image; then of the part that is used.

    Args:
        files: The files of the frame, with those of the maps.
        stored: What the files hold.
        size: (H, W) that the maps are resized to without an image.
    """
    predicted = list[_Predicted]()
    for path in files.depths:
        network = read_predicted_depth(path, stored.size or size, stored.rgb)
        depth = np.ascontiguousarray(files.part.apply(network.values))
        predicted.append(_Predicted(depth, NotedFile(network.source, network.notes)))
    return predicted


def _sources_of(
    stored: StoredFrame,
    truth: GroundTruth | None,
    sparse: SparseDepth,
    predicted: Sequence[_Predicted],
) -> Mapping[str, NotedFile]:
    """The files of a frame by what they are of, in the order in which a record has them."""
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
    """A warning if the points fit the image clearly better mirrored or turned, else none.

    Args:
        files: The files of the frame, for messages.
        rgb: (H, W, 3) in 0…1, the part of the image that is used.
        points: Points of that part.
    """
    edges = evidence(np.ascontiguousarray(rgb), points)
    turned = None if edges is None else better_orientation([edges])
    if turned is None:
        return []
    way_out = "; give both as they are stored, or both turned"
    if files.image_file is not None and orientation_in(files.image_file) != 1:  # 1 is upright
        way_out = f": the EXIF orientation of {files.image_file} is applied, that of depth is not"
    return [
        f"warning: the image's edges meet the depth of {files.sparse or files.gt} better if it is"
        f" {turned}{way_out}"
    ]


def _camera_of(
    files: FrameFiles,
    options: ReadOptions,
    camera: Camera | None,
    size: Size,
    *,
    is_needed: bool,
) -> tuple[Camera | None, list[str]]:
    """The camera of the part of the frame that is used, and lines for a person.

    Args:
        files: The files of the frame, with the calibration that the data set states.
        options: Options with the calibration that the user states.
        camera: The camera of the whole image by which the points were projected. None: they were
            not, and the camera is that of the calibration.
        size: (H, W) of the whole image.
        is_needed: Whether it is made of the focal length in EXIF without a calibration.

    Returns:
        None for the camera if it is unknown and not needed.

    Raises:
        InputError: The calibration is of another image.
        UsageError: The camera is needed, and nothing states it.
    """
    image = files.image_file
    scan = options.scan.over(files)
    notes = list[str]()
    if camera is None and scan.calib is not None:
        camera, notes = arrays.camera_of_file(scan.calib, scan.camera, size, image)
    if camera is None and is_needed:
        lacking = f"--html-3d needs the camera, and {image or files.sparse} has no calibration"
        camera, notes = arrays.camera_of_exif(image, size, lacking)
    if camera is None:
        return None, notes
    return files.part.camera_in_crop(camera, size), notes


def _points_of(files: FrameFiles, options: ReadOptions, size: Size, seed: int) -> Points:
    """The points of another frame of the sequence, in the part of it that is used.

    Args:
        files: The files of the other frame.
        options: Options of reading.
        size: (H, W) of the whole image, one for all frames of the sequence.
        seed: Random seed of points that are sampled.
    """
    if files.sparse is None:
        stored = read_stored_frame(files, options)
        truth = read_ground_truth(files, options, stored)
        return sample_truth(files, options, stored.rgb, truth, seed).points
    # Of its other files only the ground truth may matter: `--depth-scale` is of its integers alone
    # if it holds any.
    stored_truth = None
    if options.depth_scale is not None and files.gt is not None:
        stored_truth = stored_depth.read_stored_truth(files.gt, files.image)
    stored = StoredFrame(
        rgb=None,
        image=None,
        truth=stored_truth,
        sparse=stored_depth.read_stored_sparse(files.sparse, options.scan.over(files)),
    )
    # How image and points belong together is not searched again.
    later = replace(files, is_first=False)
    return read_sparse_depth(later, options, stored, None, size, seed).points


def _hold_out(
    points: SparsePoints, fraction: float, seed: int
) -> tuple[SparsePoints, SparsePoints]:
    """The points to use, and a random fraction of them that is held out.

    Args:
        points: All points of the frame.
        fraction: Fraction that is held out, 0 to below 1; if above 0, at least one point is, and
            at least one is not.
        seed: Random seed of the choice.

    Raises:
        UsageError: There is no such fraction, or of a single point.
    """
    if not 0 <= fraction < 1:
        raise UsageError(f"--holdout must be a fraction, 0 <= F < 1, got {fraction}")
    is_held_out = torch.zeros(len(points), dtype=torch.bool)
    if fraction > 0:
        if len(points) < 2:
            raise UsageError("holdout needs at least two sparse points")
        count = min(max(1, round(fraction * len(points))), len(points) - 1)
        order = np.random.default_rng(seed).permutation(len(points))
        is_held_out[torch.from_numpy(order[:count])] = True
    return points.select(~is_held_out), points.select(is_held_out)
