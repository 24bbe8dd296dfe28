"""Scores one frame: measures, sums over pixels that can be added up, and facts for warnings.

Whether a predicted standard deviation is right is measured by calibration, the fraction of errors
within k standard deviations against that of a normal distribution; and by sparsification, the mean
absolute error of the pixels that remain when the most uncertain ones are removed, against removing
those with the largest error (Ilg et al., ECCV 2018).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.frames import Depth, Fit, load_frame
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_errors, fill_background
from pnpdepth_cli.commands.evaluation.pairing import FramePair
from pnpdepth_cli.commands.evaluation.request import EvalRequest
from pnpdepth_cli.core.metrics import error_sums, measures_of
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.measures import Formula

Floats = NDArray[np.float64]

REMOVED = tuple(n / 20 for n in range(20))
"""Fractions of the pixels."""


class FrameUncertainty(NamedTuple):
    """What one frame contributes, over pixels with prediction, ground truth and deviation."""

    pixels: int
    within: tuple[int, int]
    """How many errors are at most one and two standard deviations."""
    sparsification: Floats
    """(REMOVED,) mean absolute error, metres, without the most uncertain pixels."""
    oracle: Floats
    """(REMOVED,) the same without the pixels of largest error."""


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
    uncertainty: FrameUncertainty | None = field(default=None, compare=False)

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
        uncertainty=None if frame.sigma is None else frame_uncertainty(depth, gt, frame.sigma),
    )
    if request.is_devkit:
        return replace(row, values=devkit_errors(depth, gt))
    if not row.pixels:
        where = " where the ground truth is known" if (depth > 0).any() else ""
        return replace(row, error=f"{pair.prediction} holds no valid depth{where}")
    # measures of sums over pixels, then those of whole images
    summed = [m for m in request.measures if isinstance(m.formula, Formula)]
    both_depths = torch.from_numpy(depth), torch.from_numpy(gt)
    of_pixels = measures_of(
        error_sums(*both_depths, request.rules.thresholds, summed), summed
    ).tolist()
    values = {m.key: value for m, value in zip(summed, of_pixels, strict=True)}
    values |= {m.key: m.value(depth, gt) for m in request.measures if m.key not in values}
    return replace(row, values=values)


def filled(depth: Depth) -> Depth:
    """Returns the depth with what the development kit fills in, without its −1."""
    return np.maximum(fill_background(depth), np.float32(0))


def frame_uncertainty(depth: Depth, gt: Depth, sigma: Depth) -> FrameUncertainty | None:
    """Returns what a frame contributes; None if no pixel has all three.

    Args:
        depth: (H, W) predictions in metres, 0 where unknown.
        gt: (H, W) ground truth in metres, 0 where not scored.
        sigma: (H, W) standard deviations in metres, 0 where unknown.
    """
    known = (gt > 0) & (depth > 0) & (sigma > 0)
    if not known.any():
        return None
    error = np.abs(depth[known].astype(np.float64) - gt[known])
    deviation = sigma[known].astype(np.float64)
    kept = np.maximum(1, np.round((1 - np.array(REMOVED)) * len(error))).astype(int)

    def curve(order: NDArray[np.intp]) -> Floats:
        return np.asarray(np.cumsum(error[order])[kept - 1] / kept)

    return FrameUncertainty(
        pixels=len(error),
        within=(int((error <= deviation).sum()), int((error <= 2 * deviation).sum())),
        sparsification=curve(np.argsort(deviation, kind="stable")),
        oracle=curve(np.argsort(error)),
    )


def summarise_uncertainty(frames: Sequence[FrameUncertainty]) -> dict[str, Any] | None:
    """Returns the calibration and sparsification of all frames; None without any.

    Calibration is over the pixels of all frames: the fractions of errors within one and two
    standard deviations. `ause` is the area between the curves of sparsification and of the oracle,
    which are means over frames, in units of the error of all pixels; 0 is best.
    """
    from scipy.integrate import trapezoid

    if not frames:
        return None
    pixels, within, by_sigma, by_error = zip(*frames, strict=True)
    one, two = (np.sum(within, axis=0) / sum(pixels)).tolist()
    sparsification, oracle = np.mean(by_sigma, axis=0), np.mean(by_error, axis=0)
    area, whole = float(trapezoid(sparsification - oracle, REMOVED)), float(sparsification[0])
    return {
        "frames": len(frames),
        "pixels": sum(pixels),
        "within_1_sigma": one,
        "within_2_sigma": two,
        "ause": area / whole if whole else 0.0,
    }
