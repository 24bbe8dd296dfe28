"""Scores one frame: reads its depths, masks what the protocol does not score, and measures.

Predictions of relative networks are scaled to the ground truth of each image (`scale_prediction`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_errors
from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.commands.shared.results import ResultFrame
from pnpdepth_cli.completion.two_depths import compare_depths
from pnpdepth_cli.dataset.arrays import (
    apply_masks,
    camera_of_file,
    depth_of_inverse,
    raw_depth,
    read_image,
)
from pnpdepth_cli.dataset.frame_files import FrameFiles, inverse_factor
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.dataset.plausible import OF_DATA_SET, plausible_map
from pnpdepth_cli.errors import InputError, PnpDepthError, unequal_sizes
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import depth_from_stored, known_metres, load_stored
from pnpdepth_cli.io.formats import DepthFile, Reading
from pnpdepth_cli.io.point_files import read_sparse
from pnpdepth_cli.measures import AFTER, GT, OF_SIGMA, score
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.protocols import Protocol
from pnpdepth_cli.sensors.lens import rays_of_image
from pnpdepth_cli.sensors.projection import pixel_index
from pnpdepth_cli.sensors.simulation import sample_points

Depth = NDArray[np.float32]
"""(H, W) metres, 0 where unknown, unless said otherwise."""
Mask = NDArray[np.bool_]
Size = tuple[int, ...]
"""(H, W)."""
Fit = tuple[float, float]
"""(factor, shift): depth = factor · predicted + shift, or the same in disparity (1/m)."""

FILES = ("prediction", "gt", "sparse", "image")
"""The files of a frame in its record; the first two are compared."""

_CROPS = {
    "none": (0.0, 1.0, 0.0, 1.0),
    # Garg et al. 2016 for KITTI; and what Godard et al. (monodepth, utils/evaluate_kitti.py) found
    # by trial to reproduce Eigen et al. 2014. Nearly all later evaluations use these two.
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),
    "eigen": (0.3324324, 0.91351351, 0.0359477, 0.96405229),
    # Eigen et al. 2014 for NYU Depth v2: rows 45 to 470, columns 41 to 600 of 480x640 pixels.
    "nyu": (45 / 480, 471 / 480, 41 / 640, 601 / 640),
}
"""(top, bottom, left, right) of each crop as fractions of the frame, cut to whole pixels."""
_CUT = (352, 1216)
"""(H, W) of KITTI's frames cut at the bottom, in the middle, as its depth benchmark has them."""
_WHOLE = (375, 1242)
"""(H, W) of most frames they are from."""
_MOST = 0.5
"""Weight of known pixels in a resized pixel above which that one is known: more than half."""


class _Read(NamedTuple):
    """A depth map that was read to be scored."""

    values: Depth  # (H, W) metres, 0 = unknown; of a relative prediction in its own numbers
    reading: Reading  # format of the file, and the scale of its integers
    notes: list[str]  # lines for a person
    added: float = 0.0
    """What was added to all numbers to make them positive, which the fit of a shift removes."""


class _Scored(NamedTuple):
    """The scores of a frame, and how its files were read."""

    scores: Scores
    readings: dict[str, Reading]
    """Format and scale of the prediction and of the ground truth, by the names of `FILES`."""
    notes: list[str]
    """Lines for a person."""


def score_frame(files: FrameFiles, result: ResultFrame | None, request: EvalRequest) -> FrameRecord:
    """Returns the record of a scored frame, with its scores, or why it has none.

    Beside the measures, the scores have numbers of pixels: "pixels" are scored, "known" have ground
    truth, "predicted" have a prediction in the file as well, and "given" are scored pixels at which
    the network was given a point. "coverage" is predicted over known. "median_ratio" is that of
    prediction over ground truth, "ratio_spread" half of the range of the middle 68 % of its log.
    "rank_correlation" is Spearman's, of the prediction as it is stored. One that was scaled has
    "factor" and "shift".

    Args:
        files: The frame's ground truth, and its sparse depth, image and camera where there are any.
        result: The frame's prediction. None: there is none.
        request: The rules.
    """
    # The files, of which nothing but the path is known yet.
    paths = {
        "prediction": None if result is None else result.depth,
        "gt": files.gt,
        "sparse": files.sparse,
        "image": files.image,
    }
    inputs = {name: FileRecord(path=str(paths[name])) for name in FILES if paths[name] is not None}
    record = FrameRecord(name=files.name, group=files.group, inputs=inputs, status="failed")
    if result is None:
        return replace(record, message="there is no prediction")
    record = replace(record, unit=result.record.unit)
    try:
        scored = _score(files, result, request)
    except PnpDepthError as error:
        return replace(record, message=str(error))
    for name, reading in scored.readings.items():
        inputs[name] = replace(
            inputs[name], read_as=reading.source, scale=reading.scale, assumed=reading.assumed
        )
    return replace(record, status="done", notes=scored.notes, errors={GT: {AFTER: scored.scores}})


