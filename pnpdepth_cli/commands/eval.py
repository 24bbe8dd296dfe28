"""`pnpdepth eval`: scores depth files against ground truth by a protocol."""

from __future__ import annotations

import contextlib
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.kitti_devkit import devkit_mean
from pnpdepth_cli.commands.evaluation.scoring import FILES, score_frame, scores_of
from pnpdepth_cli.commands.requests.eval_request import WITHOUT_SPARSE, EvalRequest
from pnpdepth_cli.commands.shared.pipeline import THREADS, in_order
from pnpdepth_cli.commands.shared.results import ResultFrame, result_frames
from pnpdepth_cli.commands.shared.statistics import MIN_CLUSTERS, Clusters, find_clusters, interval
from pnpdepth_cli.commands.shared.tables import Table, count_of, some_names
from pnpdepth_cli.completion.two_depths import Agreement
from pnpdepth_cli.dataset.agreement import unit_warning
from pnpdepth_cli.dataset.frame_files import FrameFiles, find_files, groups_of, one_of_each
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.dataset.result_record import versions
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES
from pnpdepth_cli.io.file_bytes import one_line, plain, read_json
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.measures import COVERAGE, OF_SIGMA, Measure, choose_measures, frame_means
from pnpdepth_cli.points import METRES
from pnpdepth_cli.protocols import WHOLE, FramePart

_LISTED = 3
"""Frames that are named of those with one kind of note."""
_COUNTS = ("pixels", "known", COVERAGE.key, "given", "median_ratio", "factor", "shift")
"""What a row of CSV has beside the measures, as `score_frame` gives it."""
_OPTIONS = {"prediction": "--pred-scale", "gt": "--gt-scale"}
"""The option that states the scale of a file, by the file's name in `FILES`."""
_MARK = re.compile(r"(?<=.)[_.]depth$", re.DOTALL)
"""The end of the stem of a depth file, as `refine` and others write it."""
_KITTI_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
"""The kind of file, which KITTI's selection names in the middle."""


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
    pairs, notes = _pair_frames(request.prediction, request.ground_truth, request.rules.part)
    records: list[FrameRecord] = []
    for record in in_order(lambda pair: score_frame(*pair, request), pairs, THREADS):
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
    """The means over frames that were scored.

    Args:
        scored: Records of frames with scores, at least one.
        all_measures: Measures, of which those are taken that any frame has.
        request: The rules.
    """
    # The values of each frame (frames, measures), NaN where it has none.
    scores = [scores_of(record) for record in scored]
    measures = tuple(m for m in all_measures if any(m.key in of_frame for of_frame in scores))
    measured = [{m.key: of_frame.get(m.key) for m in measures} for of_frame in scores]
    values = np.array([[*of_frame.values()] for of_frame in measured], float)
    # Their means; the development kit's own ones round as it does.
    mean = frame_means(measured)
    if request.is_devkit:
        count = len(request.measures)
        keys = [measure.key for measure in measures[:count]]
        mean |= dict(zip(keys, devkit_mean(values[:, :count]).tolist(), strict=True))
    # How sure they are over frames that count as independent.
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
        low, high = interval(lambda mean: mean, [column], clusters)
        # No error is below 0, and no fraction above 1.
        highest = 1.0 if measure.percent else math.inf
        ends[measure.key] = max(low, 0.0), min(high, highest)
    return ends


