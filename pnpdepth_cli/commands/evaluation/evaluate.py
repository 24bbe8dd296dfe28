"""`pnpdepth eval`: scores depth files against ground truth by a protocol."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pnpdepth_cli.commands.evaluation.eval_request import (
    WITHOUT_SPARSE,
    EvalRequest,
    scoring_of,
)
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_mean
from pnpdepth_cli.commands.evaluation.pairing import pair_frames, some_names
from pnpdepth_cli.commands.evaluation.scoring import FILES, score_pair, scores_of
from pnpdepth_cli.commands.ordered_pool import THREADS, in_order
from pnpdepth_cli.commands.statistics import MIN_CLUSTERS, Clusters, find_clusters, interval
from pnpdepth_cli.commands.stopwatch import versions
from pnpdepth_cli.commands.tables import Table, count_of
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import scale_warning
from pnpdepth_cli.io.file_bytes import one_line, plain
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.measures import COVERAGE, OF_SIGMA, Measure, frame_means
from pnpdepth_cli.points import METRES

_LISTED = 3
_COUNTS = ("pixels", "known", COVERAGE.key, "given", "median_ratio", "factor", "shift")
_OPTIONS = {"prediction": "--pred-scale", "gt": "--gt-scale"}


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scored frames and their means."""

    request: EvalRequest
    frames: list[FrameRecord]
    """The scores of each frame of the ground truth, in its order."""
    measures: tuple[Measure, ...]
    """Measures of the request, and of the standard deviation where a frame has one."""
    mean: dict[str, float | None]
    """Mean of each measure; None where no frame has it."""
    interval: dict[str, tuple[float, float]] | None
    """The ends of the 95 % interval of each mean; None with too few independent frames."""
    clusters: Clusters
    notes: list[str]

    @property
    def scored(self) -> list[FrameRecord]:
        """The frames that are in the means."""
        return [frame for frame in self.frames if frame.status == "done"]

    @property
    def pixels(self) -> int:
        """Number of scored pixels of all frames in the means."""
        return int(sum(_numbers(self.scored, "pixels")))

    @property
    def coverage(self) -> float:
        """Fraction of the ground truth of the frames in the means that has a prediction."""
        known = sum(_numbers(self.scored, "known"))
        return sum(_numbers(self.scored, "predicted")) / known if known else math.nan

    @property
    def shown(self) -> tuple[Measure, ...]:
        """The measures of tables."""
        return self.measures if self.request.columns is None else self.request.shown

    def to_json(self) -> dict[str, Any]:
        """Returns what `--json` prints and `pnpdepth compare` reads; NaN and infinity are null."""
        # What was scored and how, the results, and the frames.
        request = self.request
        return dict(plain({
            "command": "eval",
            "versions": versions(),
            "prediction": request.prediction,
            "truth": request.ground_truth,
            "protocol": request.protocol,
            "scoring": scoring_of(request.rules, request.scale_by),
            "measures": [measure.to_json() for measure in self.measures],
            "counts": {
                "frames": len(self.frames),
                "scored": len(self.scored),
                "pixels": self.pixels,
                "coverage": self.coverage,
            },
            "mean": self.mean,
            "interval": self.interval,
            "clusters": self.clusters.to_json(),
            "frames": [frame.to_json() for frame in self.frames],
            "notes": self.notes,
        }))  # fmt: skip


def evaluate(
    request: EvalRequest, *, on_frame: Callable[[int, int], None] = lambda done, of: None
) -> Evaluation:
    """Returns a row for each frame of the ground truth, scored or with the reason why not; means.

    Frames are read one after the other, so memory does not grow with their number.

    Args:
        request: Files to score, and the protocol.
        on_frame: Callback with (done, of) after each frame.

    Raises:
        PnpDepthError: For what concerns all frames, or if none could be scored.
    """
    pairs, notes = pair_frames(request.prediction, request.ground_truth, request.rules.part)
    rows: list[FrameRecord] = []
    for row in in_order(lambda pair: score_pair(pair, request), pairs, THREADS):
        rows.append(row)
        on_frame(len(rows), len(pairs))
    scored = [row for row in rows if row.status == "done"]
    if not scored:
        raise InputError(f"no frame could be scored; the first: {rows[0].message}")
    # means, and how sure they are over frames that count as independent
    scores = [scores_of(row) for row in scored]
    of_sigma = [m for m in OF_SIGMA if any(m.key in each for each in scores)]
    measures = (*request.measures, *of_sigma)
    keys = [measure.key for measure in measures]
    values = np.array([[each.get(key) for key in keys] for each in scores], np.float64)
    mean = frame_means({key: each.get(key) for key in keys} for each in scores)
    clusters = find_clusters([row.group or "" for row in scored], values)
    if request.is_devkit:
        exact = devkit_mean(values[:, : len(request.measures)]).tolist()
        mean |= dict(zip(keys, exact, strict=False))
    ends = {}
    for measure, column in zip(measures, values.T, strict=True):
        if clusters.count >= MIN_CLUSTERS:
            low, high = interval(lambda mean: mean, [column], clusters)
            # within what the measure can be
            ends[measure.key] = max(low, 0.0), min(high, 1.0 if measure.percent else math.inf)
    notes += clusters.notes()
    if len(scored) > 1 and not ends:
        notes.append(
            f"no interval: {clusters.text} are too few to tell how sure the means are;"
            f" {MIN_CLUSTERS} are needed"
        )
    notes += _notes_on_files(rows)
    notes += _notes_on_depths(scored, request)
    return Evaluation(
        request=request,
        frames=rows,
        measures=measures,
        mean=mean,
        interval=ends or None,
        clusters=clusters,
        notes=notes,
    )


