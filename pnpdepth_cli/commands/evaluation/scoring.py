"""Scores one frame: masks what the protocol does not score, scales predictions, and measures.

Predictions of relative networks are scaled to the ground truth of each image (`scale_prediction`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from pnpdepth_cli.commands.evaluation.depth_to_score import (
    Depth,
    Mask,
    Size,
    pixels_with_points,
    read_prediction,
    read_truth,
)
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_errors
from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.commands.shared.results import ResultFrame
from pnpdepth_cli.completion.two_depths import compare_depths
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import InputError, PnpDepthError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.measures import AFTER, GT, OF_SIGMA, score
from pnpdepth_cli.protocols import Protocol

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
_KITTI_CUT_SIZE = (352, 1216)
"""(H, W) of KITTI's frames cut at the bottom, in the middle, as its depth benchmark has them."""
_KITTI_SIZE = (375, 1242)
"""(H, W) of most of KITTI's frames before the cut."""


class _Scored(NamedTuple):
    """The scores of a frame, and how its files were read."""

    scores: Scores
    readings: dict[str, Reading]
    """Format and scale of the prediction and of the ground truth, by the names of `FILES`."""
    notes: list[str]
    """Lines for a person."""


def score_frame(files: FrameFiles, result: ResultFrame | None, request: EvalRequest) -> FrameRecord:
    """Returns the record of a scored frame, with its scores, or why it has none.

    Beside the measures, the scores have numbers of pixels:
    - "known" have ground truth that the protocol scores,
    - "predicted" have a prediction in the file as well,
    - "pixels" are scored, as they have a depth after the prediction was scaled and clipped,
    - "given" are scored pixels at which the network was given a point.

    "coverage" is predicted over known. "median_ratio" is that of prediction over ground truth,
    "ratio_spread" half of the range of the middle 68 % of its log. "rank_correlation" is
    Spearman's, of the prediction as it is stored. "factor" and "shift" are those by which the
    prediction was scaled.

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
    # How the files were read, and the errors against ground truth: of the depth after refinement,
    # for `compare`, which reads records of batches alike.
    inputs_as_read = {
        name: replace(
            inputs[name], read_as=reading.source, scale=reading.scale, assumed=reading.assumed
        )
        for name, reading in scored.readings.items()
    }
    return replace(
        record,
        inputs=inputs | inputs_as_read,
        status="done",
        notes=scored.notes,
        errors={GT: {AFTER: scored.scores}},
    )


def _score(files: FrameFiles, result: ResultFrame, request: EvalRequest) -> _Scored:
    """The scores of a result, how prediction and ground truth were read, and notes.

    Args:
        files: The frame's ground truth, and its sparse depth, image and camera if there are any.
        result: The frame's prediction.
        request: The rules.

    Raises:
        PnpDepthError: A file cannot be read, or nothing can be scored.
    """
    rules = request.rules
    # The ground truth that is scored.
    gt = read_truth(files, result, request)
    notes = [*gt.notes]
    try:
        has_point = pixels_with_points(files, result, gt.values)
    # Unless these pixels are excluded, they are only counted, and may be unknown.
    except PnpDepthError:
        if rules.exclude_sparse:
            raise
        has_point = None
    truth = np.where(_where_scored(gt.values, has_point, rules), gt.values, np.float32(0))
    if not truth.any():
        raise InputError(
            f"{files.gt} has no known depth where protocol {request.protocol} scores; choose"
            " another --protocol"
        )
    # The prediction, as the protocol changes it.
    prediction = read_prediction(result.depth, truth.shape, request)
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
        scores |= {
            measure.key: measure.formula(depth, truth, sigma)
            for measure in OF_SIGMA
            if measure.formula is not None
        }
    scores |= _counts_and_agreement(prediction.values, depth, truth, has_point)
    scores["factor"] = None
    scores["shift"] = None
    if fit is not None:
        factor, shift = fit
        scores["factor"] = factor
        # Depth is factor · (number in the file + added) + shift; the score leaves `added` to shift.
        scores["shift"] = shift + factor * prediction.added
    return _Scored(scores, {"prediction": prediction.reading, "gt": gt.reading}, notes)


def _counts_and_agreement(
    prediction: Depth, depth: Depth, truth: Depth, has_point: Mask | None
) -> Scores:
    """The numbers of pixels, and how prediction and truth agree; see `score_frame`.

    Args:
        prediction: (H, W) as it was read, 0 where unknown.
        depth: (H, W) the prediction as the protocol changes it.
        truth: (H, W) the ground truth that is scored, 0 elsewhere.
        has_point: (H, W) where the sparse depth was. None: that is not known.
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
        "given": None if has_point is None else int((has_point & both).sum()),
        "median_ratio": agreement.ratio if both.any() else None,
        "ratio_spread": agreement.spread if both.any() else None,
        "rank_correlation": compare_depths(prediction, truth).rank,
    }


def scores_of(record: FrameRecord) -> Scores:
    """Returns the scores of a record of `score_frame`; empty if the frame has none."""
    return record.errors.get(GT, {}).get(AFTER, {})


def _measure(depth: Depth, truth: Depth, request: EvalRequest) -> Scores:
    """The request's measures of depth against ground truth, by key.

    Args:
        depth: (H, W) metres, 0 where unknown.
        truth: (H, W) metres, 0 where it is not scored.
        request: The rules, which say what is measured.
    """
    if request.is_devkit:
        return {**devkit_errors(depth, truth)}
    # A measure has a formula of the scored pixels, or one of both images.
    scores = score(torch.from_numpy(depth), torch.from_numpy(truth), request.measures)
    scores_of_images = {
        measure.key: measure.formula(depth, truth)
        for measure in request.measures
        if measure.formula is not None
    }
    return {**scores, **scores_of_images}


def _where_scored(gt: Depth, has_point: Mask | None, rules: Protocol) -> Mask:
    """(H, W) true where the protocol scores: inside its crop and bounds, without input points.

    Args:
        gt: (H, W) ground truth in metres.
        has_point: (H, W) where the sparse depth was. None: that is not known, nor needed.
        rules: The protocol.
    """
    highest = np.inf if rules.max_depth is None else rules.max_depth
    inside = np.zeros(gt.shape, bool)
    inside[crop_window(rules.crop, gt.shape)] = True
    scored = inside & (gt > rules.min_depth) & (gt < highest)
    if rules.exclude_sparse and has_point is not None:
        scored &= ~has_point
    return scored


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
    if size == _KITTI_CUT_SIZE and crop in ("garg", "eigen"):
        height, width = _KITTI_SIZE
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
