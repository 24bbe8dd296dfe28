"""The files of a frame, read and checked against each other."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.commands.refinement.frame_camera import FrameCamera, camera_of_frame
from pnpdepth_cli.commands.refinement.neighbours import (
    read_neighbours,
    with_moved_points,
)
from pnpdepth_cli.commands.refinement.request import FrameFiles, RefineRequest
from pnpdepth_cli.commands.sparse.colmap import read_colmap_points
from pnpdepth_cli.commands.sparse.options import ColmapOptions, ScanOptions
from pnpdepth_cli.commands.sparse.scans import read_scan_points
from pnpdepth_cli.errors import InputError, NoPointsError, SizeError, UsageError
from pnpdepth_cli.frames.frame import METRES, Frame, Register, registration_to_make, tensor_of
from pnpdepth_cli.io.dataset import SCAN_ONLY_SUFFIXES, Hdf5Array, Source
from pnpdepth_cli.io.dataset.reading import check_same_view, depth_of, masked, moved_to, rgb_of
from pnpdepth_cli.io.depth import DepthImage, describe_range, implausible, metres, read_depth
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.sparse_files import read_sparse
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import (
    Points,
    as_depth_image,
    occluded_in_map,
    sample_points,
)

ImageArray = NDArray[np.float32]

_LEAK_FRACTION = 0.5  # of the ground truth's pixels equal to the sparse depth gives a warning
_FAR = 1000.0  # times the median depth; no point of an image is farther
_OTHER_SCALE = 1.5  # ratio of ground truth to sparse depth that no noise explains
_MIN_COMPARED = 10  # fewer points decide nothing


@dataclass(frozen=True, kw_only=True)
class Inputs(Frame):
    """A frame as it was read; `points` are those to use, with the neighbours'."""

    request: RefineRequest = field(default_factory=RefineRequest)
    own: SparsePoints
    """All points of the frame's own files, also those held out."""
    sparse_scale: float | None = None
    """Integers per metre of the sparse depth file. None if it holds metres."""
    record: dict[str, Any] = field(default_factory=dict)
    """Files and digests, for a record."""
    notes: tuple[str, ...] = ()
    """What was assumed, and warnings."""
    camera: FrameCamera | None = None
    """The camera in pixels of the image frame. None: unknown."""
    has_neighbours: bool = False
    """Whether `points` have those of other frames of the sequence."""

    @property
    def window(self) -> tuple[str, ...]:
        """Names of the frames of its window up to this one; empty outside of windows."""
        return self.request.files.window

    @property
    def own_used(self) -> int:
        """Number of its own points that are used."""
        return len(self.own) - (0 if self.held_out is None else len(self.held_out))


@dataclass(frozen=True, kw_only=True)
class _Part:
    """An image or depth map of the frame."""

    values: ImageArray
    """(H, W) or (H, W, 3), the part that the protocol keeps."""
    whole: tuple[int, int]
    """(H, W) before the protocol's crop."""
    record: dict[str, Any]
    notes: tuple[str, ...] = ()
    scale: float | None = None
    """Integers per metre of its file."""


@dataclass(frozen=True, kw_only=True)
class _Sparse:
    """The sparse depth of the frame."""

    points: SparsePoints
    scale: float | None
    """Integers per metre of its file."""
    record: dict[str, Any]
    notes: tuple[str, ...]
    unit: str = METRES
    camera: FrameCamera | None = None
    """The camera of the whole image, where it came with the points."""


