"""Reads the depths of one frame, checks their sizes, and masks what the protocol does not score."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from pnpdepth_cli.commands.evaluation.measures import Depth, Floats, Mask, MeasuredFrame
from pnpdepth_cli.commands.evaluation.pairing import FramePair
from pnpdepth_cli.commands.evaluation.protocols import EvalProtocol
from pnpdepth_cli.commands.evaluation.scaling import Fit, scaled
from pnpdepth_cli.commands.evaluation.stacks import load_stacked
from pnpdepth_cli.errors import InputError, SizeError, UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.dataset import Hdf5Array
from pnpdepth_cli.io.dataset.reading import depth_of, masked, read_mask, rgb_of
from pnpdepth_cli.io.depth import DepthImage, depth_from_stored, known_metres, load_stored
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.sparse_files import read_sparse
from pnpdepth_cli.points import SparsePoints, in_frame
from pnpdepth_cli.sensors import SamplePattern, sample_points
from pnpdepth_cli.sensors.sparse import as_depth_image

Size = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Scales:
    """How the user says that stored numbers are to be read; None leaves it to the files."""

    prediction: float | None = None
    """Codes per metre of integers, here and in the next two."""
    truth: float | None = None
    sparse: float | None = None
    channel: str | None = None
    """Which EXR channel or NPZ array holds the depth."""


class DepthKind(NamedTuple):
    """What kind of depth file was read."""

    source: str
    """In words, such as `16-bit PNG ÷ 256`."""
    scale: float | None
    """Codes per metre; None for floats."""
    assumed: bool
    """True if neither the file nor the user nor the data set states the scale."""


@dataclass(frozen=True, kw_only=True)
class LoadedFrame(MeasuredFrame):
    """The depths as they are scored: scaled, clipped, and filled in as the protocol says."""

    kinds: dict[str, DepthKind]
    """Of the files by "prediction", "gt" and "sparse"."""
    predicted: Mask | None = None
    """(H, W) true where the file has a prediction; None without a file."""
    fit: Fit | None = None
    """How the prediction was scaled to the ground truth, if it was."""
    sigma: Depth | None = None
    """Standard deviation of the prediction in metres, 0 where unknown, if a file has it."""

    @property
    def tolerance(self) -> float:
        """Metres that rounding to integer codes can put between equal depths."""
        kinds = (self.kinds.get(side) for side in ("gt", "sparse"))
        return sum(0.5 / scale for scale in {k.scale for k in kinds if k and k.scale})


def load_frame(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> LoadedFrame:
    """Returns the frame's depths as the protocol scores them.

    Raises:
        InputError: For a file that cannot be read.
        SizeError: Where sizes differ.
    """
    whole = _read_ground_truth(pair, protocol, scales)
    gt = np.ascontiguousarray(pair.frame.protocol.apply(whole.values))
    size = (gt.shape[0], gt.shape[1])
    kinds = {"gt": _kind(whole)}
    sparse, kind = _known_sparse(pair, protocol, scales, size)
    if kind is not None:
        kinds["sparse"] = kind
    mask = _scored_mask(pair, gt, protocol)
    if protocol.exclude_sparse:
        if sparse is None and pair.sampling is not None:
            sparse = _sampled_again(pair, pair.sampling, gt)
        if sparse is None:
            raise InputError(
                f"frame {pair.name} has no sparse depth file to exclude; give it with --sparse"
            )
        mask &= sparse == 0
    frame = LoadedFrame(
        depth=np.zeros_like(gt),
        gt=np.where(mask, gt, np.float32(0)),
        sparse=sparse,
        intrinsics=_intrinsics(pair, protocol, (whole.values.shape[0], whole.values.shape[1])),
        kinds=kinds,
    )
    return frame if pair.prediction is None else _with_prediction(frame, pair, protocol, scales)


def _with_prediction(
    frame: LoadedFrame, pair: FramePair, protocol: EvalProtocol, scales: Scales
) -> LoadedFrame:
    """The frame with its prediction at the ground truth's size, scaled, clipped and filled in."""
    assert pair.prediction is not None
    size = (frame.gt.shape[0], frame.gt.shape[1])
    image = _read(pair.prediction, scales.prediction, scales.channel, protocol, pair.index)
    values = _to_size(pair, image.values, size, protocol)
    depth, fit = scaled(values, frame.gt, protocol.prediction_kind, protocol.scale_by)
    if protocol.clip:
        clipped = np.clip(depth, protocol.min_depth, protocol.max_depth)
        depth = np.where(depth > 0, clipped, 0).astype(np.float32)
    empty = ~(depth > 0)
    if protocol.missing == "fail" and (holes := int(np.count_nonzero(empty & (frame.gt > 0)))):
        raise InputError(
            f"{pair.prediction} has no depth at {holes:,} pixels of the ground truth, which"
            " --missing fail refuses"
        )
    bounds = {"min": protocol.min_depth, "max": protocol.max_depth}
    if (bound := bounds.get(protocol.missing)) is not None:
        depth = np.where(empty, np.float32(bound), depth)
    has_sigma = fit is None and protocol.prediction_kind == "depth"
    return replace(
        frame,
        depth=depth,
        kinds={"prediction": _kind(image), **frame.kinds},
        predicted=values > 0,
        fit=fit,
        sigma=_read_sigma(pair.sigma, size, protocol) if has_sigma else None,
    )


