"""The files of a frame: read, then interpreted and checked against each other.

Each file is read once, into what it holds. Functions that take what was read decide what it means.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.completion.image_registration import better_orientation
from pnpdepth_cli.completion.registration_evidence import evidence
from pnpdepth_cli.completion.two_depths import compare_depths
from pnpdepth_cli.dataset import arrays, sparse_depth, stored_depth
from pnpdepth_cli.dataset.agreement import check_order, unit_warning
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, ScanOptions, inverse_factor
from pnpdepth_cli.dataset.neighbours import read_neighbours
from pnpdepth_cli.dataset.plausible import plausible_map
from pnpdepth_cli.dataset.predicted_depth import read_predicted_depth
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.dataset.sparse_depth import SparseDepth
from pnpdepth_cli.dataset.stored_depth import StoredDepth, StoredNumbers, StoredPoints
from pnpdepth_cli.dataset.time_stamps import time_warning
from pnpdepth_cli.errors import InputError, UsageError, unequal_sizes
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.frames.frame import registration_to_make, tensor_of
from pnpdepth_cli.io.depth import depth_from_stored, describe_range
from pnpdepth_cli.io.formats import DepthFile, Reading, check_scale
from pnpdepth_cli.io.rgb import orientation_in, read_rgb
from pnpdepth_cli.points import METRES, Size, SparsePoints
from pnpdepth_cli.sensors.projection import Points, as_depth_image
from pnpdepth_cli.sensors.simulation import sample_points
from pnpdepth_cli.settings import Settings

_LEAK_FRACTION = 0.5
"""Fraction of the ground truth's pixels that are the sparse depth, from which there is a warning.
KITTI's ground truth holds the points of its own scan by design, which is less than half of it."""


class _Source(NamedTuple):
    """What a record keeps of a file, and lines on it for a person."""

    record: FileRecord
    notes: Sequence[str]


@dataclass(frozen=True, kw_only=True)
class _Stored:
    """What the files of a frame hold. Nothing is decided of it."""

    rgb: NDArray[np.float32] | None
    """(H, W, 3) in 0…1. None without an image."""
    image: _Source | None
    truth: StoredDepth | None
    sparse: StoredDepth | None

    @property
    def size(self) -> Size | None:
        """(H, W) of the image. None without an image."""
        return None if self.rgb is None else (self.rgb.shape[0], self.rgb.shape[1])


class _Truth(NamedTuple):
    """The ground truth of a frame, interpreted."""

    values: NDArray[np.float32]
    """(H, W) metres, 0 = unknown."""
    reading: Reading
    source: _Source

    @property
    def size(self) -> Size:
        """(H, W)."""
        return self.values.shape[0], self.values.shape[1]


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
    stored = _read_stored(files, options)
    # The ground truth, the sparse depth and the camera are made of what was read.
    truth = _truth_of(files, options, stored)
    size = stored.size if truth is None else truth.size
    sparse = _sparse_of(files, options, stored, truth, size, seed)
    given = sparse.points.tensors()
    size = size or given.size
    gt = None if truth is None else files.part.apply(truth.values)
    compared = list[str]()
    if truth is not None and gt is not None:
        compared = _compare(files, options, gt, truth.reading, sparse, given)
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


def _read_stored(files: FrameFiles, options: ReadOptions) -> _Stored:
    """What the files hold: the image, the ground truth and the sparse depth."""
    rgb = image = truth = sparse = None
    if files.image is not None:
        notes = list[str]()
        if isinstance(files.image, Path):
            # COLMAP reads photos as they are stored.
            is_model = files.sparse is not None and files.sparse.is_dir()
            picture = read_rgb(files.image, upright=not is_model)
            rgb = picture.values
            if picture.note:
                notes.append(f"image: {picture.note}")
        else:
            rgb = arrays.read_image(files.image)
        image = _Source(arrays.record_of(files.image, kind="image"), notes)
    if files.gt is not None:
        truth = stored_depth.read_stored_truth(files.gt, files.image)
    if files.sparse is not None:
        sparse = stored_depth.read_stored_sparse(files.sparse, options.scan.over(files))
    return _Stored(rgb=rgb, image=image, truth=truth, sparse=sparse)