def read_inputs(request: RefineRequest) -> Inputs:
    """Returns the frame that is asked for.

    Raises:
        InputError: A file cannot be used, or the files do not fit together.
    """
    files = request.files
    image = None if files.image is None else _read_image(files, files.image)
    whole = None if image is None else image.whole
    ground_truth = None if files.gt is None else _read_ground_truth(files, files.gt, whole)
    if ground_truth is not None:
        _check_ground_truth(files, ground_truth, whole)
    if files.sparse is None:
        sparse = _sampled(files, image, ground_truth, request.method.seed)
    else:
        sparse = _read_sparse(request, files.sparse, whole)
    sparse = _without_far_points(sparse)
    if ground_truth is not None and sparse.unit != METRES:
        raise UsageError(
            f"the ground truth {files.gt} is in metres but the sparse depth in {sparse.unit}; give"
            " --colmap unit-scale, or leave out --gt"
        )
    if ground_truth is not None and ground_truth.values.shape != sparse.points.size:
        raise _size_error(files, ground_truth.values.shape, sparse.points.size)
    size = whole or (None if ground_truth is None else ground_truth.whole) or sparse.points.size
    camera = camera_of_frame(request, sparse.camera, size)
    used, held_out = split_points(sparse.points, request.hold_out.holdout, request.method.seed)
    neighbours = read_neighbours(
        files, used, camera, lambda other: _points_of(request, other, size)
    )
    parts = {"image": image, "sparse": sparse, "gt": ground_truth}
    notes = [note for part in parts.values() if part is not None for note in part.notes]
    if ground_truth is not None and files.sparse is not None:
        notes += _leak_warning(sparse.points, ground_truth.values)
        notes += _scale_warning(sparse.points, ground_truth.values)
    notes += (*(() if camera is None else camera.notes), *neighbours.notes)
    points = used
    if neighbours.scans and camera is not None:
        points = with_moved_points(used, neighbours.scans, camera.camera)
    return Inputs(
        request=request,
        rgb=None if image is None else tensor_of(image.values),
        points=points,
        own=sparse.points,
        held_out=held_out,
        register=_register(request),
        gt=None if ground_truth is None else ground_truth.values,
        sparse_scale=sparse.scale,
        record={name: part.record for name, part in parts.items() if part is not None}
        | ({"neighbours": list(neighbours.record)} if neighbours.record else {}),
        notes=tuple(notes),
        unit=sparse.unit,
        camera=camera,
        has_neighbours=bool(neighbours.scans),
    )


def _register(request: RefineRequest) -> Register:
    """How the image is to be moved. A calibrated scan and SfM points are registered."""
    files = request.files
    calibrated = files.sparse is not None and (files.sparse.is_dir() or files.is_scan(files.sparse))
    if calibrated and files.registration == "auto":
        return None
    return registration_to_make(files.registration, request.method)


def split_points(
    points: SparsePoints, holdout: float, seed: int
) -> tuple[SparsePoints, SparsePoints]:
    """Returns (points to use, points held out).

    Args:
        points: All points.
        holdout: Fraction of the points to hold out at random; at least one unless it is 0.
        seed: Of the choice.

    Raises:
        UsageError: The fraction is not in 0…1, or there are too few points for it.
    """
    if not 0 <= holdout < 1:
        raise UsageError(f"--holdout must be a fraction, 0 <= F < 1, got {holdout}")
    mask = torch.zeros(len(points), dtype=torch.bool)
    if holdout > 0:
        if len(points) < 2:
            raise UsageError("holdout needs at least two sparse points")
        count = min(max(1, round(holdout * len(points))), len(points) - 1)
        order = np.random.default_rng(seed).permutation(len(points))
        mask[torch.from_numpy(order[:count])] = True
    return points.select(~mask), points.select(mask)


def _points_of(request: RefineRequest, files: FrameFiles, size: tuple[int, int]) -> SparsePoints:
    """The points of another frame of the sequence, read or sampled as it does itself."""
    if files.sparse is not None:
        return _read_sparse(replace(request, files=files), files.sparse, size).points
    image = None if files.image is None else _read_image(files, files.image)
    ground_truth = None if files.gt is None else _read_ground_truth(files, files.gt, size)
    return _sampled(files, image, ground_truth, request.method.seed).points


def _read_sparse(request: RefineRequest, path: Path, size: tuple[int, int] | None) -> _Sparse:
    """The sparse depth of one file for an image of (H, W)."""
    files = request.files
    if path.is_dir():
        return _read_colmap(files, path, size)
    if files.colmap != ColmapOptions():
        raise UsageError(f"{path} is no COLMAP model, so --colmap does not apply")
    if files.is_scan(path):
        return _read_scan(files, path, size)
    keep = files.scan.keep_occluded or request.method.preset is not None
    return _read_points(files, path, size, keep_occluded=keep)


def _without_far_points(sparse: _Sparse) -> _Sparse:
    """The sparse depth without points farther than anything in one image can be, with a note."""
    depth = sparse.points.depth
    median = float(depth.median())
    far = depth > _FAR * median
    count = int(far.sum())
    if not count or len(depth) < _MIN_COMPARED:
        return sparse
    note = (
        f"sparse: dropped {count:,} of {len(depth):,} points more than {_FAR:,.0f} times as far as"
        f" the median of {metres(median)} {sparse.unit}; the farthest was at"
        f" {metres(float(depth.max()))} {sparse.unit}"
    )
    return replace(sparse, points=sparse.points.select(~far), notes=(*sparse.notes, note))


