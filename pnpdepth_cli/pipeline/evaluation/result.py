"""What an evaluation found: a plain result that every output is made from."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.record import plain
from pnpdepth_cli.pipeline.evaluation.averages import LEVEL
from pnpdepth_cli.pipeline.evaluation.frame_reading import Scales
from pnpdepth_cli.pipeline.evaluation.frame_scoring import FrameScores
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol
from pnpdepth_cli.pipeline.stopwatch import versions


@dataclass(frozen=True, kw_only=True)
class EvalRequest:
    """What to score. The protocol's fields that the user changes are in `changes`.

    prediction, truth: two files or two folders; sparse, mask: a file or folder, or None.
    resamples: of the bootstrap over the frames. workers: frames read at once.
    """

    prediction: Path
    truth: Path
    sparse: Path | None = None
    protocol: str = "paper"
    changes: dict[str, Any] = field(default_factory=dict)
    scales: Scales = field(default_factory=Scales)
    resamples: int = 2000
    seed: int = 0
    workers: int = 2


@dataclass(frozen=True, kw_only=True)
class Interval:
    """The confidence interval of each measure's mean, by its key; NaN where there is none."""

    low: dict[str, float]
    high: dict[str, float]

    def half_width(self, key: str) -> float:
        """What stands behind the ±."""
        return (self.high[key] - self.low[key]) / 2


@dataclass(frozen=True, kw_only=True)
class Part:
    """Errors of the pixels with a quantity from `low` up to `high`, pooled over all frames."""

    low: float
    high: float
    pixels: int
    known: int
    rmse: float
    mae: float
    mre: float


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scored frames and their means.

    frames: one row for each frame of the truth, in its order. mean: of each measure by its key,
    over the scored frames. interval: of the means, None for a single frame. by_distance: parts by
    pixels to the nearest sparse point; by_depth: by metres of truth; both empty without --sparse.
    """

    request: EvalRequest
    protocol: EvalProtocol
    frames: tuple[FrameScores, ...]
    mean: dict[str, float]
    interval: Interval | None
    by_distance: tuple[Part, ...]
    by_depth: tuple[Part, ...]
    notes: tuple[str, ...]

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
        """The frames whose files are at fault."""
        return tuple(frame for frame in self.frames if not frame.scored and not frame.missing)

    @property
    def coverage(self) -> float:
        """The share of all truth, of frames without prediction too, that was scored."""
        known = sum(frame.known for frame in self.frames)
        return sum(frame.pixels for frame in self.frames) / known if known else math.nan

    def unscored(self) -> str | None:
        """One line on the frames that are in no mean; None if all are."""
        out = len(self.frames) - len(self.scored)
        if not out:
            return None
        return (
            f"{out:,} of {len(self.frames):,} frames were not scored"
            f" ({len(self.missing):,} without prediction, {len(self.failed):,} with a faulty file);"
            f" the means are over the other {len(self.scored):,}"
        )

    def worst(self, key: str) -> tuple[FrameScores, ...]:
        """The scored frames by one measure, worst first; those without a number at the very end."""
        (measure,) = (m for m in self.protocol.measures if m.key == key)
        sign = 1 if measure.higher_is_better else -1
        return tuple(sorted(self.scored, key=lambda f: (math.isnan(v := f.values[key]), sign * v)))

    def as_record(self) -> dict[str, Any]:
        """What `--json` prints and `pnpdepth compare` reads; NaN is null, infinity is null."""
        request, protocol = self.request, self.protocol
        pooled = protocol.average == "pooled"
        record = {
            "command": "eval",
            "versions": versions(),
            "inputs": {
                "prediction": str(request.prediction),
                "truth": str(request.truth),
                "sparse": str(request.sparse) if request.sparse else None,
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
            "interval": self._interval(),
            "by_distance_px": [asdict(part) for part in self.by_distance],
            "by_depth_m": [asdict(part) for part in self.by_depth],
            "frames": [frame_record(frame, with_sums=pooled) for frame in self.frames],
            "notes": list(self.notes),
        }
        found: dict[str, Any] = plain(record)
        return found

    def _interval(self) -> dict[str, Any] | None:
        if self.interval is None:
            return None
        request = self.request
        drawn = {"level": LEVEL, "resamples": request.resamples, "seed": request.seed}
        return drawn | asdict(self.interval)


def frame_record(frame: FrameScores, *, with_sums: bool = False) -> dict[str, Any]:
    """A frame's row as files have it."""
    pair = frame.pair
    record = {
        "name": frame.name,
        "prediction": str(pair.prediction) if pair.prediction else None,
        "truth": str(pair.truth.gt),
        "sparse": str(pair.sparse) if pair.sparse else None,
        "image": str(pair.image) if pair.image else None,
        "pixels": frame.pixels,
        "known": frame.known,
        "coverage": frame.coverage,
        "pixels_given_as_sparse": frame.given if frame.has_sparse else None,
        "median_ratio": frame.ratio,
        "values": frame.values,
        "error": frame.error,
    }
    return record | {"sums": list(frame.sums)} if with_sums else record
