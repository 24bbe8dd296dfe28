"""The request and the result of `pnpdepth eval`; every output is made from the result."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.record import plain
from pnpdepth_cli.pipeline.evaluation.dependence import Clusters
from pnpdepth_cli.pipeline.evaluation.frame_reading import Scales
from pnpdepth_cli.pipeline.evaluation.frame_scoring import FrameScores
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol
from pnpdepth_cli.pipeline.evaluation.resampling import LEVEL
from pnpdepth_cli.pipeline.evaluation.uncertainty import Uncertainty
from pnpdepth_cli.pipeline.stopwatch import versions


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
    """Name of the protocol."""
    calib: Path | None = None
    """Calibration of all frames, for measures that need the intrinsics; None for the data set's."""
    layout_protocol: str | None = None
    """How frames of a data set are cut, one of FRAME_PROTOCOLS; None for the layout's own."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Fields of the protocol that the user sets otherwise."""
    scales: Scales = field(default_factory=Scales)
    """Codes per metre of integer files."""
    resamples: int = 2000
    """Bootstrap samples behind the intervals; 0 computes none."""
    seed: int = 0
    """Of the bootstrap."""
    grouped: bool = True
    """False if every frame counts as independent."""
    workers: int = 2
    """Frames read at once."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """The 95 % confidence interval of each measure's mean; NaN where there is none."""

    low: dict[str, float]
    """Lower ends by the measure's key."""
    high: dict[str, float]
    """Upper ends by the measure's key."""

    def half_width(self, key: str) -> float:
        """Returns half of the interval's width, in the measure's unit."""
        return (self.high[key] - self.low[key]) / 2


@dataclass(frozen=True, kw_only=True)
class ErrorBin:
    """Errors of the pixels with some quantity from `low` up to `high`, pooled over all frames."""

    low: float
    """Lower edge, inside."""
    high: float
    """Upper edge, outside."""
    pixels: int
    """Scored pixels."""
    known: int
    """Pixels with ground truth."""
    rmse: float
    """Metres."""
    mae: float
    """Metres."""
    mre: float
    """Mean of |p − g| / g."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scored frames and their means."""

    request: EvalRequest
    """What was scored."""
    protocol: EvalProtocol
    """The protocol with the user's changes."""
    frames: tuple[FrameScores, ...]
    """A row for each frame of the ground truth, in its order."""
    mean: dict[str, float]
    """Over the scored frames, by the measure's key."""
    interval: Interval | None
    """Of the means; None with too few independent frames."""
    clusters: Clusters
    """What the bootstrap resamples as a whole."""
    uncertainty: Uncertainty | None
    """Whether predicted standard deviations are right; None without any."""
    by_distance: tuple[ErrorBin, ...]
    """By pixels to the nearest sparse point; empty without --sparse."""
    by_depth: tuple[ErrorBin, ...]
    """By metres of the ground truth; empty without --sparse."""
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

    def describe_interval(self) -> str:
        """Returns what the interval is, such as `95 % interval: … over 12 groups of frames`."""
        return f"95 % interval: studentised bootstrap over {self.clusters.describe()}"

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

    def worst(self, key: str) -> tuple[FrameScores, ...]:
        """Returns the scored frames by one measure, worst first, those with NaN at the very end."""
        (measure,) = (m for m in self.protocol.measures if m.key == key)
        sign = 1 if measure.higher_is_better else -1
        return tuple(sorted(self.scored, key=lambda f: (math.isnan(v := f.values[key]), sign * v)))

    def as_record(self) -> dict[str, Any]:
        """Returns what `--json` prints and `pnpdepth compare` reads; NaN and infinity are null."""
        request, protocol = self.request, self.protocol
        pooled = protocol.average == "pooled"
        record = {
            "command": "eval",
            "versions": versions(),
            "inputs": {
                "prediction": str(request.prediction),
                "truth": str(request.ground_truth),
                "sparse": str(request.sparse) if request.sparse else None,
                "calib": str(request.calib) if request.calib else None,
                "layout_protocol": request.layout_protocol,
                "scales": request.scales.as_record(),
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
            "interval": self._interval_record(),
            "uncertainty": None if self.uncertainty is None else asdict(self.uncertainty),
            "by_distance_px": [asdict(part) for part in self.by_distance],
            "by_depth_m": [asdict(part) for part in self.by_depth],
            "frames": [frame_record(frame, with_sums=pooled) for frame in self.frames],
            "notes": list(self.notes),
        }
        result: dict[str, Any] = plain(record)
        return result

    def _interval_record(self) -> dict[str, Any] | None:
        if self.interval is None:
            return None
        request = self.request
        return {
            "level": LEVEL,
            "resamples": request.resamples,
            "seed": request.seed,
            "clusters": self.clusters.count,
            "unit": self.clusters.unit,
            **asdict(self.interval),
        }


def frame_record(frame: FrameScores, *, with_sums: bool = False) -> dict[str, Any]:
    """Returns a frame's row as files have it.

    Args:
        frame: The frame.
        with_sums: True to add the sums over pixels that a pooled mean is made of.
    """
    pair = frame.pair
    record = {
        "name": frame.name,
        "group": pair.group,
        "prediction": str(pair.prediction) if pair.prediction else None,
        "truth": str(pair.frame.gt),
        "sparse": str(pair.sparse) if pair.sparse else None,
        "image": str(pair.image) if pair.image else None,
        "pixels": frame.pixels,
        "known": frame.known,
        "coverage": frame.coverage,
        "pixels_given_as_sparse": frame.leaked if frame.has_sparse else None,
        "median_ratio": frame.ratio,
        "factor": None if frame.fit is None else frame.fit.factor,
        "shift": None if frame.fit is None else frame.fit.shift,
        "values": frame.values,
        "error": frame.error,
    }
    return record | {"sums": list(frame.sums)} if with_sums else record
