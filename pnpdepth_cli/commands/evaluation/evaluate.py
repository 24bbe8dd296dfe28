"""`pnpdepth eval`: scores depth files against ground truth by a protocol."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.commands.evaluation.dependence import MIN_CLUSTERS, Clusters, find_clusters
from pnpdepth_cli.commands.evaluation.diagnostics import kind_notes, warnings_of
from pnpdepth_cli.commands.evaluation.frame_reading import Scales
from pnpdepth_cli.commands.evaluation.frame_scoring import FrameScores, score_pair
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_mean
from pnpdepth_cli.commands.evaluation.pairing import FramePair, pair_frames
from pnpdepth_cli.commands.evaluation.protocols import EvalProtocol, choose_protocol
from pnpdepth_cli.commands.evaluation.resampling import LEVEL, Floats, FrameTable, mean_interval
from pnpdepth_cli.commands.evaluation.uncertainty import Uncertainty, summarise_uncertainty
from pnpdepth_cli.commands.ordered_pool import in_order
from pnpdepth_cli.commands.stopwatch import versions
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.record import plain


@dataclass(frozen=True, kw_only=True)
class EvalRequest:
    """What to score, and how."""

    prediction: Path
    """A depth file, or a folder of them."""
    ground_truth: Path
    """A depth file, a folder of them, or a data set of a known layout."""
    sparse: Path | None = None
    """The networks' sparse input: a file, or a folder of them."""
    protocol: str = "paper"
    calib: Path | None = None
    """Calibration of all frames, for measures that need the intrinsics; None for the data set's."""
    layout_protocol: str | None = None
    """How frames of a data set are cut, one of FRAME_PROTOCOLS; None for the layout's own."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Fields of the protocol that the user sets otherwise."""
    scales: Scales = field(default_factory=Scales)
    resamples: int = 2000
    """Bootstrap samples behind the intervals; 0 computes none."""
    seed: int = 0
    """Of the bootstrap."""
    grouped: bool = True
    """False if every frame counts as independent."""
    workers: int = 2
    """Frames read at once."""


Interval = dict[str, tuple[float, float]]
"""The ends of the 95 % interval of each measure's mean by its key; NaN where there is none."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scored frames and their means."""

    request: EvalRequest
    protocol: EvalProtocol
    """With the user's changes."""
    frames: tuple[FrameScores, ...]
    """A row for each frame of the ground truth, in its order."""
    mean: dict[str, float]
    """Over the scored frames, by the measure's key."""
    interval: Interval | None
    """None with too few independent frames."""
    clusters: Clusters
    """What the bootstrap resamples as a whole."""
    uncertainty: Uncertainty | None
    """Whether predicted standard deviations are right; None without any."""
    notes: tuple[str, ...]
    """What was assumed, and warnings; one line each."""

    @property
    def scored(self) -> tuple[FrameScores, ...]:
        """The frames that are in the means."""
        return tuple(frame for frame in self.frames if frame.scored)

    @property
    def missing(self) -> tuple[FrameScores, ...]:
        """The frames without a prediction."""
        return tuple(frame for frame in self.frames if frame.missing)

    @property
    def failed(self) -> tuple[FrameScores, ...]:
        """The frames with a faulty file."""
        return tuple(frame for frame in self.frames if not frame.scored and not frame.missing)

    @property
    def coverage(self) -> float:
        """Fraction of all ground truth, of frames without prediction too, that has a prediction."""
        known = sum(frame.known for frame in self.frames)
        return sum(frame.predicted for frame in self.frames) / known if known else math.nan

    def unscored(self) -> str | None:
        """Returns one line on the frames that are in no mean; None if all are."""
        out = len(self.frames) - len(self.scored)
        if not out:
            return None
        return (
            f"{out:,} of {len(self.frames):,} frames were not scored"
            f" ({len(self.missing):,} without prediction, {len(self.failed):,} with a faulty file);"
            f" the means are over the other {len(self.scored):,}"
        )

    def as_record(self) -> dict[str, Any]:
        """Returns what `--json` prints and `pnpdepth compare` reads; NaN and infinity are null."""
        request, protocol = self.request, self.protocol
        interval = None
        if self.interval is not None:
            interval = {
                "level": LEVEL,
                "resamples": request.resamples,
                "seed": request.seed,
                "clusters": self.clusters.count,
                "unit": self.clusters.unit,
                "low": {key: low for key, (low, _) in self.interval.items()},
                "high": {key: high for key, (_, high) in self.interval.items()},
            }
        pooled = protocol.average == "pooled"
        record = {
            "command": "eval",
            "versions": versions(),
            "inputs": {
                "prediction": request.prediction,
                "truth": request.ground_truth,
                "sparse": request.sparse,
                "calib": request.calib,
                "layout_protocol": request.layout_protocol,
                "scales": asdict(request.scales),
            },
            "protocol": {
                "name": protocol.name,
                "scale": protocol.scale,
                "described": protocol.describe(),
                "scoring": protocol.scoring(),
            },
            "measures": [asdict(measure) for measure in protocol.measures],
            "counts": {
                "frames": len(self.frames),
                "scored": len(self.scored),
                "missing": len(self.missing),
                "failed": len(self.failed),
                "pixels": sum(frame.pixels for frame in self.frames),
                "coverage": self.coverage,
            },
            "mean": self.mean,
            "interval": interval,
            "uncertainty": None if self.uncertainty is None else asdict(self.uncertainty),
            "frames": [
                frame_record(frame) | ({"sums": frame.sums} if pooled else {})
                for frame in self.frames
            ],
            "notes": list(self.notes),
        }
        result: dict[str, Any] = plain(record)
        return result


