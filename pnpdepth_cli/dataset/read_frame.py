"""The files of a frame, read and checked against each other."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.dataset.arrays import (
    apply_masks,
    check_same_view,
    depth_of,
    move_depth,
    moved_note,
    read_image,
    read_levels,
)
from pnpdepth_cli.dataset.colmap_points import read_colmap_points
from pnpdepth_cli.dataset.frame_camera import camera_of_file, camera_of_frame
from pnpdepth_cli.dataset.frame_files import (
    SCAN_ONLY_SUFFIXES,
    FrameFiles,
    ImageSource,
    RawDepth,
    Source,
    file_of,
)
from pnpdepth_cli.dataset.neighbours import read_neighbours
from pnpdepth_cli.dataset.plausible import (
    check_pixels,
    check_same_scale,
    divisor_to_metres,
    far_values,
    plausible_map,
)
from pnpdepth_cli.dataset.read_options import METRES, ReadOptions, ScanOptions
from pnpdepth_cli.dataset.scan_points import SparseDepth, read_scan_points
from pnpdepth_cli.errors import InputError, NoPointsError, SizeError, UsageError
from pnpdepth_cli.file_record import FileRecord, Sampling
from pnpdepth_cli.frames.frame import Frame, registration_to_make, tensor_of
from pnpdepth_cli.io.depth import describe_range, read_depth
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.io.formats import DepthFile, Reading
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.sparse_files import read_sparse
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import (
    as_depth_image,
    behind_foreground,
    occluded_in_map,
    sample_points,
)
from pnpdepth_cli.sensors.lens import rays_of
from pnpdepth_cli.settings import Settings

ImageArray = NDArray[np.float32]

_FEW_LEVELS = 4  # of confidence; their counts are listed
_LEAK_FRACTION = 0.5  # of the ground truth's pixels equal to the sparse depth gives a warning


def read_frame(
    files: FrameFiles,
    options: ReadOptions,
    *,
    seed: int = 0,
    holdout: float = 0.0,
    needs_camera: bool = False,
) -> Frame:
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
    if options.sparse_range and files.sparse is None:
        raise UsageError("--sparse-range is of sparse depth from a file, and there is none")
    crop = files.part.apply
    notes, sources = list[str](), dict[str, FileRecord]()
    rgb: ImageArray | None = None
    gt: ImageArray | None = None
    whole: tuple[int, int] | None = None
    # the image
    if files.image is not None:
        image, note = _read_image(files, files.image)
        whole, rgb = (image.shape[0], image.shape[1]), np.ascontiguousarray(crop(image))
        sources["image"] = _file_record(files.image)
        notes += [f"image: {note}"] if note else []
    # the ground truth, which has the image's size
    truth_reading: Reading | None = None
    truth_notes: list[str] = []
    if files.gt is not None:
        truth, of_truth, truth_notes = _read_ground_truth(files, options, files.gt, whole)
        gt, truth_reading = np.ascontiguousarray(crop(truth.values)), truth.reading
        if whole is not None and whole != truth.values.shape:
            raise _size_error(files, truth.values.shape, whole)
        if not bool((gt > 0).any()):
            raise InputError(f"ground truth {files.gt} has no pixel with known depth")
    # the sparse depth
    if files.sparse is None:
        scale = truth_reading and truth_reading.scale
        sparse = _sample_sparse(files, options, rgb, gt, scale, seed)
    else:
        sparse = _read_sparse(files, options, whole)
    given = sparse.points
    if gt is not None and sparse.unit != METRES:
        raise UsageError(
            f"the ground truth {files.gt} is in metres but the sparse depth in {sparse.unit}; give"
            " --unit-scale, or leave out --gt"
        )
    if gt is not None and gt.shape != given.size:
        raise _size_error(files, gt.shape, given.size)
    sources["sparse"] = sparse.record
    notes += (*sparse.notes, *truth_notes)
    if files.gt is not None:
        sources["gt"] = of_truth
        size = whole or (truth.values.shape[0], truth.values.shape[1])
    else:
        size = whole or given.size
    # the camera, and with it the points of neighbouring frames
    camera, of_camera = camera_of_frame(files, options, sparse, size, needs_camera=needs_camera)
    used, held_out = _hold_out(given, holdout, seed)
    points, neighbours, lost = read_neighbours(
        files, used, camera, lambda other: _points_of(other, options, size, seed)
    )
    # the ground truth against the sparse depth
    readings = {"gt": truth_reading, "sparse": sparse.reading}
    if gt is not None and files.sparse is not None:
        depth = given.scatter()[0, 0].numpy()
        notes += _leak_warning(depth, gt)
        by_option = {"--depth-scale": readings["sparse"], "gt_scale of a list": readings["gt"]}
        notes += check_same_scale(depth, gt, by_option)
    notes += (*of_camera, *lost)
    if files.masks and files.gt is None:
        notes.append(
            f"mask {files.masks[0]} is of ground truth, of which there is none, so it is not used;"
            " a mask of the sparse depth is --sparse-mask, or sparse_mask in a list"
        )
    # points that wrong poses moved say nothing of the image
    contradicted = any(each.contradicts_images for each in neighbours)
    one_view = contradicted or _is_one_view(files, options)
    return Frame(
        rgb=None if rgb is None else tensor_of(rgb),
        points=points,
        given=given,
        held_out=held_out,
        register=None if one_view else registration_to_make(options.registration, Settings()),
        one_view=one_view,
        gt=gt,
        depth_scale=sparse.reading.scale,
        sources=sources,
        neighbours=tuple(neighbours),
        notes=tuple(notes),
        unit=sparse.unit,
        camera=camera,
        pose=np.array(files.pose) if sparse.pose is None and files.pose else sparse.pose,
    )


def _is_one_view(files: FrameFiles, options: ReadOptions) -> bool:
    """Whether image and points are of one view, as a calibrated scan and SfM points are.

    The user or the data set may say so, too.
    """
    sparse = files.sparse
    calibrated = sparse is not None and (sparse.is_dir() or _is_scan(sparse, files, options))
    return calibrated or files.one_view or options.registration == "off"


def _is_scan(path: Path, files: FrameFiles, options: ReadOptions) -> bool:
    """Whether sparse depth is a scan, by the calibration of the user or of the data set."""
    return (options.scan.over(files) if files.calib else options.scan).describes(path)


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


def _points_of(
    files: FrameFiles, options: ReadOptions, size: tuple[int, int], seed: int
) -> SparsePoints:
    """The points of another frame of the sequence, read or sampled as it does itself."""
    if files.sparse is not None:
        return _read_sparse(files, options, size).points
    crop = files.part.apply
    rgb: ImageArray | None = None
    gt: ImageArray | None = None
    if files.image is not None:
        rgb = np.ascontiguousarray(crop(_read_image(files, files.image)[0]))
    if files.gt is not None:
        truth, _, _ = _read_ground_truth(files, options, files.gt, size)
        gt = np.ascontiguousarray(crop(truth.values))
    return _sample_sparse(files, options, rgb, gt, None, seed).points


def _read_image(files: FrameFiles, source: ImageSource) -> tuple[ImageArray, str | None]:
    """The image (H, W, 3), and what a person should know of it."""
    if not isinstance(source, Path):
        return read_image(source), None
    image = read_rgb(source, upright=files.sparse is None or not files.sparse.is_dir())
    return image.values, image.note


def _read_ground_truth(
    files: FrameFiles,
    options: ReadOptions,
    source: Source | RawDepth,
    size: tuple[int, int] | None,
) -> tuple[DepthFile, FileRecord, list[str]]:
    """The ground truth of an image (H, W), what a record keeps of it, and lines for a person."""
    scale = options.depth_scale or files.gt_scale
    if isinstance(source, Path) and source.suffix.lower() in SCAN_ONLY_SUFFIXES:
        of_scan = options.scan.over(files)
        scan = read_scan_points(source, of_scan, size, files.image_file, scale=scale)
        truth = DepthFile(values=as_depth_image(scan.points), reading=scan.reading)
        return truth, scan.record, [note.replace("sparse:", "gt:", 1) for note in scan.notes]
    if not isinstance(source, Path):
        truth = DepthFile(values=depth_of(source), reading=Reading(f"{source.path.suffix} array"))
    else:
        truth = read_depth(source, scale=scale)
        has_scan = files.sparse is not None and _is_scan(files.sparse, files, options)
        if has_scan and options.depth_scale is not None:
            own = read_depth(source, scale=files.gt_scale)  # the option is that of the scan
            truth = truth if own.reading.assumed else own
    values = apply_masks(truth.values, files.masks)
    if files.gt_other_size and size is not None and values.shape != size:
        values = move_depth(file_of(source), values, size)
    values, notes = plausible_map(values, truth.reading, "gt", "gt_scale of a list", scale)
    described = describe_range(values, truth.reading, noun="pixels", option="gt_scale of a list")
    record = _file_record(source, truth.reading)
    return replace(truth, values=values), record, [f"gt: {described}", *notes]


def _file_record(source: ImageSource | RawDepth, reading: Reading | None = None) -> FileRecord:
    record = FileRecord(path=str(source), sha256=fingerprint(file_of(source)).sha256)
    if reading is None:
        return record
    return replace(record, read_as=reading.source, scale=reading.scale, assumed=reading.assumed)


def _sample_sparse(
    files: FrameFiles,
    options: ReadOptions,
    rgb: ImageArray | None,
    gt: ImageArray | None,
    scale: float | None,
    seed: int,
) -> SparseDepth:
    """Points sampled from the ground truth, whose file has `scale` integers per metre."""
    if options.sample is None:
        raise InputError(f"{files.image} has no sparse depth; add it, or sample the ground truth")
    if gt is None:
        raise InputError(f"{files.image} has no ground truth to sample points from; add it")
    seed = seed if options.sample_seed is None else options.sample_seed
    try:
        points = sample_points(gt, options.sample, seed, image=rgb)
    except UsageError as error:  # the pattern itself is good, this frame is too poor for it
        raise InputError(f"{files.gt}: {error}") from error
    reading = Reading(f"{options.sample.kind} of the ground truth, seed {seed}", scale)
    return SparseDepth(
        points=points.tensors(),
        reading=reading,
        record=FileRecord(
            path=str(files.gt), sampled=Sampling(**asdict(options.sample), seed=seed)
        ),
        notes=(f"sparse: {describe_range(points.depth, reading)}",),
    )


def _read_sparse(
    files: FrameFiles, options: ReadOptions, size: tuple[int, int] | None
) -> SparseDepth:
    """The sparse depth of an image (H, W), in the part of it that the protocol keeps."""
    path, image = files.sparse, files.image_file
    assert path is not None
    if path.is_dir():
        if size is None or image is None:
            raise UsageError(f"{path} is a folder, taken for a COLMAP model, which needs the image")
        if replace(options.scan, keep_occluded=False) != ScanOptions():
            raise UsageError(
                f"{path} is a COLMAP model, so the options of a LiDAR scan do not apply"
            )
        sparse = read_colmap_points(path, image, size, unit_scale=options.unit_scale)
    elif options.unit_scale is not None:
        raise UsageError(f"{path} is no COLMAP model, so --unit-scale does not apply")
    elif _is_scan(path, files, options):
        scale = options.depth_scale or files.sparse_scale
        sparse = read_scan_points(path, options.scan.over(files), size, image, scale=scale)
    else:
        sparse = _read_points(files, options, path, size)
        if options.sparse_range:
            sparse = _of_distances(sparse, files, options)
    if options.sparse_range and (path.is_dir() or _is_scan(path, files, options)):
        raise UsageError(f"{path} is no depth map or list, so --sparse-range does not apply")
    if files.sparse_mask is not None:
        sparse = _confident(sparse, files.sparse_mask, files.min_confidence)
    points = sparse.points.tensors()
    # an array of the image's size that takes no memory, to find the size of the part
    part = files.part.apply(np.broadcast_to(np.False_, points.size)).shape
    if part != points.size:
        xy = torch.from_numpy(files.part.in_crop(points.xy.numpy(), points.size))
        whole = SparsePoints(xy=xy, depth=points.depth, size=(part[0], part[1]))
        points = whole.cropped(0, 0, *whole.size)
        if not len(points):
            raise NoPointsError(f"{path}: none of its {len(whole)} points lies in the image")
    return replace(sparse, points=points)


def _of_distances(sparse: SparseDepth, files: FrameFiles, options: ReadOptions) -> SparseDepth:
    """The points with depth z made of distances to the camera.

    Points where the lens shows nothing go.
    """
    scan = options.scan.over(files)
    if scan.calib is None:
        raise UsageError("--sparse-range needs the camera of the distances; give --calib")
    points = sparse.points.tensors()
    camera, _ = camera_of_file(scan.calib, scan.camera, points.size, files.image_file)
    length = np.linalg.norm(
        np.column_stack([rays_of(camera, points.xy.numpy()), np.ones(len(points))]), axis=1
    )
    seen = np.isfinite(length)
    depth = (points.depth.double() / torch.from_numpy(length)).float()
    points = replace(points, depth=depth).select(torch.from_numpy(seen))
    note = (
        f"sparse: distances became depth, ÷ {length[seen].min():.3f} to {length[seen].max():.3f}"
        f" by the camera of {scan.calib}"
    )
    record = replace(sparse.record, read_as=f"{sparse.record.read_as}, distances")
    return replace(sparse, points=points, record=record, notes=(*sparse.notes, note))


def _confident(sparse: SparseDepth, path: Path, least: float | None) -> SparseDepth:
    """The points whose confidence is at least `least`, above 0 for None."""
    levels, points = read_levels(path), sparse.points.tensors()
    size = (levels.shape[0], levels.shape[1])
    check_same_view(str(path), size, points.size)
    xy = points.resized(*size).xy.numpy()
    column, row = np.floor(xy + 0.5).astype(np.intp).T
    own = levels[row.clip(0, size[0] - 1), column.clip(0, size[1] - 1)]
    kept = own > 0 if least is None else own >= least
    values, counts = np.unique(own, return_counts=True)
    listing = ", ".join(f"{n:,} of {v:g}" for v, n in zip(values, counts, strict=True))
    note = (
        f"sparse: {np.count_nonzero(kept):,} of {len(own):,} points have a confidence"
        f" {'above 0' if least is None else f'of {least:g} or more'} in {path}"
        + (f" ({listing})" if len(values) <= _FEW_LEVELS else "")
    )
    if not kept.any():
        raise NoPointsError(f"{note.removeprefix('sparse: ')}; lower --min-confidence")
    dropped = sparse.record.dropped | {"of low confidence": int((~kept).sum())}
    record = replace(sparse.record, mask=str(path), least=least, dropped=dropped)
    return replace(
        sparse,
        points=points.select(torch.from_numpy(kept)),
        record=record,
        notes=(*sparse.notes, note),
    )


def _read_points(
    files: FrameFiles, options: ReadOptions, path: Path, image_size: tuple[int, int] | None
) -> SparseDepth:
    """The points of a depth map or a list, in the image."""
    scale = options.depth_scale or files.sparse_scale
    # The points as they are stored, without far values.
    visible, reading = read_sparse(path, size=image_size, scale=scale)
    far, lines = far_values(visible.depth)
    visible = visible.select(~far)
    depth = visible.depth
    size = image_size or visible.size
    check_same_view(str(path), visible.size, size)
    # What a person should know of them.
    notes = [f"sparse: {describe_range(depth, reading)}", *(f"sparse: {line}" for line in lines)]
    record = _file_record(path, reading)
    if visible.size != size:
        notes.append(f"sparse: {moved_note(visible.size, size)}")
    # Points that the camera does not see go.
    keep_occluded = options.scan.keep_occluded
    if options.foreground is not None:
        behind = behind_foreground(visible, *options.foreground)
        visible, count = visible.select(~behind), int(behind.sum())
        record = replace(record, dropped={"behind the foreground": count})
        notes.append(f"sparse: dropped {count:,} points behind others, as the protocol does")
        keep_occluded = True
    hidden = None if keep_occluded else occluded_in_map(visible)
    if hidden is not None and hidden.any():
        visible, count = visible.select(~hidden), int(hidden.sum())
        record = replace(record, dropped={"hidden by foreground": count})
        notes.append(
            f"sparse: a projected LiDAR scan; dropped {count:,} points occluded from the camera by"
            " nearer ones; --preset paper keeps them"
        )
    # The others must be pixels of the image, and plausible in metres.
    points = visible.tensors().resized(*size)
    inside, of_pixels = check_pixels(path, points.xy.numpy(), size)
    divisor, warnings = divisor_to_metres(depth, reading, "sparse", "--depth-scale", scale)
    points = points.select(torch.from_numpy(inside))
    notes += (*of_pixels, *warnings)
    return SparseDepth(
        points=replace(points, depth=points.depth / divisor),
        reading=reading,
        record=record,
        notes=tuple(notes),
    )


def _leak_warning(sparse: ImageArray, gt: ImageArray) -> list[str]:
    """A warning if most of the ground truth is the sparse depth itself.

    KITTI's ground truth holds the points of its own scan by design, which is less than half of it.
    """
    known = gt > 0
    leaked = int((known & (sparse == gt)).sum())
    fraction = leaked / int(known.sum())
    if fraction < _LEAK_FRACTION:
        return []
    return [
        f"warning: {leaked:,} of {int(known.sum()):,} pixels ({fraction:.1%}) of the ground truth"
        " are the sparse depth itself, so errors against it show nothing; give another --gt, or"
        " keep points out with --holdout"
    ]


def _size_error(files: FrameFiles, size: tuple[int, ...], image_size: tuple[int, int]) -> SizeError:
    return SizeError(
        f"ground truth {files.gt} is {size[1]}×{size[0]} but the image is"
        f" {image_size[1]}×{image_size[0]}"
    )
