"""`pnpdepth eval`: scores depth files against ground truth by a protocol."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.frame_pairs import pair_frames
from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_mean
from pnpdepth_cli.commands.evaluation.scoring import FILES, score_frame, scores_of
from pnpdepth_cli.commands.requests.eval_request import WITHOUT_SPARSE, EvalRequest
from pnpdepth_cli.commands.shared.pipeline import THREADS, in_order
from pnpdepth_cli.commands.shared.results import ResultFrame
from pnpdepth_cli.commands.shared.statistics import MIN_CLUSTERS, Clusters, find_clusters, interval
from pnpdepth_cli.commands.shared.tables import Table, count_of, some_names
from pnpdepth_cli.completion.two_depths import Agreement
from pnpdepth_cli.dataset.agreement import unit_warning
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.dataset.result_record import versions
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import one_line, plain
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.measures import COVERAGE, OF_SIGMA, Measure, choose_measures, frame_means
from pnpdepth_cli.points import METRES

_LISTED = 3
"""Frames that are named of those with one kind of note."""
_COUNTS = ("pixels", "known", COVERAGE.key, "given", "median_ratio", "factor", "shift")
"""What a row of CSV has beside the measures, as `score_frame` gives it."""
_OPTIONS = {"prediction": "--pred-scale", "gt": "--gt-scale"}
"""The option that states the scale of a file, by the file's name in `FILES`."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scored frames and their means."""

    request: EvalRequest
    frames: list[FrameRecord]
    """The record of each frame of the ground truth, in its order, with scores or why it failed."""
    counts: dict[str, float]
    """Number of frames, and of those in the means; number of pixels that are scored in these, and
    the fraction of their ground truth that has a prediction."""
    measures: tuple[Measure, ...]
    """Measures of the request, and of the standard deviation where a frame has one."""
    shown: tuple[Measure, ...]
    """Measures of the tables."""
    mean: dict[str, float | None]
    """Mean of each measure; None where no frame has it."""
    interval: dict[str, tuple[float, float]] | None
    """The ends of the 95 % interval of each mean; None with too few independent frames."""
    clusters: Clusters
    """The sets of frames that count as independent."""
    notes: list[str]
    """Lines for a person; a warning begins with "warning"."""

    def to_json(self) -> dict[str, object]:
        """Returns what `--json` prints and `pnpdepth compare` reads; NaN and infinity are None."""
        request = self.request
        return {
            "command": "eval",
            "versions": versions(),
            "prediction": str(request.prediction),
            "truth": str(request.ground_truth),
            "protocol": request.protocol,
            "scoring": request.scoring,
            "measures": [measure.to_json() for measure in self.measures],
            "counts": plain(self.counts),
            "mean": plain(self.mean),
            "interval": plain(self.interval),
            "clusters": self.clusters.to_json(),
            "frames": [frame.to_json() for frame in self.frames],
            "notes": self.notes,
        }


def evaluate(
    request: EvalRequest, *, on_frame: Callable[[int, int], None] = lambda done, of: None
) -> Evaluation:
    """Returns the scores of all frames of the ground truth, and their means.

    A frame that cannot be scored has a record that says why. Frames are read a few at a time, so
    memory does not grow with their number.

    Args:
        request: Files to score, and the protocol.
        on_frame: Callback with (done, of) after each frame.

    Raises:
        PnpDepthError: For what concerns all frames, or if none could be scored.
    """
    # Every frame is scored, or has a record that says why it is not.
    pairs, notes = pair_frames(request.prediction, request.ground_truth, request.rules.part)

    def score(pair: tuple[FrameFiles, ResultFrame | None]) -> FrameRecord:
        """The record of a frame with its prediction, if it has one."""
        files, result = pair
        return score_frame(files, result, request)

    records: list[FrameRecord] = []
    for record in in_order(score, pairs, THREADS):
        records.append(record)
        on_frame(len(records), len(pairs))
    scored = [record for record in records if record.status == "done"]
    if not scored:
        raise InputError(f"no frame could be scored; the first: {records[0].message}")
    # Means of what any of them has.
    all_measures = (*request.measures, *OF_SIGMA)
    means = _means_of(scored, all_measures, request)
    shown = means.measures
    if request.columns is not None:
        shown = choose_measures(all_measures, request.columns)
    notes += [*means.notes, *_notes_on_files(records), *_notes_on_depths(scored, request)]
    return Evaluation(
        request=request,
        frames=records,
        counts={
            "frames": len(records),
            "scored": len(scored),
            "pixels": sum(_numbers(scored, "pixels")),
            "coverage": sum(_numbers(scored, "predicted")) / sum(_numbers(scored, "known")),
        },
        measures=means.measures,
        shown=shown,
        mean=means.mean,
        interval=means.interval or None,
        clusters=means.clusters,
        notes=notes,
    )