def _pair_frames(
    prediction: Path, ground_truth: Path, part: FramePart | None
) -> tuple[list[tuple[FrameFiles, ResultFrame | None]], list[str]]:
    """The frames of the ground truth in its order, each with its prediction or None, and notes.

    Args:
        prediction: A depth file, or a folder of them.
        ground_truth: A depth file, a folder of them, or a data set of a known layout.
        part: Part of a data set's frames that is scored. None: the data set's own.

    Raises:
        InputError: A path is not there, or no name is common to both.
        UsageError: One is a file and the other a folder.
    """
    # Two files, two folders, or a folder and a data set.
    for path in (prediction, ground_truth):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; check the path")
    layout, frames = _data_set(prediction, ground_truth)
    are_many_true = layout is not None or ground_truth.is_dir()
    if prediction.is_dir() != are_many_true:
        raise UsageError(
            "give two files, two folders, or a folder and a data set, not"
            f" {prediction} and {ground_truth}"
        )
    # The predictions by name, and the frames with ground truth.
    notes = list[str]()
    predictions = _depth_files(prediction)
    if layout is not None:
        frames, note = _frames_with_truth(ground_truth, layout, frames, part)
        notes.append(note)
    elif ground_truth.is_dir():
        frames = [FrameFiles(name=name, gt=gt) for name, gt in _depth_files(ground_truth).items()]
    else:
        frames = [FrameFiles(name=name, gt=ground_truth) for name in predictions]
    # At least one name must be common to both.
    names = [frame.name for frame in frames]
    notes += _notes_on_names(predictions, names)
    groups = groups_of(names, [frame.group for frame in frames])
    pairs = [
        _pair(replace(frame, group=group), predictions.get(frame.name))
        for frame, group in zip(frames, groups, strict=True)
    ]
    return pairs, notes


def _frames_with_truth(
    folder: Path, layout: str, frames: Sequence[FrameFiles], part: FramePart | None
) -> tuple[list[FrameFiles], str]:
    """The frames of a data set that have ground truth, in the part that is scored, and a line.

    Args:
        folder: The data set.
        layout: Name of its layout.
        frames: Its frames.
        part: Part of each frame that is scored. None: its own.

    Raises:
        InputError: No frame has ground truth.
    """
    with_truth = [
        replace(frame, part=part or frame.part) for frame in frames if frame.gt is not None
    ]
    if not with_truth:
        raise InputError(f"{folder} looks like {layout!r}, without ground truth; give its folder")
    parts = ", ".join(sorted({str(frame.part) for frame in with_truth if frame.part != WHOLE}))
    note = f"gt: layout {layout}; frames with ground truth: {len(with_truth):,}"
    if parts:
        note += f", of which {parts} is used"
    return with_truth, note


def _notes_on_names(predictions: Mapping[str, Path], names: Sequence[str]) -> list[str]:
    """A warning if predictions have no ground truth of their name.

    Args:
        predictions: Depth files by the name of their frame.
        names: Names of the frames with ground truth.

    Raises:
        InputError: None has.
    """
    extra = sorted(predictions.keys() - {*names})
    if len(extra) == len(predictions):
        raise InputError(
            "no prediction has the name of a ground truth file: predictions are"
            f" {some_names(predictions)}; ground truth is {some_names(sorted(names))}; name both"
            " alike"
        )
    if not extra:
        return []
    return [
        f"warning: {len(extra):,} of {len(predictions):,} predictions have no ground truth and"
        f" are not scored: {some_names(extra)}"
    ]


def _data_set(prediction: Path, folder: Path) -> tuple[str | None, list[FrameFiles]]:
    """The layout and the frames of a data set; None and no frames for another folder.

    Args:
        prediction: The predictions, which a batch may have refined from the data set.
        folder: What may be a data set.
    """
    # As the batch read it, whose summary lies beside the predictions; else recognised anew.
    summary = prediction / "summary.json"
    layout_of_batch = read_json(summary).get("layout") if summary.is_file() else None
    layouts = [layout_of_batch, None] if layout_of_batch in LAYOUTS else [None]
    for layout in layouts:
        # What is no data set may still be a folder of depth files.
        with contextlib.suppress(InputError, OSError):
            listed = list_frames(folder, layout)
            return listed.layout, listed.frames
    return None, []


