"""`pnpdepth eval --html`: each frame's prediction, its ground truth, and a map of its errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError, PnpDepthError
from pnpdepth_cli.io.colours import depth_scale, grey_of
from pnpdepth_cli.io.dataset.hdf5 import rgb_of
from pnpdepth_cli.io.layouts import Hdf5Array
from pnpdepth_cli.io.report import (
    begin_report,
    check_report_folder,
    image_key,
    whole_report,
    write_report,
)
from pnpdepth_cli.io.report_images import error_colours, error_map, save_images
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.pipeline.evaluation.frame_reading import Depth, load_frame
from pnpdepth_cli.pipeline.evaluation.frame_scoring import FrameScores
from pnpdepth_cli.pipeline.evaluation.kitti_devkit import fill_background
from pnpdepth_cli.pipeline.evaluation.pairing import FramePair
from pnpdepth_cli.pipeline.evaluation.result import ErrorBin, Evaluation
from pnpdepth_cli.pipeline.evaluation.score_files import (
    bin_rows,
    column_title,
    format_value,
    interval_text,
)
from pnpdepth_cli.pipeline.ordered_pool import in_order
from pnpdepth_cli.pipeline.report.columns import (
    Column,
    column_of,
    figures,
    frames_text,
    table,
    tile,
)

_SOURCE = {"command": "eval"}
_LISTED = ("rmse", "mae", "mre", "irmse", "delta1")


def check_eval_report(folder: Path, inputs: list[Path], *, overwrite: bool) -> None:
    """Raises OutputError for a folder that the report cannot or may not be written to."""
    check_report_folder(folder, inputs, made_of=None, overwrite=overwrite)


def write_eval_report(
    folder: Path,
    evaluation: Evaluation,
    *,
    on_frame: Callable[[int, int], None] = lambda done, of: None,
) -> None:
    """Writes the report; the files are read once more for its images.

    Args:
        folder: Where the page and its images are written.
        evaluation: The scores.
        on_frame: Called with (done, of) after each frame.

    Raises:
        OutputError: If the report cannot be written; then the folder is as it was before.
    """
    columns = _columns(evaluation)
    scored = evaluation.scored

    def entries(images: Path) -> Iterator[dict[str, Any]]:
        drawn = in_order(
            lambda frame: _entry(frame, evaluation, columns, images),
            scored,
            evaluation.request.workers,
        )
        for done, entry in enumerate(drawn, start=1):
            yield entry
            on_frame(done, len(scored))

    with whole_report(folder) as temporary:
        images = begin_report(temporary, _SOURCE)
        write_report(temporary, _head(evaluation, columns), entries(images))


def _columns(evaluation: Evaluation) -> list[Column]:
    measures = evaluation.protocol.measures
    keys = {measure.key for measure in measures}
    listed = _LISTED if keys.issuperset(_LISTED) else tuple(keys)
    return [
        *(column_of(measure, listed=measure.key in listed) for measure in measures),
        Column(key="coverage", title="Coverage", percent=True, decimals=2, higher_is_better=True),
    ]


def _head(evaluation: Evaluation, columns: list[Column]) -> dict[str, Any]:
    request = evaluation.request
    without = [frame for frame in evaluation.frames if not frame.scored]
    filled = " (filled in)" if evaluation.protocol.is_devkit else ""
    return {
        "kind": "Depth evaluation",
        "title": str(request.prediction),
        "tiles": _tiles(evaluation),
        "facts": [
            ["Prediction", str(request.prediction)],
            ["Ground truth", str(request.ground_truth)],
            *([["Sparse depth", str(request.sparse)]] if request.sparse else []),
            ["Protocol", evaluation.protocol.describe()],
            ["Pixels scored", f"{sum(frame.pixels for frame in evaluation.frames):,}"],
        ],
        "notes": list(evaluation.notes),
        "tables": [
            _means(evaluation),
            *_uncertainty(evaluation),
            *_bins("By distance to the nearest sparse point", "px", evaluation.by_distance),
            *_bins("By depth of the ground truth", "m", evaluation.by_depth),
        ],
        "charts": _charts(evaluation),
        "labels": {
            "first": f"Prediction{filled}", "second": "Ground truth", "map": "Error",
            "image": "Image",
        },
        "map_colours": error_colours(),
        "without_title": f"Not scored: {len(without):,}",
        "without": [{"name": frame.name, "reason": frame.error} for frame in without],
        **figures(columns, "rmse"),
    }  # fmt: skip


def _tiles(evaluation: Evaluation) -> list[dict[str, str]]:
    frames, scored = len(evaluation.frames), len(evaluation.scored)
    unscored = [
        f"{len(some):,} {reason}"
        for some, reason in (
            (evaluation.missing, "without prediction"),
            (evaluation.failed, "with a faulty file"),
        )
        if some
    ]
    means = [
        tile(measure.title, f"{format_value(measure, evaluation.mean[measure.key], unit=True)}")
        for measure in evaluation.protocol.measures
        if measure.key in ("rmse", "mae", "delta1")
    ]
    coverage = tile(
        "Coverage", f"{evaluation.coverage:.2%}", "of the ground truth has a prediction"
    )
    of = f"{scored:,} of {frames:,}" if scored != frames else f"{frames:,}"
    return [tile("Frames scored", of, ", ".join(unscored)), *means, coverage]


def _means(evaluation: Evaluation) -> dict[str, Any]:
    measures, interval = evaluation.protocol.measures, evaluation.interval
    header, rows = ["", "mean"], []
    for measure in measures:
        rows.append([column_title(measure), format_value(measure, evaluation.mean[measure.key])])
        if interval is not None:
            rows[-1].append(interval_text(evaluation, measure))
    of = frames_text(len(evaluation.scored))
    caption = f"Means over {of}"
    if evaluation.protocol.average == "pooled":
        caption = f"Over all pixels of {of} together"
    if interval is not None:
        header.append("95 %")
        caption += f"; {evaluation.describe_interval()}"
    return table(caption, header, rows)


def _uncertainty(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Calibration and sparsification of the predicted standard deviation, if there is one."""
    uncertainty = evaluation.uncertainty
    if uncertainty is None:
        return []
    calibration = [
        [f"{expected:.1%}", f"{observed:.1%}"]
        for expected, observed in zip(uncertainty.expected, uncertainty.observed, strict=True)
    ]
    sparsification = [
        [f"{removed:.0%}", f"{error:.4f}", f"{best:.4f}"]
        for removed, error, best in zip(
            uncertainty.removed, uncertainty.sparsification, uncertainty.oracle, strict=True
        )
    ]
    frames = frames_text(uncertainty.frames)
    return [
        table(
            f"Calibration of the standard deviation, {frames}: {uncertainty.within_1_sigma:.1%}"
            f" within 1σ, {uncertainty.within_2_sigma:.1%} within 2σ",
            ["normal distribution", "observed"],
            calibration,
        ),
        table(
            f"Sparsification, {frames}: AUSE {uncertainty.ause:.4f} of the MAE",
            ["removed", "MAE by σ [m]", "MAE by error [m]"],
            sparsification,
        ),
    ]