def _score(files: FrameFiles, result: ResultFrame, request: EvalRequest) -> _Scored:
    """The scores of a result, how prediction and ground truth were read, and notes.

    Raises:
        PnpDepthError: A file cannot be read, or nothing can be scored.
    """
    rules = request.rules
    # The ground truth that is scored.
    gt = _read_truth(files, result, request)
    notes = [*gt.notes]
    try:
        given = _pixels_with_points(files, result, gt.values)
    # Where these pixels are scored, too, they are only counted, and no count is no error.
    except PnpDepthError:
        if rules.exclude_sparse:
            raise
        given = None
    truth = np.where(_where_scored(gt.values, given, rules), gt.values, np.float32(0))
    if not truth.any():
        raise InputError(
            f"{files.gt} has no known depth where protocol {request.protocol} scores; choose"
            " another --protocol"
        )
    # The prediction, as the protocol changes it.
    prediction = _read_prediction(result.depth, truth.shape, request)
    notes += prediction.notes
    depth, fit = scale_prediction(prediction.values, truth, request.scale_by)
    if rules.clip:
        depth = np.clip(depth, rules.min_depth, rules.max_depth).astype(np.float32)
    both = (truth > 0) & (depth > 0)
    if not both.any() and not request.is_devkit:  # the development kit fills in what is missing
        raise InputError(
            f"{result.depth} holds no valid depth where the truth is known; is it of this frame?"
        )
    # The measures, also of a standard deviation; a fit would change its unit.
    scores = _measure(depth, truth, request)
    if result.sigma is not None and fit is None:
        sigma = result.read_beside(result.sigma, depth)
        scores |= {m.key: m.formula(depth, truth, sigma) for m in OF_SIGMA if m.formula}
    scores |= _counts_and_agreement(prediction.values, depth, truth, given)
    scores["factor"] = None
    scores["shift"] = None
    if fit is not None:
        factor, shift = fit
        scores["factor"] = factor
        scores["shift"] = shift + factor * prediction.added  # of the numbers in the file
    return _Scored(scores, {"prediction": prediction.reading, "gt": gt.reading}, notes)


def _counts_and_agreement(
    prediction: Depth, depth: Depth, truth: Depth, given: Mask | None
) -> Scores:
    """The numbers of pixels, and how prediction and truth agree; see `score_frame`.

    Args:
        prediction: (H, W) as it was read, 0 where unknown.
        depth: (H, W) the prediction as the protocol changes it.
        truth: (H, W) the ground truth that is scored, 0 elsewhere.
        given: (H, W) where the sparse depth was. None: that is not known.
    """
    both = (truth > 0) & (depth > 0)
    known = int((truth > 0).sum())
    predicted = int(((prediction > 0) & (truth > 0)).sum())
    agreement = compare_depths(np.where(both, depth, 0), truth)
    return {
        "pixels": int(both.sum()),
        "known": known,
        "predicted": predicted,
        "coverage": predicted / known,
        "given": None if given is None else int((given & both).sum()),
        "median_ratio": agreement.ratio if both.any() else None,
        "ratio_spread": agreement.spread if both.any() else None,
        "rank_correlation": compare_depths(prediction, truth).rank,
    }


def scores_of(record: FrameRecord) -> Scores:
    """Returns the scores of a record of `score_frame`; empty if the frame has none."""
    return record.errors.get(GT, {}).get(AFTER, {})


def _measure(depth: Depth, truth: Depth, request: EvalRequest) -> Scores:
    """The request's measures, by key, of depth (H, W) against the scored ground truth (H, W)."""
    if request.is_devkit:
        return {**devkit_errors(depth, truth)}
    of_pixels = score(torch.from_numpy(depth), torch.from_numpy(truth), request.measures)
    of_images = {m.key: m.formula(depth, truth) for m in request.measures if m.formula}
    return {**of_pixels, **of_images}