def _readings(rows: Sequence[FrameRecord], side: str) -> list[tuple[Reading, int]]:
    """How the files "prediction" or "gt" were read with their number, frequent first."""
    files = (row.inputs[side] for row in rows if side in row.inputs)
    readings = (Reading(f.read_as, f.scale, f.assumed) for f in files if f.read_as is not None)
    return Counter(readings).most_common()


def _numbers(rows: Sequence[FrameRecord], key: str) -> list[float]:
    """The values of this key of the frames that have one."""
    return [value for row in rows if (value := scores_of(row).get(key)) is not None]


def _notes_on_files(rows: Sequence[FrameRecord]) -> Iterator[str]:
    """How files were read, and which of them were not scored or changed."""
    for side, option in _OPTIONS.items():
        texts = [
            reading.source
            + (f"; {option} to change" if reading.assumed else "")
            + (f" ({count:,} of {len(rows):,})" if count < len(rows) else "")
            for reading, count in _readings(rows, side)
        ]
        if texts:
            yield f"{side}: {some_names(texts)}"
    # Frames that are in no mean, and what was made of ground truth that is none.
    failed = [
        f"warning: frame {one_line(row.name)} was not scored: {row.message}"
        for row in rows
        if row.status == "failed"
    ]
    noted = [f"frame {one_line(row.name)}: {note}" for row in rows for note in row.notes]
    for lines in (failed, noted):
        yield from lines[:_LISTED]
        if (more := len(lines) - _LISTED) > 0:
            yield f"{count_of(more, 'more frame')} like that; --csv or --json has all"


def _notes_on_depths(scored: Sequence[FrameRecord], request: EvalRequest) -> Iterator[str]:
    """Pixels without prediction or given to the network, and how predictions are scaled."""
    # The pixels.
    known = sum(_numbers(scored, "known"))
    if empty := known - sum(_numbers(scored, "predicted")):
        yield (
            f"warning: {count_of(round(empty), 'pixel')} ({empty / known:.2%}) of the ground truth"
            " without prediction"
        )
    given = round(sum(_numbers(scored, "given")))
    if given and not request.rules.exclude_sparse:
        yield (
            f"{given:,} of the scored pixels have a point of the sparse input; --exclude-sparse"
            " leaves them out"
        )
    # How predictions were scaled, and what looks like a wrong scale.
    if factors := _numbers(scored, "factor"):
        median = float(np.median(factors))
        spread = float(np.std(np.array(factors) / median)) if median else math.nan
        yield (
            f"scale-by {request.scale_by}: factor {median:.4g} (median of {len(factors):,}"
            f" images), standard deviation / median {spread:.3f}"
        )
    elif unscaled := [row.unit for row in scored if row.unit != METRES]:
        yield (
            f"warning: {count_of(len(unscaled), 'prediction')} in {unscaled[0]}, not in metres, so"
            " errors against the ground truth show nothing; --scale-by median scales each image"
        )
    ratios = _numbers(scored, "median_ratio") or [math.nan]
    by_option = {
        option: next((reading for reading, _ in _readings(scored, side)), None)
        for side, option in _OPTIONS.items()
    }
    if warning := scale_warning("predictions", float(np.median(ratios)), by_option):
        yield warning


def means_table(evaluation: Evaluation) -> Table:
    """Returns a row for each measure: its mean and the interval of it."""
    intervals, scored = evaluation.interval, f"{len(evaluation.scored):,} of "
    if len(evaluation.scored) == len(evaluation.frames):
        scored = ""
    title = f"Means and coverage over {scored}{count_of(len(evaluation.frames), 'frame')}"
    title += f", {count_of(evaluation.pixels, 'pixel')}"
    columns = ["", "mean"]
    if intervals is not None:
        columns.append("95 %")
        title += f"; 95 % interval over {evaluation.clusters.text}"
    rows = []
    mean = evaluation.mean | {COVERAGE.key: evaluation.coverage}
    for measure in (*evaluation.shown, COVERAGE):
        ends = [] if intervals is None else [intervals.get(measure.key, ())]
        texts = (" … ".join(map(measure.text, each)) for each in ends)
        rows.append([measure.heading, measure.text(mean.get(measure.key)), *texts])
    title += WITHOUT_SPARSE * evaluation.request.rules.exclude_sparse
    return Table(title=title, columns=columns, rows=rows)


def frames_table(evaluation: Evaluation) -> Table:
    """Returns a row for each frame: its files, its counts, and the measures as stored."""
    rows = []
    for frame in evaluation.frames:
        files, scores = (frame.inputs.get(name) for name in FILES), plain(scores_of(frame))
        row = [frame.name, frame.group, *(file and file.path for file in files)]
        row += map(scores.get, (*_COUNTS, *(measure.key for measure in evaluation.shown)))
        rows.append([*row, frame.message])
    counts = [COVERAGE if name == COVERAGE.key else name for name in _COUNTS]
    columns = ["name", "group", *FILES, *counts, *evaluation.shown, "error"]
    return Table(columns=columns, rows=rows)
