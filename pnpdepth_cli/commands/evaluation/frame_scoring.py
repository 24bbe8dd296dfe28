"""Scores one frame: its measures, sums over pixels that can be added up, and facts for warnings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from pnpdepth_cli.commands.evaluation.frame_reading import (
    DepthKind,
    LoadedFrame,
    Scales,
    load_frame,
)
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_errors, fill_background
from pnpdepth_cli.commands.evaluation.measures import Depth
from pnpdepth_cli.commands.evaluation.pairing import FramePair
from pnpdepth_cli.commands.evaluation.protocols import EvalProtocol
from pnpdepth_cli.commands.evaluation.scaling import Fit
from pnpdepth_cli.commands.evaluation.uncertainty import FrameUncertainty, frame_uncertainty
from pnpdepth_cli.core.metrics import MEASURES, error_sums, measures_of
from pnpdepth_cli.errors import InputError


@dataclass(frozen=True, kw_only=True)
class FrameScores:
    """The scores of one frame, or why it has none."""

    pair: FramePair
    values: dict[str, float] = field(default_factory=dict)
    """Each measure by its key; empty where the frame was not scored."""
    error: str | None = None
    """Why the frame was not scored; None if it was."""
    pixels: int = 0
    """Scored pixels."""
    known: int = 0
    """Pixels with ground truth that the protocol scores."""
    predicted: int = 0
    """Pixels of these with a prediction in the file; the others are empty."""
    fit: Fit | None = None
    """How the prediction was scaled to the ground truth, if it was."""
    ratio: float = math.nan
    """Median of prediction / ground truth."""
    sparse_ratio: float = math.nan
    """Median of sparse depth / ground truth, if the user named sparse depth."""
    leaked: int | None = None
    """Scored pixels whose ground truth is a value of the sparse input; None if that is unknown."""
    sums: tuple[float, ...] = ()
    """Over the pixels, in the order of core.metrics.SUMS."""
    kinds: dict[str, DepthKind] = field(default_factory=dict)
    """Of the files by "prediction", "gt" and "sparse"."""
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


def score_pair(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> FrameScores:
    """Returns the scores of a frame's files; a missing or empty prediction has a row without any.

    Raises:
        InputError: For a file that cannot be read, or no ground truth where the protocol scores.
        SizeError: Where sizes differ.
    """
    frame = load_frame(pair, protocol, scales)
    depth, gt, both = frame.depth, frame.gt, frame.both
    known, pixels = int(np.count_nonzero(gt)), int(both.sum())
    if not known:
        raise InputError(
            f"{pair.frame.gt} has no known depth where protocol {protocol.name} scores"
        )
    row = FrameScores(pair=pair, known=known, kinds=frame.kinds)
    if frame.predicted is None:
        return replace(row, error="there is no prediction")
    sums = error_sums(torch.from_numpy(depth), torch.from_numpy(gt), protocol.thresholds)[0]
    row = replace(
        row,
        pixels=pixels,
        predicted=int(np.count_nonzero(frame.predicted & (gt > 0))),
        fit=frame.fit,
        sums=tuple(sums.tolist()),
    )
    if protocol.is_devkit:
        values = devkit_errors(depth, gt)
    elif not (depth > 0).any():
        return replace(row, error=f"{pair.prediction} holds no valid depth")
    elif not pixels:
        return replace(row, error=f"{pair.prediction} has no depth where the ground truth is known")
    else:
        keys = (measure.key for measure in MEASURES)
        values = dict(zip(keys, measures_of(sums).tolist(), strict=True))
        values |= _additional(frame, pair, protocol, scales)
    leaked = min(pair.sampled, pixels) or None
    row = replace(row, values=values, ratio=_median_ratio(depth, gt))
    if frame.sigma is not None:
        row = replace(row, uncertainty=frame_uncertainty(depth, gt, frame.sigma))
    if frame.sparse is not None:
        given = both & (frame.sparse > 0)
        equal = np.abs(frame.sparse - gt) <= frame.tolerance + 1e-6 * gt
        leaked = int(np.count_nonzero(given & equal))
        if pair.sparse_named:
            row = replace(row, sparse_ratio=_median_ratio(frame.sparse, gt))
    return replace(row, leaked=leaked)


def _median_ratio(depth: Depth, gt: Depth) -> float:
    both = (depth > 0) & (gt > 0)
    return float(np.median(depth[both] / gt[both])) if both.any() else math.nan


def _additional(
    frame: LoadedFrame, pair: FramePair, protocol: EvalProtocol, scales: Scales
) -> dict[str, float]:
    """The measures of the protocol's additional groups."""
    values: dict[str, float] = {}
    for name, group in zip(protocol.groups, protocol.measure_groups, strict=True):
        if group.needs == "intrinsics" and frame.intrinsics is None:
            raise InputError(
                f"--measures {name} needs the intrinsics of frame {pair.name}; give --calib"
            )
        if group.needs == "sparse" and frame.sparse is None:
            raise InputError(
                f"--measures {name} needs the sparse depth of frame {pair.name}; give --sparse"
            )
        previous = None
        if group.in_sequences and pair.previous is not None and pair.previous.prediction:
            previous = load_frame(pair.previous, protocol, scales)
        found = group.values(replace(frame, previous=previous))
        values |= zip((measure.key for measure in group.measures), found, strict=True)
    return values


def filled(depth: Depth) -> Depth:
    """Returns the depth with what the development kit fills in, without its −1."""
    return np.maximum(fill_background(depth), np.float32(0))