def _pair(files: FrameFiles, prediction: Path | None) -> tuple[FrameFiles, ResultFrame | None]:
    """The frame and its prediction, with what the prediction's record says of the frame's files.

    That is the sparse depth and the image that were used. A prediction whose record is damaged is
    scored as one without a record.

    Args:
        files: The files of the frame.
        prediction: The depth file. None: there is none, which is returned.
    """
    if files.sparse is not None and files.sparse.suffix.lower() not in DEPTH_SUFFIXES:
        files = replace(files, sparse=None)  # a scan, whose pixels are not known without a camera
    if prediction is None:
        return files, None
    try:
        (result,) = result_frames(prediction)
    except PnpDepthError:
        return files, ResultFrame(name=files.name, depth=prediction)
    sparse = result.record.inputs.get("sparse")
    if sparse is not None and sparse.kind == "depth":
        path = Path(sparse.path)
        files = replace(files, sparse=path if path.is_file() else files.sparse)
    return replace(files, image=result.image or files.image), result


def _frame_name(stem: str) -> str:
    """The frame of a file with this stem: without `_depth` and KITTI's file kind."""
    return _MARK.sub("", _KITTI_KIND.sub("_sync_", stem))


def _depth_files(path: Path) -> dict[str, Path]:
    """The depth files of a folder by their frame, sorted, or the one that the path is.

    In a folder with files `x_depth`, all others are no depth.

    Raises:
        InputError: There is none, two are of one frame, or a folder inside cannot be read.
    """
    if not path.is_dir():
        return {_frame_name(path.stem): path}
    by_stem, problems = find_files(path, DEPTH_SUFFIXES)
    marked = {stem: file for stem, file in by_stem.items() if _MARK.search(stem)}
    files, ambiguous = one_of_each(
        (_frame_name(stem), file) for stem, file in (marked or by_stem).items()
    )
    if lost := [*problems, *ambiguous]:
        file, why = lost[0]
        raise InputError(f"{file} {why}")
    if not files:
        raise InputError(f"{path} holds no depth file ({' '.join(DEPTH_SUFFIXES)}); check the path")
    return dict(sorted(files.items()))


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
    # Frames that are in no mean, and what was made of ground truth that is none.
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
        if (more := len(lines) - _LISTED) > 0:
            yield f"{count_of(more, 'more frame')} like that; --csv or --json has all"


def _notes_on_depths(scored: Sequence[FrameRecord], request: EvalRequest) -> Iterator[str]:
    """Yields lines on pixels without prediction or given to the network, and on scales."""
    known = sum(_numbers(scored, "known"))
    empty = known - sum(_numbers(scored, "predicted"))
    if empty:
        yield (
            f"warning: {count_of(empty, 'pixel')} ({empty / known:.2%}) of the ground truth without"
            " prediction"
        )
    given = sum(_numbers(scored, "given"))
    if given and not request.rules.exclude_sparse:
        yield (
            f"{given:,} of the scored pixels have a point of the sparse input; --exclude-sparse"
            " leaves them out"
        )
    # How predictions were scaled, or that they should be.
    not_in_metres = [record.unit for record in scored if record.unit != METRES]
    if factors := _numbers(scored, "factor"):
        median = float(np.median(factors))
        spread = float(np.std(np.array(factors) / median)) if median else math.nan
        yield (
            f"scale-by {request.scale_by}: factor {median:.4g} (median of {len(factors):,} images),"
            f" standard deviation / median {spread:.3f}"
        )
    elif not_in_metres:
        yield (
            f"warning: {count_of(len(not_in_metres), 'prediction')} in {not_in_metres[0]}, not in"
            " metres, so errors against the ground truth show nothing; --scale-by median scales"
            " each image"
        )
    yield from _notes_on_order(scored, request)


def _notes_on_order(scored: Sequence[FrameRecord], request: EvalRequest) -> Iterator[str]:
    """Yields a warning if predictions look like depth and are disparity, or have another unit."""
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
    if warning := unit_warning("predictions", agreement, by_option, fitted=True):
        yield warning


def _agreement_of(scored: Sequence[FrameRecord]) -> Agreement:
    """How predictions and ground truth agree, over all images."""
    ratios = _numbers(scored, "median_ratio")
    if not ratios:
        return Agreement(0, 0.0, math.nan, math.nan)
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
    counts = [COVERAGE if key == COVERAGE.key else key for key in _COUNTS]
    columns = ["name", "group", *FILES, *counts, *evaluation.shown, "error"]
    return Table(columns=columns, rows=rows)
