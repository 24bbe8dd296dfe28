"""Scores one frame: its measures, sums over pixels that can be added up, and facts for warnings."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.core.metrics import MEASURES, SUMS, error_sums, measures_of
from pnpdepth_cli.errors import InputError, PnpDepthError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import DepthImage
from pnpdepth_cli.pipeline.evaluation.frame_reading import Depth, LoadedFrame, Scales, load_frame
from pnpdepth_cli.pipeline.evaluation.kitti_devkit import devkit_errors, fill_background
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame
from pnpdepth_cli.pipeline.evaluation.pairing import FramePair
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol
from pnpdepth_cli.pipeline.evaluation.scaling import Fit
from pnpdepth_cli.pipeline.evaluation.uncertainty import FrameUncertainty, frame_uncertainty

DISTANCE_EDGES_PX = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, math.inf)
DEPTH_EDGES_M = (0.0, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 40.0, 80.0, math.inf)
"""Bins hold their lower edge and not their upper one."""

Sums = NDArray[np.float64]
"""(bins, len(SUMS)) sums over pixels, in the order of core.metrics.SUMS."""


@dataclass(frozen=True, kw_only=True)
class FrameScores:
    """The scores of one frame, or why it has none."""

    pair: FramePair
    """The frame's files."""
    values: dict[str, float]
    """Each measure by its key; empty where the frame was not scored."""
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
    leaked: int = 0
    """Scored pixels whose ground truth is a value of the network's sparse input."""
    has_sparse: bool = False
    """True if the sparse input is known."""
    holes: int = 0
    """Pixels with ground truth that the development kit's fill leaves without depth."""
    sums: tuple[float, ...] = ()
    """Over the pixels, in the order of core.metrics.SUMS."""
    missing: bool = False
    """True if there is no prediction."""
    error: str | None = None
    """Why the frame was not scored; None if it was."""

    @property
    def name(self) -> str:
        """The frame's name, by which runs are compared."""
        return self.pair.name

    @property
    def scored(self) -> bool:
        """True if the frame is in the means."""
        return self.error is None

    @property
    def coverage(self) -> float:
        """Fraction of the pixels with ground truth that has a prediction."""
        return self.predicted / self.known if self.known else math.nan


@dataclass(frozen=True, kw_only=True)
class FileFacts:
    """What kind of depth file was read."""

    source: str
    """The kind in words, such as `16-bit PNG ÷ 256`."""
    scale: float | None
    """Codes per metre; None for floats."""
    assumed_scale: bool
    """True if neither the file nor the user nor the data set states the scale."""

    @property
    def scale_in_file(self) -> bool:
        """True if the file itself states its scale."""
        return "(from the file)" in self.source


@dataclass(frozen=True, kw_only=True)
class ScoredFrame:
    """All that one frame contributes to an evaluation."""

    row: FrameScores
    """Its scores."""
    ground_truth: FileFacts | None = None
    """What kind of file its ground truth is."""
    prediction: FileFacts | None = None
    """What kind of file its prediction is."""
    uncertainty: FrameUncertainty | None = None
    """Of the prediction's standard deviation; None without one."""
    by_distance: Sums | None = None
    """By distance to the nearest sparse point; None unless the user named sparse depth."""
    by_depth: Sums | None = None
    """By depth of the ground truth; None unless the user named sparse depth."""


