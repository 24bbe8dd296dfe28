"""`pnpdepth eval`: scores depth files against ground truth by a protocol."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_mean
from pnpdepth_cli.commands.evaluation.pairing import FramePair, pair_frames, some_names
from pnpdepth_cli.commands.evaluation.request import EvalRequest
from pnpdepth_cli.commands.evaluation.scoring import (
    FrameScores,
    score_pair,
)
from pnpdepth_cli.commands.ordered_pool import THREADS, in_order
from pnpdepth_cli.commands.statistics import (
    LEVEL,
    MIN_CLUSTERS,
    Clusters,
    find_clusters,
    interval,
)
from pnpdepth_cli.commands.stopwatch import versions
from pnpdepth_cli.dataset.read_options import METRES
from pnpdepth_cli.errors import InputError, PnpDepthError
from pnpdepth_cli.io.depth import scale_warning
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.measures import OF_SIGMA, FrameMeans, Measure

_LISTED = 3
_OPTIONS = {"prediction": "--pred-scale", "gt": "--gt-scale"}


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scored frames and their means."""

    request: EvalRequest
    frames: tuple[FrameScores, ...]
    """A row for each frame of the ground truth, in its order."""
    measures: tuple[Measure, ...]
    """Those of the request, and those of the standard deviation where a frame has one."""
    mean: dict[str, float | None]
    """Of each measure; None where no frame has it."""
    interval: dict[str, tuple[float, float]] | None
    """The ends of the 95 % interval of each mean; None with too few independent frames."""
    clusters: Clusters
    notes: tuple[str, ...]

    @property
    def scored(self) -> tuple[FrameScores, ...]:
        """The frames that are in the means."""
        return tuple(frame for frame in self.frames if frame.scored)

    @property
    def coverage(self) -> float:
        """Fraction of all ground truth, of frames without prediction too, that has a prediction."""
        known = sum(frame.known for frame in self.frames)
        return sum(frame.predicted for frame in self.frames) / known if known else math.nan

    def describe(self) -> str:
        """Returns the protocol and every scale of files that was assumed, on one line."""
        readings = (
            f"{side}: {reading}"
            for side in _OPTIONS
            for reading, _ in readings_of(self.frames, side)
            if reading.assumed
        )
        return "; ".join([self.request.describe(), *readings])

    def unscored(self) -> str:
        """Returns why frames are in no mean; empty if all are."""
        missing = sum(frame.missing for frame in self.frames)
        faulty = len(self.frames) - len(self.scored) - missing
        reasons = [f"{missing:,} without prediction"] * bool(missing)
        return ", ".join([*reasons, *[f"{faulty:,} with a faulty file"] * bool(faulty)])

    def as_record(self) -> dict[str, Any]:
        """Returns what `--json` prints and `pnpdepth compare` reads; NaN and infinity are null."""
        request = self.request
        record = {
            "command": "eval",
            "versions": versions(),
            "prediction": request.prediction,
            "truth": request.ground_truth,
            "scales": {"prediction": request.pred_scale, "truth": request.gt_scale},
            "protocol": request.protocol,
            "described": request.describe(),
            "scoring": request.scoring(),
            "measures": [measure.to_json() for measure in self.measures],
            "counts": {
                "frames": len(self.frames),
                "scored": len(self.scored),
                "missing": sum(frame.missing for frame in self.frames),
                "pixels": sum(frame.pixels for frame in self.frames),
                "coverage": self.coverage,
            },
            "mean": self.mean,
            "interval": self.interval,
            "level": LEVEL,
            "clusters": {"count": self.clusters.count, "unit": self.clusters.unit},
            "frames": [frame_record(frame) for frame in self.frames],
            "notes": self.notes,
        }
        result: dict[str, Any] = plain(record)
        return result