def _scale_warning(points: SparsePoints, gt: ImageArray) -> list[str]:
    """A warning if ground truth and sparse depth differ by a factor where both are known."""
    depth = points.scatter()[0, 0].numpy()
    both = (depth > 0) & (gt > 0)
    if int(both.sum()) < _MIN_COMPARED:
        return []
    ratio = float(np.median(gt[both] / depth[both]))
    if 1 / _OTHER_SCALE <= ratio <= _OTHER_SCALE:
        return []
    return [
        f"warning: the ground truth is {ratio:.3g} times the sparse depth where both are known"
        f" (median of {int(both.sum()):,} pixels), so one of their scales is wrong; give --gt-scale"
        " or --depth-scale"
    ]


def _leak_warning(points: SparsePoints, gt: ImageArray) -> list[str]:
    """A warning if most of the ground truth is the sparse depth itself.

    KITTI's ground truth holds the points of its own scan by design, which is less than half of it.
    """
    known = gt > 0
    leaked = int((known & (points.scatter()[0, 0].numpy() == gt)).sum())
    fraction = leaked / int(known.sum())
    if fraction < _LEAK_FRACTION:
        return []
    return [
        f"warning: {leaked:,} of {int(known.sum()):,} pixels ({fraction:.1%}) of the ground truth"
        " are the sparse depth itself, so errors against it show nothing; give another --gt, or"
        " keep points out with --holdout"
    ]


def _read_image(files: FrameFiles, source: Source) -> _Part:
    if isinstance(source, Hdf5Array):
        rgb, note = rgb_of(source), None
    else:
        image = read_rgb(source, upright=files.sparse is None or not files.sparse.is_dir())
        rgb, note = image.values, image.note
    return _Part(
        values=np.ascontiguousarray(files.protocol.apply(rgb)),
        whole=(rgb.shape[0], rgb.shape[1]),
        record=_file_record(source),
        notes=(f"image: {note}",) if note else (),
    )


def _read_ground_truth(
    files: FrameFiles, source: Source, image_size: tuple[int, int] | None
) -> _Part:
    if isinstance(source, Path) and source.suffix.lower() in SCAN_ONLY_SUFFIXES:
        image = files.image if isinstance(files.image, Path) else None
        scan = read_scan_points(source, files.scan, image_size, image, files.calibration)
        return _Part(
            values=np.ascontiguousarray(files.protocol.apply(as_depth_image(scan.points))),
            whole=scan.points.size,
            record=scan.record,
            notes=tuple(note.replace("sparse:", "gt:", 1) for note in scan.notes),
        )
    if isinstance(source, Hdf5Array):
        ground_truth = DepthImage(values=depth_of(source), source="HDF5", assumed_scale=False)
    else:
        scale = files.gt_scale or files.depth_scale
        ground_truth = read_depth(source, scale=scale, channel=files.channel)
    values = masked(ground_truth.values, files.gt_masks)
    if files.gt_size_ok and image_size not in (None, values.shape):
        assert image_size is not None
        path = source.path if isinstance(source, Hdf5Array) else source
        values = moved_to(path, values, image_size)
    described = describe_range(
        values,
        ground_truth.source,
        assumed_scale=ground_truth.assumed_scale,
        noun="pixels",
        option="--gt-scale",
    )
    return _Part(
        values=np.ascontiguousarray(files.protocol.apply(values)),
        whole=(values.shape[0], values.shape[1]),
        record=_file_record(source) | {"read_as": ground_truth.source},
        notes=(f"gt: {described}",),
        scale=ground_truth.scale,
    )


def _file_record(source: Source) -> dict[str, Any]:
    path = source.path if isinstance(source, Hdf5Array) else source
    return {"path": str(source), "sha256": fingerprint(path).sha256}


def _sampled(
    files: FrameFiles, image: _Part | None, ground_truth: _Part | None, seed: int
) -> _Sparse:
    """Points sampled from the ground truth."""
    if files.sample is None:
        raise InputError(f"{files.image} has no sparse depth; add it, or sample the ground truth")
    if ground_truth is None:
        raise InputError(f"{files.image} has no ground truth to sample points from; add it")
    rgb = None if image is None else image.values
    try:
        points = sample_points(ground_truth.values, files.sample, seed, image=rgb)
    except UsageError as error:  # the pattern itself is good, this frame is too poor for it
        raise InputError(f"{files.gt}: {error}") from error
    source = f"{files.sample.kind} of the ground truth, seed {seed}"
    return _Sparse(
        points=points.tensors(),
        scale=ground_truth.scale,
        record={"sampled_from": str(files.gt), **asdict(files.sample), "seed": seed},
        notes=(f"sparse: {describe_range(points.depth, source)}",),
    )


