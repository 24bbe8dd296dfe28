"""`pnpdepth eval`: scores depth files against ground truth by a protocol."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from pnpdepth_cli.core.metrics import MEASURES, SUMS, measures_of
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.pipeline.evaluation.dependence import (
    MIN_CLUSTERS,
    Clusters,
    find_clusters,
    independent_frames,
)
from pnpdepth_cli.pipeline.evaluation.diagnostics import FileKinds, diagnose
from pnpdepth_cli.pipeline.evaluation.frame_scoring import (
    DEPTH_EDGES_M,
    DISTANCE_EDGES_PX,
    FrameScores,
    ScoredFrame,
    score_pair,
    scored_or_error,
)
from pnpdepth_cli.pipeline.evaluation.kitti_devkit import devkit_mean
from pnpdepth_cli.pipeline.evaluation.pairing import FramePair, in_sequences, pair_frames
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol, choose_protocol
from pnpdepth_cli.pipeline.evaluation.resampling import (
    Floats,
    FrameTable,
    clusters_among,
    known_together,
    studentised_interval,
)
from pnpdepth_cli.pipeline.evaluation.result import ErrorBin, EvalRequest, Evaluation, Interval
from pnpdepth_cli.pipeline.evaluation.uncertainty import summarise_uncertainty
from pnpdepth_cli.pipeline.ordered_pool import in_order


def evaluate(
    request: EvalRequest, *, on_frame: Callable[[int, int], None] = lambda done, of: None
) -> Evaluation:
    """Returns a row for each frame of the ground truth, scored or with the reason why not; means.

    Frames are read one after the other, so memory does not grow with their number.

    Args:
        request: What to score, and how.
        on_frame: Called with (done, of) after each frame.

    Raises:
        PnpDepthError: For two single files whatever is wrong with them, for folders only what
            concerns all frames.
    """
    protocol = choose_protocol(request.protocol, **request.changes)
    _check(request)
    pairs = pair_frames(
        request.prediction,
        request.ground_truth,
        sparse=request.sparse,
        mask=protocol.mask,
        layout_protocol=request.layout_protocol,
        calib=request.calib,
    )
    rows: list[FrameScores] = []
    kinds = FileKinds()
    uncertainties = []
    by_distance = np.zeros((len(DISTANCE_EDGES_PX) - 1, len(SUMS)))
    by_depth = np.zeros((len(DEPTH_EDGES_M) - 1, len(SUMS)))
    frames = pairs.frames
    if any(group.in_sequences for group in protocol.measure_groups):
        frames = in_sequences(frames)
    for scored in _scored(frames, protocol, request, raising=pairs.single):
        rows.append(scored.row)
        kinds.add(scored)
        if scored.uncertainty is not None:
            uncertainties.append(scored.uncertainty)
        if scored.by_distance is not None and scored.by_depth is not None:
            by_distance += scored.by_distance
            by_depth += scored.by_depth
        on_frame(len(rows), len(pairs.frames))
    scored_rows = [row for row in rows if row.scored]
    if not scored_rows:
        raise InputError(f"no frame could be scored; the first: {rows[0].error}")
    keys = [measure.key for measure in protocol.measures]
    values = np.array([[row.values[key] for key in keys] for row in scored_rows])
    clusters = independent_frames(len(scored_rows))
    if request.grouped:
        clusters = find_clusters([row.pair.group for row in scored_rows], values)
    mean, interval = _mean_and_interval(scored_rows, values, clusters, protocol, request)
    return Evaluation(
        request=request,
        protocol=protocol,
        frames=tuple(rows),
        mean=_by_key(keys, mean),
        interval=interval,
        clusters=clusters,
        uncertainty=summarise_uncertainty(uncertainties),
        by_distance=_bins(by_distance, DISTANCE_EDGES_PX),
        by_depth=_bins(by_depth, DEPTH_EDGES_M),
        notes=(
            *pairs.notes,
            *kinds.notes(),
            *diagnose(rows, protocol, kinds),
            *_interval_notes(clusters, len(scored_rows), request),
        ),
    )


def _check(request: EvalRequest) -> None:
    scales = request.scales
    for option, scale in (
        ("--pred-scale", scales.prediction),
        ("--gt-scale", scales.ground_truth),
        ("--sparse-scale", scales.sparse),
    ):
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise UsageError(f"{option} must be a finite number above 0, not {scale:g}")
    if request.workers < 1:
        raise UsageError(f"--workers {request.workers}: at least one is needed")
    if request.resamples < 0:
        raise UsageError(f"--bootstrap {request.resamples} is negative; 0 leaves it out")


def _scored(
    frames: Sequence[FramePair], protocol: EvalProtocol, request: EvalRequest, *, raising: bool
) -> Iterator[ScoredFrame]:
    """The frames in their order, a few of them worked on at once."""

    def scored(pair: FramePair) -> ScoredFrame:
        if not raising:
            return scored_or_error(pair, protocol, request.scales)
        frame = score_pair(pair, protocol, request.scales)
        if frame.row.error is not None:
            raise InputError(frame.row.error)
        return frame

    return in_order(scored, frames, request.workers)


def _mean_and_interval(
    rows: Sequence[FrameScores],
    values: Floats,
    clusters: Clusters,
    protocol: EvalProtocol,
    request: EvalRequest,
) -> tuple[Floats, Interval | None]:
    """(M,) the means of (N, M) values, and their intervals inside the range of each measure.

    A measure that a frame lacks is averaged over the other frames.
    """
    pooled = protocol.average == "pooled"
    has_gaps = bool(protocol.groups)  # only additional measures may be lacking
    mean, low, high = (np.full(values.shape[1], math.nan) for _ in range(3))
    known = ~np.isnan(values) if has_gaps else np.ones(values.shape, bool)
    for frames, columns in known_together(known):
        if not frames.any():
            continue
        table = FrameTable(rows=values[frames][:, columns])
        if pooled:
            table = FrameTable(rows=np.array([row.sums for row in rows]), pooled=True)
        mean[columns] = devkit_mean(values) if protocol.is_devkit else table.mean()
        totals = table.cluster_totals(clusters_among(clusters.ids, frames))
        if len(totals) >= MIN_CLUSTERS and request.resamples:
            low[columns], high[columns] = studentised_interval(
                table.means_of, totals, request.resamples, request.seed
            )
    if clusters.count < MIN_CLUSTERS or not request.resamples:
        return mean, None
    highest = [1.0 if measure.percent else math.inf for measure in protocol.measures]
    keys = [measure.key for measure in protocol.measures]
    low, high = np.maximum(low, 0.0), np.minimum(high, highest)
    return mean, Interval(low=_by_key(keys, low), high=_by_key(keys, high))


def _interval_notes(clusters: Clusters, frames: int, request: EvalRequest) -> list[str]:
    if frames == 1 or clusters.count >= MIN_CLUSTERS or not request.resamples:
        return []
    return [
        f"no interval: {clusters.describe()} are too few to tell how sure the means are;"
        f" {MIN_CLUSTERS} are needed"
    ]


def _by_key(keys: Sequence[str], values: Floats) -> dict[str, float]:
    return dict(zip(keys, values.tolist(), strict=True))


def _bins(sums: Floats, edges: tuple[float, ...]) -> tuple[ErrorBin, ...]:
    """The bins that have ground truth in them."""
    keys = [measure.key for measure in MEASURES]
    measures = measures_of(torch.from_numpy(sums)).tolist()
    bins = []
    for low, high, row, values in zip(edges, edges[1:], sums, measures, strict=False):
        counts, errors = dict(zip(SUMS, row, strict=True)), dict(zip(keys, values, strict=True))
        if counts["known"]:
            error_bin = ErrorBin(
                low=low,
                high=high,
                pixels=int(counts["pixels"]),
                known=int(counts["known"]),
                rmse=errors["rmse"],
                mae=errors["mae"],
                mre=errors["mre"],
            )
            bins.append(error_bin)
    return tuple(bins)
