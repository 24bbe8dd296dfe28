"""`pnpdepth eval`: depth files against ground truth, by a protocol."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from pnpdepth_cli.core.metrics import MEASURES, SUMS, measures_of
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.pipeline.evaluation.averages import FrameTable, bootstrap
from pnpdepth_cli.pipeline.evaluation.findings import FileKinds, findings
from pnpdepth_cli.pipeline.evaluation.frame_scoring import (
    DEPTH_EDGES_M,
    DISTANCE_EDGES_PX,
    FrameScores,
    ScoredFrame,
    Sums,
    score_pair,
)
from pnpdepth_cli.pipeline.evaluation.kitti_devkit import devkit_mean
from pnpdepth_cli.pipeline.evaluation.pairing import FramePair, pair_frames
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol, choose_protocol
from pnpdepth_cli.pipeline.evaluation.result import EvalRequest, Evaluation, Interval, Part
from pnpdepth_cli.pipeline.ordered_pool import in_order


def evaluate(
    request: EvalRequest, *, on_frame: Callable[[int, int], None] = lambda done, of: None
) -> Evaluation:
    """Every frame of the truth has a row, scored or with the reason why not; and the means.

    on_frame(done, of) is called after each frame. Frames are read one after the other, so memory
    does not grow with their number. Raises the errors of `pnpdepth_cli.errors`: of two single files
    whatever is wrong with them, of folders only what concerns all frames.
    """
    protocol = choose_protocol(request.protocol, **request.changes)
    _check(request)
    pairs = pair_frames(
        request.prediction, request.truth, sparse=request.sparse, mask=protocol.mask
    )
    rows: list[FrameScores] = []
    kinds = FileKinds()
    by_distance = np.zeros((len(DISTANCE_EDGES_PX) - 1, len(SUMS)))
    by_depth = np.zeros((len(DEPTH_EDGES_M) - 1, len(SUMS)))
    for scored in _scored(pairs.frames, protocol, request, raising=pairs.single):
        rows.append(scored.row)
        kinds.add(scored)
        if scored.by_distance is not None and scored.by_depth is not None:
            by_distance += scored.by_distance
            by_depth += scored.by_depth
        on_frame(len(rows), len(pairs.frames))
    good = [row for row in rows if row.scored]
    if not good:
        raise InputError(f"no frame could be scored; the first: {rows[0].error}")
    mean, interval = _means(good, protocol, request)
    return Evaluation(
        request=request,
        protocol=protocol,
        frames=tuple(rows),
        mean=mean,
        interval=interval,
        by_distance=_parts(by_distance, DISTANCE_EDGES_PX),
        by_depth=_parts(by_depth, DEPTH_EDGES_M),
        notes=(*pairs.notes, *kinds.notes(), *findings(rows, protocol, kinds)),
    )


def _check(request: EvalRequest) -> None:
    scales = request.scales
    for option, scale in (
        ("--pred-scale", scales.prediction),
        ("--gt-scale", scales.truth),
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
        try:
            frame = score_pair(pair, protocol, request.scales)
        except PnpDepthError as error:
            if raising:
                raise
            return ScoredFrame(row=FrameScores(pair=pair, values={}, error=str(error)))
        if raising and frame.row.error is not None:
            raise InputError(frame.row.error)
        return frame

    return in_order(scored, frames, request.workers)


def _means(
    good: Sequence[FrameScores], protocol: EvalProtocol, request: EvalRequest
) -> tuple[dict[str, float], Interval | None]:
    keys = [measure.key for measure in protocol.measures]
    values = np.array([[row.values[key] for key in keys] for row in good])
    pooled = protocol.average == "pooled"
    table = FrameTable(
        rows=np.array([row.sums for row in good]) if pooled else values, pooled=pooled
    )
    mean = devkit_mean(values) if protocol.is_devkit else table.mean()
    interval = None
    if len(good) > 1 and request.resamples:
        low, high = bootstrap(table.means, len(good), request.resamples, request.seed)
        interval = Interval(low=_named(keys, low), high=_named(keys, high))
    return _named(keys, mean), interval


def _named(keys: Sequence[str], values: Sums) -> dict[str, float]:
    return dict(zip(keys, values.tolist(), strict=True))


def _parts(sums: Sums, edges: tuple[float, ...]) -> tuple[Part, ...]:
    """The parts that have truth in them."""
    keys = [measure.key for measure in MEASURES]
    measures = measures_of(torch.from_numpy(sums)).tolist()
    parts = []
    for low, high, row, values in zip(edges, edges[1:], sums, measures, strict=False):
        of, errors = dict(zip(SUMS, row, strict=True)), dict(zip(keys, values, strict=True))
        if of["known"]:
            part = Part(
                low=low,
                high=high,
                pixels=int(of["pixels"]),
                known=int(of["known"]),
                rmse=errors["rmse"],
                mae=errors["mae"],
                mre=errors["mre"],
            )
            parts.append(part)
    return tuple(parts)