class _Means(NamedTuple):
    """Means over frames, and how sure they are."""

    measures: tuple[Measure, ...]
    """What any of the frames was measured by."""
    mean: dict[str, float | None]
    """Mean of each measure by its key; None where no frame has a number."""
    interval: dict[str, tuple[float, float]]
    """The ends of the 95 % interval of each mean; empty with too few frames."""
    clusters: Clusters
    """The sets of frames that count as independent."""
    notes: list[str]
    """Lines for a person."""


def _means_of(
    scored: Sequence[FrameRecord], all_measures: Sequence[Measure], request: EvalRequest
) -> _Means:
    """The means over frames that were scored, their intervals, and notes on these.

    Args:
        scored: Records of frames with scores, at least one.
        all_measures: Measures in the order of tables; one that no frame has is left out.
        request: The rules, which say whether means are those of KITTI's development kit.
    """
    # The values (frames, measures), NaN where a frame has none.
    scores = [scores_of(record) for record in scored]
    measures = tuple(
        measure for measure in all_measures if any(measure.key in of_frame for of_frame in scores)
    )
    measured = [
        {measure.key: of_frame.get(measure.key) for measure in measures} for of_frame in scores
    ]
    values = np.array([[*of_frame.values()] for of_frame in measured], float)
    # Their means. Those of the kit's measures, which come first, are rounded as the kit does.
    mean = frame_means(measured)
    if request.is_devkit:
        count = len(request.measures)
        keys = [measure.key for measure in measures[:count]]
        mean |= dict(zip(keys, devkit_mean(values[:, :count]).tolist(), strict=True))
    # The intervals of the means, from the sets of frames that count as independent.
    clusters = find_clusters([record.group or "" for record in scored], values)
    ends = _intervals(measures, values, clusters)
    notes = [*clusters.notes()]
    if len(scored) > 1 and not ends:
        notes.append(
            f"no interval: {clusters.text} are too few to tell how sure the means are;"
            f" {MIN_CLUSTERS} are needed"
        )
    return _Means(measures, mean, ends, clusters, notes)


def _intervals(
    measures: Sequence[Measure], values: NDArray[np.float64], clusters: Clusters
) -> dict[str, tuple[float, float]]:
    """The ends of the 95 % interval of each mean, by key; empty with too few clusters.

    Args:
        measures: M measures.
        values: (N, M) their values in N frames.
        clusters: Sets of the frames that count as independent.
    """
    ends = dict[str, tuple[float, float]]()
    if clusters.count < MIN_CLUSTERS:
        return ends
    for measure, column in zip(measures, values.T, strict=True):
        low, high = interval(lambda mean: mean, [column], clusters)  # of the mean itself
        # No error is below 0, and no fraction above 1.
        highest = 1.0 if measure.percent else math.inf
        ends[measure.key] = max(low, 0.0), min(high, highest)
    return ends


def _readings(records: Sequence[FrameRecord], side: str) -> list[tuple[Reading, int]]:
    """The ways in which a file of the frames was read, each with its number of frames.

    A way is the format and the scale of integers; the most frequent one comes first.

    Args:
        records: Records of the frames.
        side: Name of the file in `FILES`: "prediction" or "gt".
    """
    files = (record.inputs[side] for record in records if side in record.inputs)
    readings = (
        Reading(file.read_as, file.scale, file.assumed)
        for file in files
        if file.read_as is not None
    )
    return Counter(readings).most_common()


def _numbers(records: Sequence[FrameRecord], key: str) -> list[float]:
    """The scores with this key, of the frames that have one."""
    values = [scores_of(record).get(key) for record in records]
    return [value for value in values if value is not None]


def _notes_on_files(records: Sequence[FrameRecord]) -> Iterator[str]:
    """Yields how files were read, which frames were not scored, and notes on single frames."""
    for side, option in _OPTIONS.items():
        texts = []
        for reading, count in _readings(records, side):
            text = reading.source
            if reading.assumed:
                text += f"; {option} to change"
            if count < len(records):
                text += f" ({count:,} of {len(records):,})"
            texts.append(text)
        yield f"{side}: {some_names(texts)}"
    # Frames that are in no mean, then notes on single frames; a few lines of either.
    failed = [
        f"warning: frame {one_line(record.name)} was not scored: {record.message}"
        for record in records
        if record.status == "failed"
    ]
    noted = [
        f"frame {one_line(record.name)}: {note}" for record in records for note in record.notes
    ]
    for lines in (failed, noted):
        yield from lines[:_LISTED]
        more = len(lines) - _LISTED
        if more > 0:
            yield f"{count_of(more, 'more frame')} like that; --csv or --json has all"