def _charts(evaluation: Evaluation) -> list[dict[str, Any]]:
    """The calibration plot and the sparsification curve of the predicted standard deviation."""
    uncertainty = evaluation.uncertainty
    if uncertainty is None:
        return []
    frames = frames_text(uncertainty.frames)
    observed = _line("observed", uncertainty.expected, uncertainty.observed)
    charts = [
        _chart(
            f"Calibration, {frames}",
            ("errors within the interval if normal", "observed"),
            [observed, _line("normal", (0, 1), (0, 1), dashed=True)],
        )
    ]
    whole = uncertainty.sparsification[0]
    if whole:
        curves = (
            [value / whole for value in curve]
            for curve in (uncertainty.sparsification, uncertainty.oracle)
        )
        by_sigma, by_error = curves
        charts.append(
            _chart(
                f"Sparsification, {frames}: AUSE {uncertainty.ause:.4f}",
                ("pixels removed", "MAE of the others"),
                [
                    _line("by σ", uncertainty.removed, by_sigma),
                    _line("by error (oracle)", uncertainty.removed, by_error, dashed=True),
                ],
            )
        )
    return charts


def _chart(caption: str, titles: tuple[str, str], lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Lines over fractions from 0 to 1, upwards to 1 or to the highest value."""
    top = max(1.0, *(y for line in lines for _, y in line["points"]))
    x_title, y_title = titles
    return {
        "caption": caption, "x_title": x_title, "y_title": y_title, "top": top, "lines": lines,
    }  # fmt: skip


def _line(
    label: str, x: Sequence[float], y: Sequence[float], *, dashed: bool = False
) -> dict[str, Any]:
    return {"label": label, "points": list(zip(x, y, strict=True)), "dashed": dashed}


def _bins(caption: str, unit: str, bins: tuple[ErrorBin, ...]) -> list[dict[str, Any]]:
    if not bins:
        return []
    header = [f"[{unit}]", "of the ground truth", "RMSE [m]", "MAE [m]", "MRE", "coverage"]
    return [table(f"{caption}, all pixels together", header, bin_rows(bins))]


def _entry(
    frame: FrameScores, evaluation: Evaluation, columns: list[Column], images: Path
) -> dict[str, Any]:
    values = frame.values | {"coverage": frame.coverage}
    notes = [f"Scored: {frame.pixels:,} of {frame.known:,} pixels of the ground truth."]
    if frame.leaked:
        notes.append(f"{frame.leaked:,} of them were given to the network as sparse depth.")
    notes.append(f"Prediction: {frame.pair.prediction}")
    notes.append(f"Ground truth: {frame.pair.frame.gt}")
    try:
        drawn = _drawn(frame, evaluation, images)
    except InputError as error:  # the file has changed since it was scored
        notes.append(str(error))
        drawn = {"key": None}
    return {
        "name": frame.name,
        "values": [values.get(column.key) for column in columns],
        "notes": notes,
        "tag": "",
        **drawn,
    }


def _drawn(frame: FrameScores, evaluation: Evaluation, images: Path) -> dict[str, Any]:
    """Writes the images of a frame and returns the page's entry of them."""
    protocol = evaluation.protocol
    loaded = load_frame(frame.pair, protocol, evaluation.request.scales)
    gt = loaded.ground_truth.values
    if loaded.prediction is None:
        return {"key": None}
    depth = loaded.prediction.values
    if protocol.is_devkit:
        depth = np.maximum(fill_background(depth), np.float32(0))
    image = _image(frame.pair, gt)
    errors = error_map(depth, gt, None if image is None else grey_of(image))
    scale = depth_scale(depth, gt)
    views = {"first": scale.paint(depth), "second": scale.paint(gt), "map": errors.pixels}
    if image is not None:
        views["image"] = np.asarray(np.rint(255 * np.clip(image, 0, 1)), np.uint8)
    key = image_key(frame.name)
    save_images(images, key, views, thumb="first" if image is None else "image")
    amount = f"by {errors.strongest_m:.3g} m or more"
    return {
        "key": key,
        "views": list(views),
        "scale_m": [scale.low_m, scale.high_m],
        "map": {
            "ends": [f"too near {amount}", f"too far {amount}"],
            "unknown": None if ((gt > 0) & (depth > 0)).all() else "not scored",
            "footer": "prediction against ground truth",
        },
    }


def _image(pair: FramePair, gt: Depth) -> NDArray[np.float32] | None:
    """The frame's image (H, W, 3) in 0…1, if one is known, can be read and fits the depth."""
    if pair.image is None:
        return None
    try:
        rgb = (
            rgb_of(pair.image) if isinstance(pair.image, Hdf5Array) else read_rgb(pair.image).values
        )
    except PnpDepthError:
        return None
    if rgb.shape[:2] != gt.shape:
        rgb = pair.frame.protocol.apply(rgb)
    return rgb if rgb.shape[:2] == gt.shape else None
