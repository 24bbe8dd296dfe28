"""Reads the depths of one frame, checks their sizes, and masks what the protocol does not score."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError, SizeError, UsageError
from pnpdepth_cli.io.dataset.reading import masked, read_mask
from pnpdepth_cli.io.depth import DepthImage, depth_from_stored, known_metres, load_stored
from pnpdepth_cli.io.layouts import Hdf5Array, read_frame_ground_truth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.sparse_reading import read_sparse
from pnpdepth_cli.pipeline.evaluation.pairing import FramePair
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol
from pnpdepth_cli.pipeline.evaluation.scaling import Fit, scaled
from pnpdepth_cli.pipeline.evaluation.stacks import load_stacked
from pnpdepth_cli.points import SparsePoints, in_frame
from pnpdepth_cli.sensors import SamplePattern, sample_points
from pnpdepth_cli.sensors.sparse import as_depth_image

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Scales:
    """How the user says that stored numbers are to be read; None leaves it to the files."""

    prediction: float | None = None
    """Codes per metre of integer predictions."""
    ground_truth: float | None = None
    """Codes per metre of integer ground truth."""
    sparse: float | None = None
    """Codes per metre of integer sparse depth."""
    channel: str | None = None
    """Which EXR channel or NPZ array holds the depth."""

    def as_record(self) -> dict[str, float | str | None]:
        """Returns the scales as records have them."""
        return {
            "prediction": self.prediction,
            "truth": self.ground_truth,
            "sparse": self.sparse,
            "channel": self.channel,
        }


@dataclass(frozen=True, kw_only=True)
class LoadedFrame:
    """Depths of one size (H, W) in float32 metres, 0 where unknown."""

    prediction: DepthImage | None
    """As it is scored: scaled, clipped, and filled in as the protocol says; None without a file."""
    ground_truth: DepthImage
    """0 also where the protocol does not score."""
    sparse: Depth | None
    """The points on their pixels; None where no file is known."""
    predicted: Mask | None = None
    """(H, W) true where the file has a prediction; None without a file."""
    fit: Fit | None = None
    """How the prediction was scaled to the ground truth, if it was."""
    sigma: Depth | None = None
    """Standard deviation of the prediction in metres, 0 where unknown, if a file has it."""
    tolerance: float = 0.0
    """Metres that rounding to integer codes can put between equal depths."""


def load_frame(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> LoadedFrame:
    """Returns the frame's depths as the protocol scores them.

    Raises:
        InputError: For a file that cannot be read.
        SizeError: Where sizes differ.
    """
    ground_truth = _read_ground_truth(pair, protocol, scales)
    size = (ground_truth.values.shape[0], ground_truth.values.shape[1])
    sparse, sparse_scale = _known_sparse(pair, protocol, scales, size)
    mask = _scored_mask(pair, ground_truth.values, protocol)
    if protocol.exclude_sparse:
        if sparse is None and pair.sampling is not None:
            sparse = _sampled_again(pair, pair.sampling, ground_truth.values)
        if sparse is None:
            raise InputError(
                f"frame {pair.name} has no sparse depth file to exclude; give it with --sparse"
            )
        mask &= sparse == 0
    half_codes = [0.5 / scale for scale in {ground_truth.scale, sparse_scale} if scale is not None]
    loaded = LoadedFrame(
        prediction=None,
        ground_truth=replace(
            ground_truth, values=np.where(mask, ground_truth.values, np.float32(0))
        ),
        sparse=sparse,
        tolerance=sum(half_codes),
    )
    return loaded if pair.prediction is None else _with_prediction(loaded, pair, protocol, scales)


def _with_prediction(
    loaded: LoadedFrame, pair: FramePair, protocol: EvalProtocol, scales: Scales
) -> LoadedFrame:
    """The frame with its prediction at the ground truth's size, scaled, clipped and filled in."""
    assert pair.prediction is not None
    gt = loaded.ground_truth.values
    size = (gt.shape[0], gt.shape[1])
    image = _read(pair.prediction, scales.prediction, scales.channel, protocol, pair.index)
    values = _to_size(pair, image.values, size, protocol)
    depth, fit = scaled(values, gt, gt > 0, protocol.prediction_kind, protocol.scale_by)
    predicted = values > 0
    if protocol.clip:
        depth = _clipped(depth, protocol)
    empty = ~(depth > 0)
    if protocol.missing == "fail" and (holes := int(np.count_nonzero(empty & (gt > 0)))):
        raise InputError(
            f"{pair.prediction} has no depth at {holes:,} pixels of the ground truth, which"
            " --missing fail refuses"
        )
    bounds = {"min": protocol.min_depth, "max": protocol.max_depth}
    bound = bounds.get(protocol.missing)
    if bound is not None:
        depth = np.where(empty, np.float32(bound), depth)
    return replace(
        loaded,
        prediction=replace(image, values=depth),
        predicted=predicted,
        fit=fit,
        sigma=_read_sigma(pair, size, fit, protocol),
    )