def _read_truth(frame: FrameFiles, result: ResultFrame, request: EvalRequest) -> _Read:
    """The ground truth (H, W) in metres, in the part of the frame that is used.

    Args:
        frame: The files of the frame, and how a data set says that they are read.
        result: The frame's prediction, whose record may hold the camera.
        request: What the user says of the ground truth, over what the data set says.

    Raises:
        InputError: There is no ground truth, it is implausible, or its camera is not known.
    """
    if frame.gt is None:
        raise InputError(f"frame {frame.name} has no ground truth to score against; add it")
    # Its numbers, which a user, a data set or the file say are depth or its inverse.
    scale = frame.gt_scale if request.gt_scale is None else request.gt_scale
    file = raw_depth(frame.gt, frame.image) or _read_depth(frame.gt, scale, request)
    kind = request.gt_kind or frame.kind_of_gt
    factor = inverse_factor("--gt-kind", kind)
    if factor is not None:
        file = depth_of_inverse(file, factor, scale)
        scale = None
    # Depth in metres, as all numbers of sensors pass one gate; then the part that is used.
    reading = file.reading
    masked = apply_masks(file.values, frame.masks)
    is_scale_of_layout = request.gt_scale is None and not frame.scales_stated
    values, notes = plausible_map(
        masked,
        reading,
        "gt",
        "--gt-scale",
        scale,
        of_integers=OF_DATA_SET if is_scale_of_layout else "",
    )
    gt = np.ascontiguousarray(frame.part.apply(values))
    if request.gt_range:
        gt = _depth_of_distances(gt, frame, result, (values.shape[0], values.shape[1]))
        reading = reading._replace(source=f"{reading.source}, distances")
    return _Read(gt, reading, notes)


def _depth_of_distances(
    distances: Depth, files: FrameFiles, result: ResultFrame, whole: tuple[int, int]
) -> Depth:
    """Depth z of distances from the camera: that of the data set, else of the prediction's record.

    Args:
        distances: (H, W) metres in the part of the frame that is used, 0 where unknown.
        files: The files of the frame, with its calibration if there is one.
        result: The frame's prediction.
        whole: (H, W) of the whole frame, to which a calibration belongs.

    Raises:
        InputError: Neither has a camera.
    """
    size = (distances.shape[0], distances.shape[1])
    camera = None
    if files.calib is not None:
        camera_of_whole, _ = camera_of_file(files.calib, files.camera, whole, files.image_file)
        camera = files.part.camera_in_crop(camera_of_whole, whole)
    elif result.size == size:
        camera, _ = result.camera_and_pose
    if camera is None:
        raise InputError(
            f"--gt-range needs a camera, but frame {files.name} has none in the data set or the"
            " record beside the prediction; add the column calib to a list"
        )
    # A pixel's point is z · (x, y, 1) for its ray (x, y), so its distance is z · √(x² + y² + 1).
    rays = rays_of_image(camera, size)
    return known_metres(distances / np.sqrt(1 + (rays**2).sum(axis=2)))


def _where_scored(gt: Depth, given: Mask | None, rules: Protocol) -> Mask:
    """(H, W) true where the protocol scores: inside its crop and bounds, without input points.

    Args:
        gt: (H, W) ground truth in metres.
        given: (H, W) where the sparse depth was. None: that is not known, nor needed.
        rules: The protocol.
    """
    highest = np.inf if rules.max_depth is None else rules.max_depth
    inside = np.zeros(gt.shape, bool)
    inside[crop_window(rules.crop, gt.shape)] = True
    scored = inside & (gt > rules.min_depth) & (gt < highest)
    if rules.exclude_sparse and given is not None:
        scored &= ~given
    return scored


