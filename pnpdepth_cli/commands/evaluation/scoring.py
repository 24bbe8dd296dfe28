"""Scores one frame: its measures, and facts for warnings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_errors
from pnpdepth_cli.commands.evaluation.load_depths import LoadedFrame, load_frame
from pnpdepth_cli.commands.evaluation.pairing import FramePair
from pnpdepth_cli.core.metrics import error_sums, measures_of
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.measures import OF_SIGMA, Formula
from pnpdepth_cli.points import METRES
from pnpdepth_cli.stages import AFTER, GT

FILES = ("prediction", "gt", "sparse", "image")
"""The files of a frame in its record; the first two are compared."""


def score_pair(pair: FramePair, request: EvalRequest) -> FrameRecord:
    """Returns the scores of a frame's files, or why it has none.

    Beside the measures, the scores have numbers of pixels: "pixels" are scored, "known" have ground
    truth, "predicted" have a prediction in the file as well, and "given" are scored pixels at which
    the network was given a point. "coverage" is predicted over known. "median_ratio" is that of
    prediction over ground truth. A prediction that was scaled has "factor" and "shift".
    """
    files, result = pair
    paths = (result and result.depth, files.gt, files.sparse, files.image)
    inputs = {
        name: FileRecord(path=str(path))
        for name, path in zip(FILES, paths, strict=True)
        if path is not None
    }
    record = FrameRecord(
        name=files.name,
        group=files.group,
        unit=METRES if result is None else result.unit,
        inputs=inputs,
    )
    try:
        frame = load_frame(pair, request)
    except PnpDepthError as error:
        return replace(record, status="failed", message=str(error))
    read = {
        name: replace(inputs[name], read_as=each.source, scale=each.scale, assumed=each.assumed)
        for name, each in frame.readings.items()
    }
    scores, fault = _score(frame, pair, request)
    return replace(
        record,
        inputs=inputs | read,
        notes=frame.notes,
        status="failed" if fault else "done",
        message=fault,
        errors={GT: {AFTER: scores}} if scores else {},
    )


def is_missing(record: FrameRecord) -> bool:
    """Returns whether the frame has no prediction."""
    return "prediction" not in record.inputs


def scores_of(record: FrameRecord) -> Scores:
    """Returns the scores of a frame, with the counts of its pixels; empty if it was not read."""
    return record.errors.get(GT, {}).get(AFTER, {})


def _score(frame: LoadedFrame, pair: FramePair, request: EvalRequest) -> tuple[Scores, str | None]:
    """The scores of a frame, and why they are counts alone or nothing."""
    depth, gt, files = frame.depth, frame.gt, pair.files
    known, both = gt > 0, (gt > 0) & (depth > 0)
    if not known.any():
        return {}, f"{files.gt} has no known depth where protocol {request.protocol} scores"
    # Counts of pixels.
    counts: Scores = {"pixels": 0, "known": int(known.sum()), "predicted": 0, "coverage": 0.0}
    if pair.result is None or frame.predicted is None:
        return counts, "there is no prediction"
    predicted = int((frame.predicted & known).sum())
    factor, shift = frame.fit or (None, None)
    counts |= {
        "pixels": int(both.sum()),
        "predicted": predicted,
        "coverage": predicted / int(known.sum()),
        "given": None if frame.given is None else int((frame.given & both).sum()),
        "median_ratio": float(np.median(depth[both] / gt[both])) if both.any() else None,
        "factor": factor,
        "shift": shift,
    }
    # Measures of sums over pixels, then those of whole images.
    of_sigma: Scores = {}
    if frame.sigma is not None:
        of_sigma = {m.key: m.value(depth, gt, frame.sigma) for m in OF_SIGMA}
    if request.is_devkit:
        return devkit_errors(depth, gt) | of_sigma | counts, None
    if not both.any():
        where = " where the ground truth is known" if (depth > 0).any() else ""
        return counts, f"{pair.result.depth} holds no valid depth{where}"
    summed = [m for m in request.measures if isinstance(m.formula, Formula)]
    depths = torch.from_numpy(depth), torch.from_numpy(gt)
    sums = error_sums(*depths, request.rules.thresholds, summed)
    of_pixels = zip(summed, measures_of(sums, summed).tolist(), strict=True)
    values: Scores = {measure.key: value for measure, value in of_pixels}
    values |= {m.key: m.value(depth, gt) for m in request.measures if m.key not in values}
    return values | of_sigma | counts, None