def _read_sigma(path: Path | None, size: Size, protocol: EvalProtocol) -> Depth | None:
    """(H, W) the standard deviation in metres, 0 where unknown; None where it is not known."""
    if path is None:
        return None
    try:
        values = depth_from_stored(path, load_stored(path, None), None).values
    except InputError:
        return None
    placed = np.zeros(size, np.float32)
    top, bottom, left, right = protocol.prediction_window(size)
    shown = placed[top:bottom, left:right]
    if values.shape != shown.shape:
        return None
    shown[:] = values
    return placed


def _kind(image: DepthImage) -> DepthKind:
    return DepthKind(image.source, image.scale, image.assumed_scale)


def _read_ground_truth(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> DepthImage:
    """The ground truth before the data set's crop."""
    frame = pair.frame
    if isinstance(frame.gt, Hdf5Array):
        values, source = masked(depth_of(frame.gt), frame.masks), f"{frame.gt.path.suffix} array"
        return DepthImage(values=values, source=source, assumed_scale=False)
    if frame.gt is None:
        raise InputError(f"frame {pair.name} has no ground truth")
    scale = scales.truth if scales.truth is not None else frame.gt_scale
    image = _read(frame.gt, scale, scales.channel, protocol, pair.index)
    return replace(image, values=masked(image.values, frame.masks))


def _intrinsics(pair: FramePair, protocol: EvalProtocol, size: Size) -> Floats | None:
    """(3, 3) of the frame as the data set cuts it, if a measure needs them and they are known."""
    frame = pair.frame
    if all(group.needs != "intrinsics" for group in protocol.measure_groups):
        return None
    if frame.calib is None and frame.calibration is None:
        return None
    calibration = frame.calibration
    if frame.calib is not None:
        calibration = read_calibration(frame.calib, frame.camera)
    assert calibration is not None
    return frame.protocol.intrinsics_in_crop(calibration.intrinsics, size)


def _read(
    path: Path, scale: float | None, channel: str | None, protocol: EvalProtocol, index: int | None
) -> DepthImage:
    """The depth image; codes are metres × the scale, else the file's own, else the protocol's."""
    stored = load_stored(path, channel) if index is None else load_stacked(path, index)
    assumed = scale is None and stored.scale is None and stored.values.dtype.kind != "f"
    scale = protocol.scale if assumed else scale
    image = depth_from_stored(path, stored, scale)
    if protocol.is_devkit and image.scale is not None and stored.values.ndim == 2:
        # the development kit reads every code but 0 as a depth, the largest too
        image = replace(image, values=known_metres(stored.values / image.scale))
    return replace(image, assumed_scale=assumed)


def _known_sparse(
    pair: FramePair, protocol: EvalProtocol, scales: Scales, size: Size
) -> tuple[Depth | None, DepthKind | None]:
    """(H, W) metres of the points on their pixels, 0 elsewhere, and the kind of file.

    (None, None) for an unusable file that the user did not name.
    """
    if pair.sparse is None:
        return None, None
    try:
        scale = scales.sparse if scales.sparse is not None else pair.frame.sparse_scale
        sparse = read_sparse(pair.sparse, size=size, scale=scale)
        assumed = sparse.assumed_scale
        if assumed and protocol.scale != sparse.scale:
            sparse = read_sparse(pair.sparse, size=size, scale=protocol.scale)
        xy, source_size = sparse.points.xy, sparse.points.size
        if source_size != size:
            xy = pair.frame.protocol.in_crop(xy, source_size)
            if pair.frame.protocol.apply(np.zeros(source_size, bool)).shape != size:
                raise _different(pair, "sparse depth", pair.sparse, source_size, size)
    except InputError:
        if pair.sparse_named or protocol.exclude_sparse:
            raise
        return None, None
    inside = in_frame(xy, size)
    points = SparsePoints(xy=xy[inside], depth=sparse.points.depth[inside], size=size)
    return as_depth_image(points), DepthKind(sparse.source, sparse.scale, assumed)


def _sampled_again(pair: FramePair, sampling: dict[str, Any], ground_truth: Depth) -> Depth:
    """(H, W) the points that a run sampled from this ground truth, drawn again by its record."""
    pattern: dict[str, Any] = {each.name: sampling.get(each.name) for each in fields(SamplePattern)}
    image = image_of(pair, ground_truth.shape) if isinstance(pair.image, Path) else None
    try:
        if pattern["region"] is not None:
            pattern["region"] = tuple(pattern["region"])
        drawn = SamplePattern(**pattern)
        points = sample_points(ground_truth, drawn, int(sampling["seed"]), image=image)
    except (KeyError, TypeError, ValueError, UsageError) as error:
        raise InputError(
            f"the points of frame {pair.name} cannot be sampled again as its record says"
            f" ({error}); give them with --sparse"
        ) from error
    if len(points.depth) < pair.sampled:
        raise InputError(
            f"the record of frame {pair.name} has {pair.sampled:,} points, but sampling again gives"
            f" {len(points.depth):,}: it is of another ground truth; give them with --sparse"
        )
    return as_depth_image(points)


def image_of(pair: FramePair, size: tuple[int, ...]) -> Depth | None:
    """Returns (H, W, 3) in 0…1, the frame's image; None unless one is known and of that size.

    Raises:
        InputError: If it cannot be read.
    """
    if pair.image is None:
        return None
    rgb = rgb_of(pair.image) if isinstance(pair.image, Hdf5Array) else read_rgb(pair.image).values
    if rgb.shape[:2] != size:
        rgb = pair.frame.protocol.apply(rgb)
    return rgb if rgb.shape[:2] == size else None


def _scored_mask(pair: FramePair, ground_truth: Depth, protocol: EvalProtocol) -> Mask:
    """(H, W) true where the protocol scores known ground truth."""
    top, bottom, left, right = protocol.window((ground_truth.shape[0], ground_truth.shape[1]))
    scored = np.zeros(ground_truth.shape, bool)
    scored[top:bottom, left:right] = True
    scored &= ground_truth > protocol.min_depth
    if protocol.max_depth is not None:
        scored &= ground_truth < protocol.max_depth
    if pair.mask is not None:
        mask = read_mask(pair.mask)
        if mask.shape != ground_truth.shape:
            raise _different(pair, "mask", pair.mask, mask.shape, ground_truth.shape)
        scored &= mask
    elif protocol.mask is not None:
        raise InputError(f"frame {pair.name} has no mask in {protocol.mask}; add it")
    return scored


def _to_size(pair: FramePair, depth: Depth, size: Size, protocol: EvalProtocol) -> Depth:
    """The depth map at the ground truth's size: as it is, in its crop, or resized if allowed."""
    top, bottom, left, right = protocol.prediction_window(size)
    view = (bottom - top, right - left)
    if depth.shape != view:
        if protocol.resize is None:
            raise _different(
                pair, "prediction", pair.prediction, depth.shape, view,
                advice="; --resize nearest or bilinear scales predictions if both show the same"
                " view, --pred-crop kb puts those of KITTI's benchmark crop in their place",
            )  # fmt: skip
        depth = _resized(depth, view, protocol.resize)
    if view == size:
        return depth
    placed = np.zeros(size, np.float32)
    placed[top:bottom, left:right] = depth
    return placed


def _resized(depth: Depth, size: Size, method: str) -> Depth:
    target = size[1], size[0]
    if method == "nearest":
        return cv2.resize(depth, target, interpolation=cv2.INTER_NEAREST_EXACT).astype(np.float32)
    known = (depth > 0).astype(np.float32)
    total, weight = (cv2.resize(part, target) for part in (depth, known))  # bilinear
    # a resized pixel is known where most of its interpolation weight is on known pixels
    return np.where(weight > 0.5, total / np.maximum(weight, 0.5), 0).astype(np.float32)


def _different(
    pair: FramePair,
    what: str,
    path: Path | None,
    shape: tuple[int, ...],
    size: tuple[int, ...],
    *,
    advice: str = "",
) -> SizeError:
    return SizeError(
        f"{what} {path} is {shape[1]}×{shape[0]} but the ground truth {pair.frame.gt} is"
        f" {size[1]}×{size[0]}{advice}"
    )