def _read_prediction(path: Path, size: Size, request: EvalRequest) -> _Read:
    """The prediction at the ground truth's size, 0 where unknown.

    Args:
        path: The depth file.
        size: (H, W) of the ground truth.
        request: What the user says of predictions: their scale, and whether they are resized.

    Raises:
        InputError: It has another size, and is not to be resized.
    """
    file = _read_depth(path, request.pred_scale, request)
    values = file.values
    notes = list[str]()
    # Of a prediction that is known up to scale and shift, numbers below 0 are values. They are made
    # positive, as 0 stands for unknown.
    added = 0.0
    stored = load_stored(path).values
    if request.scale_by.startswith("affine") and stored.shape == values.shape:
        is_number = np.isfinite(stored)
        least = float(stored[is_number].min(initial=0))
        if least < 0:
            added = 1 - least
            values = np.where(is_number, stored + added, 0).astype(np.float32)
            notes.append(f"{path}: numbers of 0 and below are values, as --scale-by fits a shift")
    # Integers are divided by the scale already; floats, whose file has none, are divided here.
    if file.reading.scale is None and request.pred_scale is not None:
        values = values / np.float32(request.pred_scale)
        source = f"{file.reading.source} ÷ {request.pred_scale:g}"
        file = replace(file, reading=file.reading._replace(source=source))
    # The ground truth's size.
    if values.shape != size and not request.resize:
        raise unequal_sizes(
            f"prediction {path}",
            values.shape,
            "the ground truth",
            size,
            "; --resize scales predictions if both show the same view",
        )
    if values.shape != size:
        # Of known pixels alone: their interpolated sum over their interpolated weight.
        is_known = (values > 0).astype(np.float32)
        total, weight = (cv2.resize(image, (size[1], size[0])) for image in (values, is_known))
        values = np.where(weight > _MOST, total / np.maximum(weight, _MOST), np.float32(0))
    return _Read(values, file.reading, notes, added)


def _read(path: Path, scale: float | None, request: EvalRequest) -> DepthFile:
    """The depth image; codes are metres × the scale, else the file's own, else the protocol's."""
    stored = load_stored(path)
    assumed = scale is None and stored.reading.scale is None and stored.values.dtype.kind != "f"
    image = depth_from_stored(path, stored, request.rules.scale if assumed else scale)
    if request.is_devkit and image.reading.scale is not None and stored.values.ndim == 2:
        # the development kit reads every code but 0 as a depth, the largest too
        image = replace(image, values=known_metres(stored.values / image.reading.scale))
    return replace(image, reading=image.reading._replace(assumed=assumed))


def _given_points(frame: FrameFiles, result: ResultFrame, gt: Depth) -> Mask:
    """(H, W) true at the network's sparse points. Raises PnpDepthError if they are not known."""
    size = (gt.shape[0], gt.shape[1])
    sparse = result.record.inputs.get("sparse")
    drawn = None if sparse is None else sparse.sampled
    # Points that were drawn from the ground truth are drawn again.
    if drawn is not None and result.size == size:
        image = None
        if drawn.kind == "features" and frame.image is not None:
            image = frame.part.apply(read_image(frame.image))
        xy = sample_points(gt, drawn, drawn.seed or 0, image=image).xy
    elif frame.sparse is not None:
        points, _ = read_sparse(frame.sparse, size=size, scale=frame.sparse_scale)
        if (own := points.size) != size:
            points = frame.part.points_in_crop(points)
            if points.size != size:
                raise unequal_sizes(f"sparse depth {frame.sparse}", own, "the ground truth", size)
        xy = points.xy
    else:
        raise InputError(
            f"frame {frame.name} has no sparse depth file to exclude in the data set or the record"
            " beside the prediction; add it, or score without excluding it"
        )
    given = np.zeros(size, bool)
    given.flat[pixel_index(xy[in_frame(xy, size)], size)] = True
    return given


def _read_depth(path: Path, scale: float | None, request: EvalRequest) -> DepthFile:
    """The depth (H, W) in a file, 0 where unknown.

    Args:
        path: The depth file.
        scale: Codes per metre of integers that the user or the data set states. None: the file's
            own, else the protocol's.
        request: The rules.
    """
    stored = load_stored(path)
    is_integer = stored.values.dtype.kind != "f"
    is_assumed = scale is None and stored.reading.scale is None and is_integer
    image = depth_from_stored(path, stored, request.rules.scale if is_assumed else scale)
    if request.is_devkit and image.reading.scale is not None and stored.values.ndim == 2:
        # the development kit reads every code but 0 as a depth, the largest too
        image = replace(image, values=known_metres(stored.values / image.reading.scale))
    return replace(image, reading=image.reading._replace(assumed=is_assumed))


