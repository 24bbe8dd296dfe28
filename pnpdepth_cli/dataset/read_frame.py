"""The files of a frame, read and checked against each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.completion.image_registration import better_orientation, evidence
from pnpdepth_cli.completion.two_depths import compare_depths
from pnpdepth_cli.dataset import arrays, sparse_depth
from pnpdepth_cli.dataset.agreement import check_order, unit_warning
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.frame_files import (
    SCAN_ONLY_SUFFIXES,
    FrameFiles,
    ReadOptions,
    ScanOptions,
    inverse_factor,
)
from pnpdepth_cli.dataset.neighbours import read_neighbours
from pnpdepth_cli.dataset.plausible import OF_DATA_SET, plausible_map
from pnpdepth_cli.dataset.predicted_depth import read_predicted_depth
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.dataset.time_stamps import time_warning
from pnpdepth_cli.errors import InputError, UsageError, unequal_sizes
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.frames.frame import registration_to_make, tensor_of
from pnpdepth_cli.io.depth import describe_range, holds_integers, read_depth
from pnpdepth_cli.io.formats import DepthFile, Reading
from pnpdepth_cli.io.rgb import orientation_in, read_rgb
from pnpdepth_cli.points import METRES, Size, SparsePoints
from pnpdepth_cli.sensors.projection import Points, as_depth_image
from pnpdepth_cli.sensors.simulation import sample_points
from pnpdepth_cli.settings import Settings

# Of the ground truth's pixels equal to the sparse depth gives a warning. KITTI's ground truth holds
# the points of its own scan by design, which is less than half of it.
_LEAK_FRACTION = 0.5


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
    # The image, and the ground truth, which has its size.
    rgb, truth, found = _read_pixels(files, options)
    whole = rgb if truth is None else truth.values
    size = None if whole is None else (whole.shape[0], whole.shape[1])
    # The sparse depth, from a file or sampled from the ground truth.
    if files.sparse is None:
        sparse = _sample_sparse(files, options, rgb, truth, seed)
    else:
        sparse = _read_sparse(files, options, size)
    given = sparse.points.tensors()
    gt, compared = None, list[str]()
    if truth is not None:
        gt = files.part.apply(truth.values)
        compared = _compare(files, options, gt, truth.reading, sparse, given)
    for depth in (files.sparse, files.gt):
        if files.image_file is not None and depth is not None:
            apart = time_warning(files.image_file, depth)
            compared += [] if apart is None else [apart]
    # The camera, and with it the points of neighbouring frames.
    size = size or given.size
    camera, of_camera = _camera_of(files, options, sparse.camera, size, needs_camera)
    used, held_out = _hold_out(given, holdout, seed)
    points, neighbours, lost = read_neighbours(
        files, used, camera, lambda other: _points_of(other, options, size, seed)
    )
    # Points that wrong poses moved say nothing of the image.
    contradicted = any(each.contradicts_images for each in neighbours)
    stated = sparse.camera is not None or files.one_view or options.registration == "off"
    one_view = contradicted or stated
    if rgb is not None and not one_view and files.is_first:
        compared += _orientation_warning(files, files.part.apply(rgb), given)
    # Depth maps of networks, in pixels of the whole image.
    predicted = list[NDArray[np.float32]]()
    for number, path in enumerate(files.depths, 1):
        whole_size = size if rgb is None else (rgb.shape[0], rgb.shape[1])
        read = read_predicted_depth(path, whole_size, rgb)
        predicted.append(np.ascontiguousarray(files.part.apply(read.values)))
        name = "depth" if len(files.depths) == 1 else f"depth {number}"
        found[name] = read.source, [*read.notes]
    # What a record and a person should know.
    found["sparse"] = sparse.record, [*sparse.notes]
    in_order = ["image", "sparse", *(name for name in found if name.startswith("depth")), "gt"]
    sources = {name: found[name] for name in in_order if name in found}
    notes = [note for _, lines in sources.values() for note in lines]
    notes += (*compared, *of_camera, *lost)
    if files.masks and truth is None:
        notes.append(
            f"mask {files.masks[0]} is of ground truth, of which there is none, so it is not used;"
            " a mask of the sparse depth is --sparse-mask, or sparse_mask in a list"
        )
    return ReadFrame(
        rgb=None if rgb is None else tensor_of(np.ascontiguousarray(files.part.apply(rgb))),
        points=points,
        own=given,
        of_matches=sparse.record.kind == "colmap",
        held_out=held_out,
        register=None if one_view else registration_to_make(options.registration, Settings()),
        one_view=one_view,
        gt=None if gt is None else np.ascontiguousarray(gt),
        predicted=tuple(torch.from_numpy(values) for values in predicted),
        depth_scale=sparse.reading.scale,
        sources={name: record for name, (record, _) in sources.items()},
        neighbours=tuple(neighbours),
        notes=tuple(notes),
        unit=sparse.unit,
        camera=camera,
        pose=np.array(files.pose) if sparse.pose is None and files.pose else sparse.pose,
    )


def _read_pixels(
    files: FrameFiles, options: ReadOptions
) -> tuple[NDArray[np.float32] | None, DepthFile | None, dict[str, tuple[FileRecord, list[str]]]]:
    """The image (H, W, 3) in 0..1, ground truth of its size, and records and lines for a person."""
    rgb = truth = size = None
    found = dict[str, tuple[FileRecord, list[str]]]()
    if files.image is not None:
        notes = list[str]()
        if isinstance(files.image, Path):
            image = read_rgb(files.image, upright=files.sparse is None or not files.sparse.is_dir())
            rgb, notes = image.values, [f"image: {image.note}"] if image.note else []
        else:
            rgb = arrays.read_image(files.image)
        size = (rgb.shape[0], rgb.shape[1])
        found["image"] = arrays.record_of(files.image, kind="image"), notes
    if files.gt is not None:
        truth, record, lines = _read_ground_truth(files, options, files.gt, size)
        found["gt"] = record, lines
        own = truth.values.shape
        if size is not None and size != own:
            raise unequal_sizes(f"ground truth {files.gt}", own, "the image", size)
        if not (truth.values > 0).any():
            raise InputError(f"ground truth {files.gt} has no pixel with known depth")
    return rgb, truth, found


def _read_ground_truth(
    files: FrameFiles, options: ReadOptions, source: Path, size: Size | None
) -> tuple[DepthFile, FileRecord, list[str]]:
    """The ground truth of an image (H, W): a projected scan, or a depth map."""
    (scale, of_integers), of_scan = _scale_of(files, options, "gt"), options.scan.over(files)
    if source.suffix.lower() in SCAN_ONLY_SUFFIXES:
        if files.kind_of_gt is not None:
            raise UsageError(f"{source} is a scan, so gt_kind does not apply")
        scan = read_scan_points(
            source, of_scan, size, files.image_file, scale=scale, of_integers=of_integers
        )
        notes = [note.replace("sparse:", "gt:", 1) for note in scan.notes]
        truth = DepthFile(values=as_depth_image(scan.points), reading=scan.reading)
        return truth, scan.record, notes
    # The option is of the scan or the floats beside it, unless the map has no scale of its own.
    file = arrays.raw_depth(source, files.image) or read_depth(source, scale=scale)
    if options.depth_scale and files.sparse is not None and _is_float(files.sparse, of_scan):
        own = arrays.raw_depth(source, files.image) or read_depth(source, scale=files.gt_scale)
        file = file if own.reading.assumed else own
    if (factor := inverse_factor("gt_kind", files.kind_of_gt)) is not None:
        file, scale = arrays.depth_of_inverse(file, factor, scale), None
    # Pixels that a mask or the gate rules out are unknown.
    values, reading = arrays.apply_masks(file.values, files.masks), file.reading
    if files.gt_other_size and size is not None and values.shape != size:
        values = arrays.move_depth(source, values, size)
    option = "--depth-scale" if files.sparse is None else _gt_scale_option(files)
    values, notes = plausible_map(values, reading, "gt", option, scale, of_integers=of_integers)
    described = describe_range(values, reading, noun="pixels", option=option)
    truth = DepthFile(values=values, reading=reading)
    return truth, arrays.record_of(source, reading), [f"gt: {described}", *notes]


def _scale_of(files: FrameFiles, options: ReadOptions, part: str) -> tuple[float | None, str]:
    """What is stated of a file's scale: numbers per metre, and whose integers these are.

    `--depth-scale` is of both files of a frame, but of the integers alone if one of them holds
    integers. What a layout states is of integers only.

    Args:
        files: The files of the frame.
        options: What the user states.
        part: Name of the file, "sparse" or "gt".
    """
    own, other = (files.sparse, files.gt) if part == "sparse" else (files.gt, files.sparse)
    of_layout = files.sparse_scale if part == "sparse" else files.gt_scale
    if options.depth_scale is None:
        return of_layout, "" if files.scales_stated else OF_DATA_SET
    if own is None or other is None or other.is_dir():
        return options.depth_scale, ""
    wanted = options.depth_scale if part == "sparse" else None
    if other.suffix.lower() in SCAN_ONLY_SUFFIXES or not holds_integers(other, of_scale=wanted):
        return options.depth_scale, ""
    return options.depth_scale, str(other)


def _is_float(sparse: Path, of_scan: ScanOptions) -> bool:
    """Whether the sparse depth is a scan, or a map or list of floats."""
    return not sparse.is_dir() and (of_scan.describes(sparse) or not holds_integers(sparse))


def _gt_scale_option(files: FrameFiles) -> str:
    """What sets the scale of ground truth beside sparse depth; `refine` names no frame."""
    return "gt_scale of a list" if files.name else "--depth-scale (of both files)"


def _sample_sparse(
    files: FrameFiles,
    options: ReadOptions,
    rgb: NDArray[np.float32] | None,
    truth: DepthFile | None,
    seed: int,
) -> sparse_depth.SparseDepth:
    """Points sampled from the ground truth."""
    if options.sparse_range or options.sparse_kind is not None:
        name = "--sparse-range" if options.sparse_range else "--sparse-kind"
        raise UsageError(f"{name} is of sparse depth from a file, and there is none")
    if options.sample is None:
        raise InputError(f"{files.image} has no sparse depth; add it, or sample the ground truth")
    if truth is None:
        raise InputError(f"{files.image} has no ground truth to sample points from; add it")
    seed = seed if options.sample.seed is None else options.sample.seed
    gt, image = files.part.apply(truth.values), None if rgb is None else files.part.apply(rgb)
    try:
        points = sample_points(gt, options.sample, seed, image=image)
    except UsageError as error:  # the pattern itself is good, this frame is too poor for it
        raise InputError(f"{files.gt}: {error}") from error
    how = f"{options.sample.kind} of the ground truth, seed {seed}"
    reading = Reading(how, truth.reading.scale)
    return sparse_depth.SparseDepth(
        points=points,
        reading=reading,
        record=FileRecord(
            path=str(files.gt), kind="sampled", sampled=replace(options.sample, seed=seed)
        ),
        notes=(f"sparse: {describe_range(points.depth, reading)}",),
    )


def _read_sparse(
    files: FrameFiles, options: ReadOptions, size: Size | None
) -> sparse_depth.SparseDepth:
    """The sparse depth of an image (H, W), in the part of it that the protocol keeps."""
    path, image, scan = files.sparse, files.image_file, options.scan.over(files)
    assert path is not None
    # What it is: a COLMAP model, a scan, or else a map or a list.
    is_model, (scale, of_integers) = path.is_dir(), _scale_of(files, options, "sparse")
    is_scan = not is_model and scan.describes(path)
    if options.depth_scale is not None and is_model and files.gt is None:
        raise UsageError(f"{path} is a COLMAP model; --unit-scale is its scale, not --depth-scale")
    if options.unit_scale is not None and not is_model:
        raise UsageError(f"{path} is no COLMAP model, so --unit-scale does not apply")
    kind = options.sparse_kind or files.kind_of_sparse
    if kind is not None and (is_model or is_scan):
        raise UsageError(f"{path} is no depth map or list, so --sparse-kind does not apply")
    if options.sparse_range and kind is not None:
        raise UsageError("--sparse-range is of distances, and --sparse-kind of another kind")
    if options.sparse_range and (is_model or is_scan):
        raise UsageError(f"{path} is no depth map or list, so --sparse-range does not apply")
    # Its points in the image.
    if is_model:
        if size is None or image is None:
            raise UsageError(f"{path} is a folder, taken for a COLMAP model, which needs the image")
        if replace(options.scan, keep_occluded=False) != ScanOptions():
            raise UsageError(f"{path} is a COLMAP model, so the options of a scan do not apply")
        sparse = sparse_depth.read_colmap_points(path, image, size, unit_scale=options.unit_scale)
    elif is_scan:
        sparse = read_scan_points(
            path,
            scan,
            size,
            image,
            scale=scale,
            of_integers=of_integers,
            search=files.is_first,
        )
    else:
        sparse = sparse_depth.read_map_points(
            path,
            options,
            size,
            scale,
            of_integers=of_integers,
            inverse=inverse_factor("--sparse-kind", kind),
        )
        if options.sparse_range:
            sparse = sparse_depth.depth_of_distances(sparse, scan, image)
    # Those that are sure enough, in the part of the frame.
    if files.sparse_mask is not None:
        sparse = sparse.confident(files.sparse_mask, files.min_confidence)
    return sparse.in_part(files.part)


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
    image, scan = files.image_file, options.scan.over(files)
    notes = list[str]()
    if known is None and scan.calib is not None:
        known, notes = arrays.camera_of_file(scan.calib, scan.camera, size, image)
    if known is None and is_needed:
        lacking = f"--html-3d needs the camera, and {image or files.sparse} has no calibration"
        known, notes = arrays.camera_of_exif(image, size, lacking)
    return None if known is None else files.part.camera_in_crop(known, size), notes


def _points_of(files: FrameFiles, options: ReadOptions, size: Size, seed: int) -> Points:
    """The points of another frame of the sequence, read or sampled as it does itself."""
    if files.sparse is not None:
        return _read_sparse(replace(files, is_first=False), options, size).points
    rgb, truth, _ = _read_pixels(files, options)
    return _sample_sparse(files, options, rgb, truth, seed).points


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
    sparse: sparse_depth.SparseDepth,
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
    depth, known = points.scatter()[0, 0].numpy(), int((gt > 0).sum())
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