def _read_sigma(
    pair: FramePair, size: tuple[int, int], fit: Fit | None, protocol: EvalProtocol
) -> Depth | None:
    """(H, W) the standard deviation in metres, 0 where unknown; None where it is not known."""
    if pair.sigma is None or fit is not None or protocol.prediction_kind != "depth":
        return None
    try:
        values = depth_from_stored(pair.sigma, load_stored(pair.sigma, None), None).values
    except InputError:
        return None
    top, bottom, left, right = protocol.prediction_window(size)
    if values.shape != (bottom - top, right - left):
        return None
    placed = np.zeros(size, np.float32)
    placed[top:bottom, left:right] = values
    return placed


def _read_ground_truth(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> DepthImage:
    frame = pair.frame
    if isinstance(frame.gt, Hdf5Array):
        values, source = read_frame_ground_truth(frame), f"{frame.gt.path.suffix} array"
        return DepthImage(values=values, source=source, assumed_scale=False)
    if frame.gt is None:
        raise InputError(f"frame {pair.name} has no ground truth")
    scale = scales.ground_truth if scales.ground_truth is not None else frame.gt_scale
    image = _read(frame.gt, scale, scales.channel, protocol, pair.gt_index)
    values = masked(image.values, frame.masks)
    return replace(image, values=np.ascontiguousarray(frame.protocol.apply(values)))


def _read(
    path: Path,
    scale: float | None,
    channel: str | None,
    protocol: EvalProtocol,
    index: int | None = None,
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
    pair: FramePair, protocol: EvalProtocol, scales: Scales, size: tuple[int, int]
) -> tuple[Depth | None, float | None]:
    """As `_read_sparse`; (None, None) for an unusable file that the user did not name."""
    if pair.sparse_named or protocol.exclude_sparse:
        return _read_sparse(pair, protocol, scales, size)
    try:
        return _read_sparse(pair, protocol, scales, size)
    except InputError:
        return None, None


def _read_sparse(
    pair: FramePair, protocol: EvalProtocol, scales: Scales, size: tuple[int, int]
) -> tuple[Depth | None, float | None]:
    """(H, W) metres of the points on their pixels, 0 elsewhere; and the file's codes per metre."""
    if pair.sparse is None:
        return None, None
    scale = scales.sparse if scales.sparse is not None else pair.frame.sparse_scale
    sparse = read_sparse(pair.sparse, size=size, scale=scale)
    if sparse.assumed_scale and protocol.scale != sparse.scale:
        sparse = read_sparse(pair.sparse, size=size, scale=protocol.scale)
    xy, source_size = sparse.points.xy, sparse.points.size
    if source_size != size:
        xy = pair.frame.protocol.in_crop(xy, source_size)
        cut = pair.frame.protocol.apply(np.zeros(source_size, bool)).shape
        if cut != size:
            raise _different(pair, "sparse depth", pair.sparse, source_size, size, advice="")
    inside = in_frame(xy, size)
    points = SparsePoints(xy=xy[inside], depth=sparse.points.depth[inside], size=size)
    return as_depth_image(points), sparse.scale


def _sampled_again(pair: FramePair, sampling: dict[str, Any], ground_truth: Depth) -> Depth:
    """(H, W) the points that a run sampled from this ground truth, drawn again by its record."""
    pattern: dict[str, Any] = {each.name: sampling.get(each.name) for each in fields(SamplePattern)}
    image = None
    if isinstance(pair.image, Path):
        rgb = read_rgb(pair.image).values
        rgb = rgb if rgb.shape[:2] == ground_truth.shape else pair.frame.protocol.apply(rgb)
        image = rgb if rgb.shape[:2] == ground_truth.shape else None
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
            raise _different(pair, "mask", pair.mask, mask.shape, ground_truth.shape, advice="")
        scored &= mask
    elif protocol.mask is not None:
        raise InputError(f"frame {pair.name} has no mask in {protocol.mask}; add it")
    return scored


def _to_size(pair: FramePair, depth: Depth, size: tuple[int, int], protocol: EvalProtocol) -> Depth:
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


def _resized(depth: Depth, size: tuple[int, int], method: str) -> Depth:
    height, width = size
    if method == "nearest":
        resized = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        return np.asarray(resized, np.float32)
    known = (depth > 0).astype(np.float32)
    total, weight = (
        cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR) for part in (depth, known)
    )
    # a resized pixel is known where most of its interpolation weight is on known pixels
    return np.asarray(
        np.where(weight > 0.5, total / np.maximum(weight, np.float32(0.5)), 0), np.float32
    )


def _clipped(depth: Depth, protocol: EvalProtocol) -> Depth:
    clipped = np.clip(depth, protocol.min_depth, protocol.max_depth)
    return np.asarray(np.where(depth > 0, clipped, 0), np.float32)


def _different(
    pair: FramePair,
    what: str,
    path: Path | None,
    shape: Iterable[int],
    size: Iterable[int],
    *,
    advice: str,
) -> SizeError:
    (height, width), (rows, columns) = shape, size
    return SizeError(
        f"{what} {path} is {width}×{height} but the ground truth {pair.frame.gt} is"
        f" {columns}×{rows}{advice}"
    )
