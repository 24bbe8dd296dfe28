"""Scores one frame: its measures, and facts for warnings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from pnpdepth_cli.commands.evaluation.frames import Depth, Fit, load_frame
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_errors, fill_background
from pnpdepth_cli.commands.evaluation.pairing import FramePair
from pnpdepth_cli.commands.evaluation.request import EvalRequest
from pnpdepth_cli.core.metrics import error_sums, measures_of
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.measures import OF_SIGMA, Formula


@dataclass(frozen=True, kw_only=True)
class FrameScores:
    """The scores of one frame, or why it has none."""

    pair: FramePair
    values: dict[str, float] = field(default_factory=dict)
    """Each measure by its key; empty where the frame was not scored."""
    error: str | None = None
    pixels: int = 0
    known: int = 0
    """Pixels with ground truth that the protocol scores."""
    predicted: int = 0
    """Pixels of these with a prediction in the file; the others are empty."""
    fit: Fit | None = None
    ratio: float = math.nan
    """Median of prediction / ground truth."""
    given: int | None = None
    """Scored pixels at which the network was given a sparse point; None if that is unknown."""
    readings: dict[str, Reading] = field(default_factory=dict)
    """How the files "prediction" and "gt" were read."""
    notes: tuple[str, ...] = ()
    """What a person should know of the ground truth."""

    @property
    def name(self) -> str:
        """The frame's name, by which runs are compared."""
        return self.pair.name

    @property
    def scored(self) -> bool:
        """True if the frame is in the means."""
        return self.error is None

    @property
    def missing(self) -> bool:
        """True if there is no prediction."""
        return self.pair.prediction is None

    @property
    def coverage(self) -> float:
        """Fraction of the pixels with ground truth that has a prediction."""
        return self.predicted / self.known if self.known else math.nan


def score_pair(pair: FramePair, request: EvalRequest) -> FrameScores:
    """Returns the scores of a frame's files; a missing or empty prediction has a row without any.

    Raises:
        InputError: For a file that cannot be read, or no ground truth where the protocol scores.
        SizeError: Where sizes differ.
    """
    frame = load_frame(pair, request)
    depth, gt = frame.depth, frame.gt
    known, both = gt > 0, (gt > 0) & (depth > 0)
    if not known.any():
        raise InputError(
            f"{pair.frame.gt} has no known depth where protocol {request.protocol} scores"
        )
    readings = frame.readings
    row = FrameScores(pair=pair, known=int(known.sum()), readings=readings, notes=frame.notes)
    if frame.predicted is None:
        return replace(row, error="there is no prediction")
    row = replace(
        row,
        pixels=int(both.sum()),
        predicted=int((frame.predicted & known).sum()),
        fit=frame.fit,
        ratio=float(np.median(depth[both] / gt[both])) if both.any() else math.nan,
        given=None if frame.given is None else int((frame.given & both).sum()),
    )
    of_sigma = {}
    if frame.sigma is not None:
        of_sigma = {m.key: m.value(depth, gt, frame.sigma) for m in OF_SIGMA}
    if request.is_devkit:
        return replace(row, values=devkit_errors(depth, gt) | of_sigma)
    if not row.pixels:
        where = " where the ground truth is known" if (depth > 0).any() else ""
        return replace(row, error=f"{pair.prediction} holds no valid depth{where}")
    # measures of sums over pixels, then those of whole images
    summed = [m for m in request.measures if isinstance(m.formula, Formula)]
    depths = torch.from_numpy(depth), torch.from_numpy(gt)
    sums = error_sums(*depths, request.rules.thresholds, summed)
    of_pixels = zip(summed, measures_of(sums, summed).tolist(), strict=True)
    values = {measure.key: value for measure, value in of_pixels}
    values |= {m.key: m.value(depth, gt) for m in request.measures if m.key not in values}
    return replace(row, values=values | of_sigma)


def filled(depth: Depth) -> Depth:
    """Returns the depth with what the development kit fills in, without its −1."""
    return np.maximum(fill_background(depth), np.float32(0))