def _truth_of(files: FrameFiles, options: ReadOptions, stored: _Stored) -> _Truth | None:
    """The ground truth, of the image's size: a projected scan, or a depth map."""
    if stored.truth is None:
        return None
    if isinstance(stored.truth, StoredPoints):
        truth = _truth_of_scan(files, options, stored, stored.truth.path)
    else:
        truth = _truth_of_map(files, options, stored, stored.truth)
    if stored.size is not None and stored.size != truth.size:
        raise unequal_sizes(f"ground truth {files.gt}", truth.size, "the image", stored.size)
    if not (truth.values > 0).any():
        raise InputError(
            f"ground truth {files.gt} has no pixel with known depth; give another one, or none"
        )
    return truth


def _truth_of_scan(files: FrameFiles, options: ReadOptions, stored: _Stored, path: Path) -> _Truth:
    """The ground truth that the points of a scan are, projected into the image."""
    if files.kind_of_gt is not None:
        raise UsageError(f"{path} is a scan, so gt_kind does not apply; leave it out")
    stated = stored_depth.scale_of_truth(files, options, stored.sparse)
    scan = read_scan_points(
        path,
        options.scan.over(files),
        stored.size,
        files.image_file,
        rgb=_rgb_of_file(files, stored),
        scale=stated.scale,
        of_integers=stated.of_integers,
    )
    notes = [note.replace("sparse:", "gt:", 1) for note in scan.notes]
    return _Truth(as_depth_image(scan.points), scan.reading, _Source(scan.record, notes))


def _truth_of_map(
    files: FrameFiles, options: ReadOptions, stored: _Stored, truth: StoredNumbers
) -> _Truth:
    """The ground truth of a depth map, in metres, without what masks and checks rule out."""
    # The numbers by their scale.
    stated = stored_depth.scale_of_truth(files, options, stored.sparse)
    scale = stated.scale
    depth = _map_by_scale(truth, scale)
    if options.depth_scale is not None and stored.sparse and stored_depth.is_float(stored.sparse):
        # The option is of the floats beside the map, unless the map has no scale of its own.
        by_layout = _map_by_scale(truth, files.gt_scale)
        if not by_layout.reading.assumed:
            depth = by_layout
    # Numbers of another kind than depth, as the user states.
    factor = inverse_factor("gt_kind", files.kind_of_gt)
    if factor is not None:
        depth = arrays.depth_of_inverse(depth, factor, scale)
        scale = None  # these are metres now
    # Pixels that a mask or the gate rules out are unknown.
    values = arrays.apply_masks(depth.values, files.masks)
    if files.gt_other_size and stored.size is not None and values.shape != stored.size:
        values = arrays.move_depth(truth.path, values, stored.size)
    option = "--depth-scale" if stored.sparse is None else _gt_scale_option(files)
    values, notes = plausible_map(
        values, depth.reading, "gt", option, scale, of_integers=stated.of_integers
    )
    described = describe_range(values, depth.reading, noun="pixels", option=option)
    record = arrays.record_of(truth.path, depth.reading)
    return _Truth(values, depth.reading, _Source(record, [f"gt: {described}", *notes]))


def _map_by_scale(stored: StoredNumbers, scale: float | None) -> DepthFile:
    """The map in metres, if its integers have this scale; None is the file's own."""
    check_scale(scale)
    return depth_from_stored(stored.path, stored.file, scale)


def _gt_scale_option(files: FrameFiles) -> str:
    """What sets the scale of ground truth beside sparse depth; `refine` names no frame."""
    return "gt_scale of a list" if files.name else "--depth-scale (of both files)"


def _rgb_of_file(files: FrameFiles, stored: _Stored) -> NDArray[np.float32] | None:
    """The image, unless it is the frame of a video, whose edges no scan is compared with."""
    return None if files.image_file is None else stored.rgb


def _sparse_of(
    files: FrameFiles,
    options: ReadOptions,
    stored: _Stored,
    truth: _Truth | None,
    size: Size | None,
    seed: int,
) -> SparseDepth:
    """The sparse depth of an image (H, W), in the part of it that the protocol keeps."""
    if stored.sparse is None:
        return _sample_sparse(files, options, stored.rgb, truth, seed)
    _check_sparse_options(files, options, stored.sparse)
    # Its points in the image.
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
            rgb=_rgb_of_file(files, stored),
            scale=stated.scale,
            of_integers=stated.of_integers,
            search=files.is_first,
        )
    # Those that are sure enough, in the part of the frame.
    if files.sparse_mask is not None:
        sparse = sparse.confident(files.sparse_mask, files.min_confidence)
    return sparse.in_part(files.part)