def scored_or_error(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> ScoredFrame:
    """Returns the scores of a frame's files, or why it has none."""
    try:
        return score_pair(pair, protocol, scales)
    except PnpDepthError as error:
        return ScoredFrame(row=FrameScores(pair=pair, values={}, error=str(error)))


def score_pair(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> ScoredFrame:
    """Returns the scores of a frame's files; a missing or empty prediction has a row without any.

    Raises:
        InputError: For a file that cannot be read, or no ground truth where the protocol scores.
        SizeError: Where sizes differ.
    """
    loaded = load_frame(pair, protocol, scales)
    ground_truth = loaded.ground_truth
    known = int(np.count_nonzero(ground_truth.values))
    if not known:
        raise InputError(
            f"{pair.frame.gt} has no known depth where protocol {protocol.name} scores"
        )
    if loaded.prediction is None:
        row = FrameScores(
            pair=pair, values={}, known=known, missing=True, error="there is no prediction"
        )
        return ScoredFrame(row=row, ground_truth=_facts(ground_truth))
    prediction = loaded.prediction
    row = _row(pair, prediction.values, loaded, protocol)
    if row.scored and protocol.groups:
        row = replace(row, values=row.values | _additional(pair, loaded, protocol, scales))
    scored = ScoredFrame(
        row=row,
        prediction=_facts(prediction),
        ground_truth=_facts(ground_truth),
        uncertainty=None
        if loaded.sigma is None
        else frame_uncertainty(prediction.values, ground_truth.values, loaded.sigma),
    )
    if loaded.sparse is None or not row.scored or not pair.sparse_named:
        return scored
    depth = _filled(prediction.values) if protocol.is_devkit else prediction.values
    return replace(
        scored,
        by_distance=_binned_sums(
            depth, ground_truth.values, protocol, _distance_px(loaded.sparse), DISTANCE_EDGES_PX
        ),
        by_depth=_binned_sums(
            depth, ground_truth.values, protocol, ground_truth.values, DEPTH_EDGES_M
        ),
    )


def _row(pair: FramePair, depth: Depth, loaded: LoadedFrame, protocol: EvalProtocol) -> FrameScores:
    gt = loaded.ground_truth.values
    sums = error_sums(torch.from_numpy(depth), torch.from_numpy(gt), protocol.thresholds)[0]
    pixels, known = (int(sums[SUMS.index(name)]) for name in ("pixels", "known"))
    filled = loaded.predicted
    row = FrameScores(
        pair=pair,
        values={},
        pixels=pixels,
        known=known,
        predicted=pixels if filled is None else int(np.count_nonzero(filled & (gt > 0))),
        fit=loaded.fit,
        sums=tuple(sums.tolist()),
    )
    if not ((depth > 0).any() or protocol.is_devkit):
        return replace(row, error=f"{pair.prediction} holds no valid depth")
    if not (pixels or protocol.is_devkit):
        return replace(row, error=f"{pair.prediction} has no depth where the ground truth is known")
    both = (gt > 0) & (depth > 0)
    ratio = float(np.median(depth[both] / gt[both])) if pixels else math.nan
    if protocol.is_devkit:
        values = devkit_errors(depth, gt)
        holes = int(np.count_nonzero((fill_background(depth) < 0) & (gt > 0)))
    else:
        keys = (measure.key for measure in MEASURES)
        values, holes = dict(zip(keys, measures_of(sums).tolist(), strict=True)), 0
    leaked = min(pair.sampled, pixels)
    if loaded.sparse is not None:
        points = loaded.sparse
        tolerance = loaded.tolerance + 1e-6 * gt
        leaked = int(np.count_nonzero(both & (points > 0) & (np.abs(points - gt) <= tolerance)))
    return replace(
        row,
        values=values,
        ratio=ratio,
        leaked=leaked,
        has_sparse=loaded.sparse is not None or bool(leaked),
        holes=holes,
    )


def _additional(
    pair: FramePair, loaded: LoadedFrame, protocol: EvalProtocol, scales: Scales
) -> dict[str, float]:
    """The measures of the protocol's additional groups."""
    frame = _measured(pair, loaded)
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
        if group.in_sequences and pair.previous is not None:
            before = load_frame(pair.previous, protocol, scales)
            if before.prediction is not None:
                frame = replace(frame, previous=_measured(pair.previous, before))
        values |= group.values(frame)
    return values


def _measured(pair: FramePair, loaded: LoadedFrame) -> MeasuredFrame:
    assert loaded.prediction is not None
    intrinsics = None
    if pair.frame.calib is not None:
        cut = pair.frame.protocol
        if cut.halved or cut.crop is not None:
            raise InputError(
                f"the calibration of frame {pair.name} is of the whole image, but layout protocol"
                f" {cut.name} cuts it; --layout-protocol whole does not"
            )
        intrinsics = read_calibration(pair.frame.calib, pair.frame.camera).intrinsics
    return MeasuredFrame(
        depth=loaded.prediction.values,
        gt=loaded.ground_truth.values,
        sparse=loaded.sparse,
        intrinsics=intrinsics,
    )


def _facts(image: DepthImage) -> FileFacts:
    return FileFacts(source=image.source, scale=image.scale, assumed_scale=image.assumed_scale)


def _filled(depth: Depth) -> Depth:
    return np.maximum(fill_background(depth), np.float32(0))


def _distance_px(points: Depth) -> Depth:
    """(H, W) pixels to the nearest pixel with a point."""
    empty = (points == 0).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def _binned_sums(
    depth: Depth, gt: Depth, protocol: EvalProtocol, quantity: Depth, edges: tuple[float, ...]
) -> Sums:
    part = np.digitize(quantity, edges[1:-1])
    sums = error_sums(
        torch.from_numpy(depth),
        torch.from_numpy(gt),
        protocol.thresholds,
        torch.from_numpy(part),
        len(edges) - 1,
    )
    return np.asarray(sums.numpy(), np.float64)