def frame_record(frame: FrameScores) -> dict[str, Any]:
    """Returns a frame's row as files have it."""
    pair, fit = frame.pair, frame.fit
    paths = {"prediction": pair.prediction, "truth": pair.frame.gt, "sparse": pair.sparse}
    paths |= {"image": pair.image}
    return {
        "name": frame.name,
        "group": pair.group,
        **{name: None if path is None else str(path) for name, path in paths.items()},
        "pixels": frame.pixels,
        "known": frame.known,
        "coverage": frame.coverage,
        "pixels_given_as_sparse": frame.leaked,
        "median_ratio": frame.ratio,
        "factor": fit and fit.factor,
        "shift": fit and fit.shift,
        "values": frame.values,
        "error": frame.error,
    }


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

    def score(pair: FramePair) -> FrameScores:
        try:
            row = score_pair(pair, protocol, request.scales)
        except PnpDepthError as error:
            if pairs.single:
                raise
            return FrameScores(pair=pair, error=str(error))
        if pairs.single and row.error is not None:
            raise InputError(row.error)
        return row

    rows: list[FrameScores] = []
    for row in in_order(score, pairs.frames, request.workers):
        rows.append(row)
        on_frame(len(rows), len(pairs.frames))
    scored = [row for row in rows if row.scored]
    if not scored:
        raise InputError(f"no frame could be scored; the first: {rows[0].error}")
    keys = [measure.key for measure in protocol.measures]
    values = np.array([[row.values[key] for key in keys] for row in scored])
    groups = [row.pair.group for row in scored]
    clusters = find_clusters(groups, values, grouped=request.grouped)
    mean, interval = _mean_and_interval(scored, values, clusters, protocol, request)
    uncertainties = [row.uncertainty for row in scored if row.uncertainty is not None]
    return Evaluation(
        request=request,
        protocol=protocol,
        frames=tuple(rows),
        mean=dict(zip(keys, mean.tolist(), strict=True)),
        interval=interval,
        clusters=clusters,
        uncertainty=summarise_uncertainty(uncertainties),
        notes=(
            *pairs.notes,
            *kind_notes(rows),
            *warnings_of(rows, protocol),
            *_interval_notes(clusters, len(scored), request),
        ),
    )


def _check(request: EvalRequest) -> None:
    scales = request.scales
    for option, scale in (
        ("--pred-scale", scales.prediction),
        ("--gt-scale", scales.truth),
        ("--sparse-scale", scales.sparse),
    ):
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise UsageError(f"{option} must be a finite number above 0, got {scale:g}")
    if request.workers < 1:
        raise UsageError(f"--workers must be >= 1, got {request.workers}")
    if request.resamples < 0:
        raise UsageError(f"--bootstrap must be >= 0, got {request.resamples}; 0 leaves it out")


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
    measures = protocol.measures
    if protocol.average == "pooled":
        table = FrameTable.of_pixels(
            np.array([row.sums for row in rows]), [m.key for m in measures]
        )
    else:
        table = FrameTable.of_frames(values)
    mean = devkit_mean(values) if protocol.is_devkit else table.mean()
    if clusters.count < MIN_CLUSTERS or not request.resamples:
        return mean, None
    low, high = mean_interval(table, clusters.ids, request.resamples, request.seed)
    low, high = (np.where(np.isnan(mean), math.nan, end) for end in (low, high))
    highest = [1.0 if measure.percent else math.inf for measure in measures]
    ends = np.stack([np.maximum(low, 0.0), np.minimum(high, highest)], axis=-1).tolist()
    return mean, {m.key: (a, b) for m, (a, b) in zip(measures, ends, strict=True)}


def _interval_notes(clusters: Clusters, frames: int, request: EvalRequest) -> list[str]:
    if frames == 1 or clusters.count >= MIN_CLUSTERS or not request.resamples:
        return []
    return [
        f"no interval: {clusters.describe()} are too few to tell how sure the means are;"
        f" {MIN_CLUSTERS} are needed"
    ]