def _read_scan(files: FrameFiles, path: Path, image_size: tuple[int, int] | None) -> _Sparse:
    image = files.image if isinstance(files.image, Path) else None
    scan = read_scan_points(path, files.scan, image_size, image, files.calibration)
    points = _in_protocol(files, path, scan.points.tensors())
    return _Sparse(
        points=points,
        scale=None,
        record=scan.record,
        notes=scan.notes,
        camera=FrameCamera(camera=scan.camera, source=f"calibration of {path.name}"),
    )


def _read_colmap(files: FrameFiles, path: Path, image_size: tuple[int, int] | None) -> _Sparse:
    if image_size is None or not isinstance(files.image, Path):
        raise UsageError(f"{path} is a folder, taken for a COLMAP model, which needs the image")
    if files.scan != ScanOptions():
        raise UsageError(f"{path} is a COLMAP model, so the options of a LiDAR scan do not apply")
    observed = read_colmap_points(
        path, files.colmap, files.image, image_size, any_size=files.sparse_size_ok
    )
    return _Sparse(
        points=_in_protocol(files, path, observed.points.tensors()),
        scale=observed.scale,
        record=observed.record,
        notes=observed.notes,
        unit=observed.unit,
        camera=FrameCamera(
            camera=observed.camera, source=f"COLMAP model {path}", pose=observed.pose
        ),
    )


def _read_points(
    files: FrameFiles, path: Path, image_size: tuple[int, int] | None, *, keep_occluded: bool
) -> _Sparse:
    scale = files.sparse_scale or files.depth_scale
    sparse = read_sparse(path, size=image_size, scale=scale, channel=files.channel)
    sparse_size, depth = sparse.points.size, sparse.points.depth
    size = image_size or sparse_size
    check_same_view(str(path), sparse_size, size)
    if sparse_size != size and not files.sparse_size_ok:
        raise SizeError(
            f"{path} is {sparse_size[1]}×{sparse_size[0]} but {files.image} is"
            f" {size[1]}×{size[0]}; --sparse-size-ok maps the points if both show the same view"
        )
    visible, record, notes = _visible(sparse.points, keep_occluded)
    points = _inside(path, visible.tensors().resized(*size))
    described = describe_range(depth, sparse.source, assumed_scale=sparse.assumed_scale)
    notes = [f"sparse: {described}", *notes]
    if len(points) < len(visible):
        notes.append(f"sparse: {len(visible) - len(points):,} points outside the image")
    notes += [f"warning: {text}" for text in [implausible(depth, sparse.scale)] if text]
    return _Sparse(
        points=_in_protocol(files, path, points),
        scale=sparse.scale,
        record=_file_record(path) | {"read_as": sparse.source} | record,
        notes=tuple(notes),
    )


def _visible(points: Points, keep_occluded: bool) -> tuple[Points, dict[str, Any], list[str]]:
    """The points without occluded ones, and entries of the record and notes on these."""
    hidden = None if keep_occluded else occluded_in_map(points)
    if hidden is None or not hidden.any():
        return points, {}, []
    count = int(hidden.sum())
    note = (
        f"sparse: a projected LiDAR scan; dropped {count:,} points occluded from the camera by"
        " nearer ones; --scan keep-occluded keeps them"
    )
    return points.select(~hidden), {"dropped": {"hidden by foreground": count}}, [note]


def _in_protocol(files: FrameFiles, path: Path, points: SparsePoints) -> SparsePoints:
    """The points in the part of the image that the protocol keeps, in coordinates of that part."""
    # An array of the image's size that takes no memory, to find the size of that part.
    kept = files.protocol.apply(np.broadcast_to(np.False_, points.size))
    size = (kept.shape[0], kept.shape[1])
    if size == points.size:
        return points
    xy = files.protocol.in_crop(points.xy.numpy(), points.size)
    return _inside(path, SparsePoints(xy=torch.from_numpy(xy), depth=points.depth, size=size))


def _inside(path: Path, points: SparsePoints) -> SparsePoints:
    inside = points.cropped(0, 0, *points.size)
    if not len(inside):
        raise NoPointsError(f"{path}: none of its {len(points)} points lies in the image")
    return inside


def _check_ground_truth(
    files: FrameFiles, ground_truth: _Part, image_size: tuple[int, int] | None
) -> None:
    if image_size is not None and ground_truth.whole != image_size:
        raise _size_error(files, ground_truth.whole, image_size)
    if not bool((ground_truth.values > 0).any()):
        raise InputError(f"ground truth {files.gt} has no pixel with known depth")


def _size_error(files: FrameFiles, size: tuple[int, ...], image_size: tuple[int, int]) -> SizeError:
    return SizeError(
        f"ground truth {files.gt} is {size[1]}×{size[0]} but the image is"
        f" {image_size[1]}×{image_size[0]}"
    )