def _sample_sparse(
    files: FrameFiles,
    options: ReadOptions,
    rgb: NDArray[np.float32] | None,
    truth: _Truth | None,
    seed: int,
) -> SparseDepth:
    """Points sampled from the ground truth."""
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
    # The points, of the part of the frame that the protocol keeps.
    seed = seed if options.sample.seed is None else options.sample.seed
    gt = files.part.apply(truth.values)
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
    """The points of a COLMAP model that the image shows."""
    if size is None or files.image_file is None:
        raise UsageError(f"{path} is a folder, taken for a COLMAP model, which needs the image")
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
    stored: _Stored,
    sparse: StoredNumbers,
    size: Size | None,
) -> SparseDepth:
    """The points of a depth map or a list."""
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


class _Predicted(NamedTuple):
    """A depth map of a network, in the part of the frame that the protocol keeps."""

    values: NDArray[np.float32]
    source: _Source


def _read_predicted(files: FrameFiles, stored: _Stored, size: Size) -> list[_Predicted]:
    """The depth maps of networks, which are resized to the whole image."""
    found = list[_Predicted]()
    for path in files.depths:
        network = read_predicted_depth(path, stored.size or size, stored.rgb)
        values = np.ascontiguousarray(files.part.apply(network.values))
        found.append(_Predicted(values, _Source(network.source, network.notes)))
    return found


def _sources_of(
    stored: _Stored, truth: _Truth | None, sparse: SparseDepth, predicted: Sequence[_Predicted]
) -> Mapping[str, _Source]:
    """The files of a frame by what they are of, in the order of records and lines."""
    sources = dict[str, _Source]()
    if stored.image is not None:
        sources["image"] = stored.image
    sources["sparse"] = _Source(sparse.record, sparse.notes)
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
        stored = _read_stored(files, options)
        return _sample_sparse(
            files, options, stored.rgb, _truth_of(files, options, stored), seed
        ).points
    # Of its other files, nothing is needed but whether a scale is of the ground truth's integers.
    truth = None
    if options.depth_scale is not None and files.gt is not None:
        truth = stored_depth.read_stored_truth(files.gt, files.image)
    stored = _Stored(
        rgb=None,
        image=None,
        truth=truth,
        sparse=stored_depth.read_stored_sparse(files.sparse, options.scan.over(files)),
    )
    later = replace(files, is_first=False)
    return _sparse_of(later, options, stored, None, size, seed).points


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


def _compare(
    files: FrameFiles,
    options: ReadOptions,
    gt: NDArray[np.float32],
    reading: Reading,
    sparse: SparseDepth,
    points: SparsePoints,
) -> list[str]:
    """Warnings on ground truth and sparse depth that seem to be of two scales, or one."""
    if sparse.unit != METRES:
        raise UsageError(
            f"the ground truth {files.gt} is in metres but the sparse depth in {sparse.unit}; give"
            " --unit-scale, or leave out --gt"
        )
    if files.sparse is None:
        # No file beside the ground truth decides a scale that is assumed.
        if not reading.assumed:
            return []
        return [
            f"warning: the scale of the ground truth ({reading.source}) is assumed, and with it the"
            f" metres of all errors; --depth-scale 1000 if it holds millimetres, --depth-scale"
            f" {reading.scale:g} if it is right"
        ]
    notes = list[str]()
    depth = points.scatter()[0, 0].numpy()
    known = int((gt > 0).sum())
    leaked = int(((gt > 0) & (depth == gt)).sum())
    if leaked >= _LEAK_FRACTION * known:
        notes.append(
            f"warning: {leaked:,} of {known:,} pixels ({leaked / known:.1%}) of the ground truth"
            " are the sparse depth itself, so errors against it show nothing; give another --gt,"
            " or keep points out with --holdout"
        )
    # Their order, and then their ratio.
    both = f"the sparse depth and the ground truth {files.gt}"
    if (reversed_order := check_order(both, depth, gt)) is not None:
        if options.sparse_kind is files.kind_of_sparse is files.kind_of_gt is None:
            raise InputError(reversed_order)
        return [*notes, f"warning: {reversed_order}"]
    by_option = {"--depth-scale": sparse.reading, _gt_scale_option(files): reading}
    warning = unit_warning("sparse points", compare_depths(depth, gt), by_option)
    return notes if warning is None else [*notes, warning]