def frame_record(frame: FrameScores) -> dict[str, Any]:
    """Returns a frame's row as files have it."""
    pair, fit = frame.pair, frame.fit
    return {
        "name": frame.name,
        "group": pair.group,
        **{name: None if path is None else str(path) for name, path in pair.paths.items()},
        "pixels": frame.pixels,
        "known": frame.known,
        "coverage": frame.coverage,
        "pixels_given_as_sparse": frame.given,
        "median_ratio": frame.ratio,
        "factor": fit and fit.factor,
        "shift": fit and fit.shift,
        "scores": {"after": frame.values} if frame.scored else None,
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
        PnpDepthError: For what concerns all frames, or if none could be scored.
    """
    pairs, notes = pair_frames(request.prediction, request.ground_truth, part=request.rules.part)

    def score(pair: FramePair) -> FrameScores:
        try:
            return score_pair(pair, request)
        except PnpDepthError as error:
            return FrameScores(pair=pair, error=str(error))

    rows: list[FrameScores] = []
    for row in in_order(score, pairs, THREADS):
        rows.append(row)
        on_frame(len(rows), len(pairs))
    scored = [row for row in rows if row.scored]
    if not scored:
        raise InputError(f"no frame could be scored; the first: {rows[0].error}")
    # means, and how sure they are over frames that count as independent
    of_sigma = [m for m in OF_SIGMA if any(m.key in row.values for row in scored)]
    measures = (*request.measures, *of_sigma)
    values = np.array([[row.values.get(m.key, math.nan) for m in measures] for row in scored])
    mean = FrameMeans(row.values for row in scored).means()
    clusters = find_clusters([row.pair.group for row in scored], values)
    if request.is_devkit:
        exact = devkit_mean(values[:, : len(request.measures)]).tolist()
        mean |= dict(zip((m.key for m in request.measures), exact, strict=True))
    notes += clusters.notes()
    if len(scored) > 1 and clusters.count < MIN_CLUSTERS:
        notes.append(
            f"no interval: {clusters.describe()} are too few to tell how sure the means are;"
            f" {MIN_CLUSTERS} are needed"
        )
    return Evaluation(
        request=request,
        frames=tuple(rows),
        measures=measures,
        mean=mean,
        interval=_intervals(measures, values, clusters),
        clusters=clusters,
        notes=(
            *notes,
            *_reading_notes(rows),
            *_unscored(rows),
            *_ground_truth(rows),
            *_empty_pixels(scored, request),
            *_scales(scored, request),
            *_given_points(scored, request),
        ),
    )


def _intervals(
    measures: Sequence[Measure], values: NDArray[np.float64], clusters: Clusters
) -> dict[str, tuple[float, float]] | None:
    """The ends of the interval of each mean within what the measure can be."""
    if clusters.count < MIN_CLUSTERS:
        return None
    low, high = interval(lambda means: means, [values], clusters)
    highest = [1.0 if measure.percent else math.inf for measure in measures]
    ends = zip(np.maximum(low, 0.0).tolist(), np.minimum(high, highest).tolist(), strict=True)
    return dict(zip((measure.key for measure in measures), ends, strict=True))


def readings_of(rows: Sequence[FrameScores], side: str) -> list[tuple[Reading, int]]:
    """Returns how the files "prediction" or "gt" were read with their number, frequent first."""
    return Counter(row.readings[side] for row in rows if side in row.readings).most_common()


def _reading_notes(rows: Sequence[FrameScores]) -> list[str]:
    """A line for the predictions, and one for the ground truth."""
    lines = []
    for side, option in _OPTIONS.items():
        texts = [
            reading.source
            + (f"; {option} to change" if reading.assumed else "")
            + (f" ({count:,} of {len(rows):,})" if count < len(rows) else "")
            for reading, count in readings_of(rows, side)
        ]
        if texts:
            lines.append(f"{side}: {some_names(texts)}")
    return lines


def _unscored(rows: Sequence[FrameScores]) -> Iterator[str]:
    """Frames that are in no mean."""
    if missing := [row.name for row in rows if row.missing]:
        yield f"warning: {len(missing):,} frames have no prediction: {some_names(missing)}"
    if faulty := [row for row in rows if not row.scored and not row.missing]:
        for row in faulty[:_LISTED]:
            yield f"warning: frame {one_line(row.name)} was not scored: {row.error}"
        if (more := len(faulty) - _LISTED) > 0:
            yield f"warning: {more:,} more frames were not scored"


def _ground_truth(rows: Sequence[FrameScores]) -> Iterator[str]:
    """What was made of ground truth that is none."""
    noted = [row for row in rows if row.notes]
    for row in noted[:_LISTED]:
        yield from (f"frame {one_line(row.name)}: {note}" for note in row.notes)
    if (more := len(noted) - _LISTED) > 0:
        yield f"{more:,} more frames have such ground truth"


def _empty_pixels(scored: Sequence[FrameScores], request: EvalRequest) -> Iterator[str]:
    """Pixels of the ground truth without prediction."""
    known = sum(row.known for row in scored)
    treatment = "lowers the coverage and is in no error"
    if request.rules.missing == "min":
        treatment = f"is scored as {request.rules.min_depth:g} m"
    elif request.is_devkit:
        treatment = "was filled in from its neighbours before scoring"
    if empty := known - sum(row.predicted for row in scored):
        yield (
            f"warning: {empty:,} pixels ({empty / known:.2%}) of the ground truth have no"
            f" prediction; what is missing {treatment}"
        )
    if holes := [row.name for row in scored if math.isnan(row.values.get("log_mae", 0.0))]:
        yield (
            f"warning: {len(holes):,} predictions have empty rows between filled ones, which the"
            f" development kit sets to −1 m and scores (its logarithmic errors are then NaN):"
            f" {some_names(holes)}"
        )


def _scales(scored: Sequence[FrameScores], request: EvalRequest) -> Iterator[str]:
    """How predictions were scaled, and what looks like a wrong scale.

    Raises:
        InputError: If a scale that was assumed is wrong by a factor between those in use.
    """
    if factors := [row.fit.factor for row in scored if row.fit is not None]:
        median = float(np.median(factors))
        spread = float(np.std(np.array(factors) / median)) if median else math.nan
        yield (
            f"scale-by {request.scale_by}: factor {median:.4g} (median of {len(factors):,}"
            f" images), standard deviation / median {spread:.3f}"
        )
    elif unscaled := [row for row in scored if row.pair.unit != METRES]:
        yield (
            f"warning: {len(unscaled):,} predictions are in {unscaled[0].pair.unit}, not in metres,"
            " so errors against the ground truth show nothing; --scale-by median scales each image"
        )
    ratios = [row.ratio for row in scored if math.isfinite(row.ratio)] or [math.nan]
    by_option = {
        option: next((reading for reading, _ in readings_of(scored, side)), None)
        for side, option in _OPTIONS.items()
    }
    if warning := scale_warning("predictions", float(np.median(ratios)), by_option):
        yield warning


def _given_points(scored: Sequence[FrameScores], request: EvalRequest) -> Iterator[str]:
    """Scored pixels at which the network was given a depth."""
    given = sum(row.given or 0 for row in scored)
    if given and not request.rules.exclude_sparse:
        fraction = given / sum(row.pixels for row in scored if row.given is not None)
        yield (
            f"{given:,} of the scored pixels ({fraction:.2%}) have a point of the sparse input;"
            " --exclude-sparse leaves them out"
        )