def _pixels_with_points(frame: FrameFiles, result: ResultFrame, gt: Depth) -> Mask:
    """(H, W) true at the pixels of the sparse depth that the network was given.

    Args:
        frame: The files of the frame, with its sparse depth if that is a file.
        result: The prediction, whose record says if the points were drawn from the ground truth.
        gt: (H, W) the ground truth.

    Raises:
        PnpDepthError: These points are not known, or are of another size.
    """
    size = (gt.shape[0], gt.shape[1])
    sparse = result.record.inputs.get("sparse")
    pattern = None if sparse is None else sparse.sampled
    # Points that were drawn from the ground truth are drawn again.
    if pattern is not None and result.size == size:
        image = None
        if pattern.kind == "features" and frame.image is not None:
            image = frame.part.apply(read_image(frame.image))
        xy = sample_points(gt, pattern, pattern.seed or 0, image=image).xy
    elif frame.sparse is not None:
        points, _ = read_sparse(frame.sparse, size=size, scale=frame.sparse_scale)
        size_of_file = points.size
        if size_of_file != size:
            points = frame.part.points_in_crop(points)
        if points.size != size:
            raise unequal_sizes(
                f"sparse depth {frame.sparse}", size_of_file, "the ground truth", size
            )
        xy = points.xy
    else:
        raise InputError(
            f"frame {frame.name} has no sparse depth file to exclude in the data set or the record"
            " beside the prediction; add it, or score without excluding it"
        )
    mask = np.zeros(size, bool)
    mask.flat[pixel_index(xy[in_frame(xy, size)], size)] = True
    return mask


def crop_window(crop: str, size: Size) -> tuple[slice, slice]:
    """Returns the rows and columns of a frame of `size` (H, W) pixels that lie in a crop.

    Args:
        crop: Name of the crop, as `Protocol.crop` has it.
        size: (H, W) of the frame.

    Raises:
        InputError: If the crop does not fit the frame.
    """
    height, width = size
    if crop == "nyu" and size != (480, 640):
        raise InputError(
            f"crop nyu is for frames of 640×480 but this one is {width}×{height}; --protocol paper"
            " scores any size"
        )
    top, bottom, left, right = _CROPS[crop]
    # Frames that were cut to KITTI's usual part have the crop of the whole frame they are from:
    # the bottom rows and the middle columns of it.
    rows_above = columns_before = 0
    if size == _CUT and crop in ("garg", "eigen"):
        height, width = _WHOLE
        rows_above = height - size[0]
        columns_before = (width - size[1]) // 2
    rows = [int(end * height) - rows_above for end in (top, bottom)]
    columns = [int(end * width) - columns_before for end in (left, right)]
    return slice(*np.clip(rows, 0, size[0])), slice(*np.clip(columns, 0, size[1]))


def scale_prediction(values: Depth, gt: Depth, scale_by: str) -> tuple[Depth, Fit | None]:
    """Returns the prediction in metres, fitted to the ground truth of its image, and the fit.

    The fits are

    - median: ratio of the medians (Zhou et al. 2017, monodepth2),
    - affine: least squares in depth (Ke et al. 2024, Marigold),
    - affine-disparity: least squares in 1/m of predicted disparity (Ranftl et al. 2020, MiDaS).

    A fitted value that is not above 0 becomes unknown (0). With scale_by "none", the prediction is
    returned as it is, and None.

    Args:
        values: (H, W) predicted depth, of affine-disparity disparity, 0 where unknown.
        gt: (H, W) ground truth in metres, 0 where it is not scored.
        scale_by: One of choices.SCALINGS.

    Raises:
        InputError: If fewer than two pixels have both, or the prediction is constant.
    """
    if scale_by == "none":
        return values, None
    # The fit, at the pixels with both.
    both = (gt > 0) & (values > 0)
    in_disparity = scale_by == "affine-disparity"
    if np.count_nonzero(both) < 2:
        raise InputError(f"--scale-by {scale_by} needs 2 pixels with ground truth and prediction")
    predicted = values[both].astype(np.float64)
    truth = gt[both].astype(np.float64)
    if scale_by == "median":
        factor = float(np.median(truth) / np.median(predicted))
        shift = 0.0
    elif predicted.min() == predicted.max():
        raise InputError("the prediction is constant, so that no scale and shift can be fitted")
    else:
        target = 1 / truth if in_disparity else truth
        factor, shift = np.polyfit(predicted, target, 1).tolist()
    # The fitted prediction, as depth.
    fitted = values * np.float64(factor) + shift
    fitted = np.where((values > 0) & (fitted > 0), fitted, 0)
    if in_disparity:
        fitted = np.divide(1, fitted, out=np.zeros_like(fitted), where=fitted > 0)
    return fitted.astype(np.float32), (factor, shift)
