"""What one frame contributes: its measures, sums that can be added up, and what is odd about it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.core.metrics import SUMS, error_sums, measures_of
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import DepthImage
from pnpdepth_cli.pipeline.evaluation.frame_reading import Depth, LoadedFrame, Scales, load_frame
from pnpdepth_cli.pipeline.evaluation.kitti_devkit import devkit_errors, fill_background
from pnpdepth_cli.pipeline.evaluation.pairing import FramePair
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol

DISTANCE_EDGES_PX = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, math.inf)
DEPTH_EDGES_M = (0.0, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 40.0, 80.0, math.inf)
"""Parts are half open: from an edge up to, and without, the next."""

Sums = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrameScores:
    """One frame's row.

    values: of each measure by its key, empty where the frame was not scored; `error` says why,
    `missing` that there is no prediction. pixels: scored. known: pixels of truth that count.
    ratio: median of prediction / truth. given: scored pixels whose truth is the sparse input's
    own value. holes: pixels of truth that even the development kit's fill left without depth.
    sums: over the pixels, in the order of core.metrics.SUMS.
    """

    pair: FramePair
    values: dict[str, float]
    pixels: int = 0
    known: int = 0
    ratio: float = math.nan
    given: int = 0
    has_sparse: bool = False
    holes: int = 0
    sums: tuple[float, ...] = ()
    missing: bool = False
    error: str | None = None

    @property
    def name(self) -> str:
        """The frame's name, by which evaluations are compared."""
        return self.pair.name

    @property
    def scored(self) -> bool:
        """True if the frame is in the means."""
        return self.error is None

    @property
    def coverage(self) -> float:
        """The share of the truth's pixels that has a prediction."""
        return self.pixels / self.known if self.known else math.nan


@dataclass(frozen=True, kw_only=True)
class FileFacts:
    """What a depth file is, for a person.

    scale: codes per metre, None for floats; either the file says it, or nobody does and it is
    assumed, or else the user or the data set gave it.
    """

    source: str
    scale: float | None
    assumed_scale: bool

    @property
    def scale_in_file(self) -> bool:
        """True if the file itself says its scale, which the source tells."""
        return "(from the file)" in self.source


@dataclass(frozen=True, kw_only=True)
class ScoredFrame:
    """A frame's row, what its files are, and its sums by distance from a point and by depth.

    by_distance, by_depth: (parts, len(SUMS)), None where the user gave no sparse depth.
    """

    row: FrameScores
    truth: FileFacts | None = None
    prediction: FileFacts | None = None
    by_distance: Sums | None = None
    by_depth: Sums | None = None


def score_pair(pair: FramePair, protocol: EvalProtocol, scales: Scales) -> ScoredFrame:
    """The frame's files, scored. Raises the errors of reading, and InputError without truth.

    A missing or empty prediction is no error here: its row says so.
    """
    loaded = load_frame(pair, protocol, scales)
    truth = loaded.truth
    known = int(np.count_nonzero(truth.values))
    if not known:
        raise InputError(
            f"{pair.truth.gt} has no known depth where protocol {protocol.name} scores"
        )
    if loaded.prediction is None:
        row = FrameScores(
            pair=pair, values={}, known=known, missing=True, error="there is no prediction"
        )
        return ScoredFrame(row=row, truth=_facts(truth))
    prediction = loaded.prediction
    row = _row(pair, prediction.values, loaded, protocol)
    scored = ScoredFrame(row=row, prediction=_facts(prediction), truth=_facts(truth))
    if loaded.sparse is None or not row.scored or not pair.sparse_asked:
        return scored
    depth = _filled(prediction.values) if protocol.is_devkit else prediction.values
    return replace(
        scored,
        by_distance=_sums(
            depth, truth.values, protocol, _distance(loaded.sparse), DISTANCE_EDGES_PX
        ),
        by_depth=_sums(depth, truth.values, protocol, truth.values, DEPTH_EDGES_M),
    )


def _row(pair: FramePair, depth: Depth, loaded: LoadedFrame, protocol: EvalProtocol) -> FrameScores:
    truth = loaded.truth.values
    sums = error_sums(
        torch.from_numpy(depth), torch.from_numpy(truth), protocol.thresholds
    )[0]  # fmt: skip
    pixels, known = (int(sums[SUMS.index(name)]) for name in ("pixels", "known"))
    row = FrameScores(pair=pair, values={}, pixels=pixels, known=known, sums=tuple(sums.tolist()))
    if not (depth > 0).any():
        return replace(row, error=f"{pair.prediction} holds no valid depth")
    if not (pixels or protocol.is_devkit):
        return replace(row, error=f"{pair.prediction} has no depth where the truth is known")
    both = (truth > 0) & (depth > 0)
    ratio = float(np.median(depth[both] / truth[both])) if pixels else math.nan
    if protocol.is_devkit:
        values = devkit_errors(depth, truth)
        holes = int(np.count_nonzero((fill_background(depth) < 0) & (truth > 0)))
    else:
        keys = (measure.key for measure in protocol.measures)
        values, holes = dict(zip(keys, measures_of(sums).tolist(), strict=True)), 0
    given = min(pair.sampled, pixels)
    if loaded.sparse is not None:
        points = loaded.sparse
        tolerance = loaded.tolerance + 1e-6 * truth
        given = int(np.count_nonzero(both & (points > 0) & (np.abs(points - truth) <= tolerance)))
    return replace(
        row,
        values=values,
        ratio=ratio,
        given=given,
        has_sparse=loaded.sparse is not None or bool(given),
        holes=holes,
    )


def _facts(image: DepthImage) -> FileFacts:
    return FileFacts(source=image.source, scale=image.scale, assumed_scale=image.assumed_scale)


def _filled(depth: Depth) -> Depth:
    return np.maximum(fill_background(depth), np.float32(0))


def _distance(points: Depth) -> Depth:
    """(H, W) pixels to the nearest pixel with a point."""
    empty = (points == 0).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def _sums(
    depth: Depth, truth: Depth, protocol: EvalProtocol, quantity: Depth, edges: tuple[float, ...]
) -> Sums:
    part = np.digitize(quantity, edges[1:-1])
    sums = error_sums(
        torch.from_numpy(depth),
        torch.from_numpy(truth),
        protocol.thresholds,
        torch.from_numpy(part),
        len(edges) - 1,
    )
    return np.asarray(sums.numpy(), np.float64)