def _notes_on_depths(scored: Sequence[FrameRecord], request: EvalRequest) -> Iterator[str]:
    """Yields lines on pixels without prediction, on pixels given to the network, and on scales.

    Args:
        scored: Records of the frames with scores.
        request: The rules.
    """
    # Pixels without prediction, and pixels whose depth the network was given.
    with_truth = sum(_numbers(scored, "known"))
    empty = with_truth - sum(_numbers(scored, "predicted"))
    if empty:
        yield (
            f"warning: {count_of(empty, 'pixel')} ({empty / with_truth:.2%}) of the ground truth"
            " without prediction"
        )
    with_point = sum(_numbers(scored, "given"))
    if with_point and not request.rules.exclude_sparse:
        yield (
            f"{with_point:,} of the scored pixels have a point of the sparse input;"
            " --exclude-sparse leaves them out"
        )
    # How predictions were scaled, or that they should be.
    other_units = [record.unit for record in scored if record.unit != METRES]
    factors = _numbers(scored, "factor")
    if factors:
        median = float(np.median(factors))
        spread = float(np.std(np.array(factors) / median)) if median else math.nan
        yield (
            f"scale-by {request.scale_by}: factor {median:.4g} (median of {len(factors):,} images),"
            f" standard deviation / median {spread:.3f}"
        )
    elif other_units:
        yield (
            f"warning: {count_of(len(other_units), 'prediction')} in {other_units[0]}, not in"
            " metres, so errors against the ground truth show nothing; --scale-by median scales"
            " each image"
        )
    yield from _notes_on_order(scored, request)


def _notes_on_order(scored: Sequence[FrameRecord], request: EvalRequest) -> Iterator[str]:
    """Yields a warning if predictions seem to be disparity where depth is read, or in another unit.

    Args:
        scored: Records of the frames with scores.
        request: The rules, which say whether disparity is fitted.
    """
    agreement = _agreement_of(scored)
    in_disparity = request.scale_by == "affine-disparity"
    if agreement.is_reversed and not in_disparity:
        yield (
            "warning: larger predictions are nearer in the ground truth (rank correlation"
            f" {agreement.rank:.2f}, median of the images): disparity or 1/depth? --scale-by"
            " affine-disparity fits disparity, --gt-kind reads it as ground truth"
        )
        return  # of disparity, the ratio to depth tells nothing
    if in_disparity and agreement.is_ordered:
        yield (
            "warning: larger predictions are farther in the ground truth (rank correlation"
            f" {agreement.rank:.2f}, median of the images), as of depth; --scale-by affine fits"
            " depth"
        )
    # The way in which most files were read, by the option that changes it.
    by_option = {option: _readings(scored, side)[0][0] for side, option in _OPTIONS.items()}
    warning = unit_warning("predictions", agreement, by_option, fitted=True)
    if warning:
        yield warning


def _agreement_of(scored: Sequence[FrameRecord]) -> Agreement:
    """How predictions and ground truth agree, over all images; no pairs if no image tells."""
    ratios = _numbers(scored, "median_ratio")
    if not ratios:
        return Agreement(pairs=0, rank=0.0, ratio=math.nan, spread=math.nan)
    # The spread within an image, and that of the images' ratios, add up as independent ones do.
    within = float(np.median(_numbers(scored, "ratio_spread")))
    between = float(np.std(np.log(ratios)))
    return Agreement(
        pairs=int(sum(_numbers(scored, "pixels"))),
        rank=float(np.median(_numbers(scored, "rank_correlation"))),
        ratio=float(np.median(ratios)),
        spread=math.hypot(within, between),
    )


def means_table(evaluation: Evaluation) -> Table:
    """Returns a row for each measure: its mean and the interval of it."""
    # What the means are over.
    intervals = evaluation.interval
    counts = evaluation.counts
    frames = count_of(counts["frames"], "frame")
    if counts["scored"] < counts["frames"]:
        frames = f"{counts['scored']:,} of {frames}"
    title = f"Means and coverage over {frames}, {count_of(counts['pixels'], 'pixel')}"
    columns = ["", "mean"]
    if intervals is not None:
        columns.append("95 %")
        title += f"; 95 % interval over {evaluation.clusters.text}"
    if evaluation.request.rules.exclude_sparse:
        title += WITHOUT_SPARSE
    # The rows.
    rows = []
    mean = evaluation.mean | {COVERAGE.key: counts["coverage"]}
    for measure in (*evaluation.shown, COVERAGE):
        row = [measure.heading, measure.text(mean.get(measure.key))]
        if intervals is not None:
            ends = intervals.get(measure.key, ())
            row.append(" … ".join(measure.text(end) for end in ends))
        rows.append(row)
    return Table(title=title, columns=columns, rows=rows)


def frames_table(evaluation: Evaluation) -> Table:
    """Returns a row for each frame: its files, its counts, and the measures as stored."""
    rows = []
    for frame in evaluation.frames:
        scores = plain(scores_of(frame))
        row = [frame.name, frame.group]
        for name in FILES:
            file = frame.inputs.get(name)
            row.append(None if file is None else file.path)
        row += [scores.get(key) for key in _COUNTS]
        row += [scores.get(measure.key) for measure in evaluation.shown]
        row.append(frame.message)
        rows.append(row)
    # Counts are headed by their keys. Coverage is given as the measure that it is.
    counts = [COVERAGE if key == COVERAGE.key else key for key in _COUNTS]
    columns = ["name", "group", *FILES, *counts, *evaluation.shown, "error"]
    return Table(columns=columns, rows=rows)
