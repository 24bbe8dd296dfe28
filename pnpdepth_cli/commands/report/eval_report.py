"""`pnpdepth eval --html`: each frame's prediction, its ground truth, and a map of its errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.evaluate import Evaluation, means_table
from pnpdepth_cli.commands.evaluation.kitti_devkit import fill_background
from pnpdepth_cli.commands.evaluation.pairing import FramePair
from pnpdepth_cli.commands.evaluation.scoring import FILES, image_of, load_frame, scores_of
from pnpdepth_cli.commands.ordered_pool import THREADS, in_order
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import InputError, PnpDepthError
from pnpdepth_cli.io.figure import depth_scale, grey_of, hex_colours, signed_bar
from pnpdepth_cli.io.report import (
    Head,
    check_report_folder,
    image_key,
    save_views,
    write_report,
)
from pnpdepth_cli.io.visualisation import error_map
from pnpdepth_cli.measures import COVERAGE, Measure


def check_eval_report(folder: Path, inputs: list[Path], *, overwrite: bool) -> None:
    """Raises OutputError for a folder that the report cannot or may not be written to."""
    check_report_folder(folder, inputs, made_of=None, overwrite=overwrite)


def write_eval_report(
    folder: Path,
    evaluation: Evaluation,
    keys: Sequence[str] | None = None,
    *,
    on_frame: Callable[[int, int], None] = lambda done, of: None,
) -> None:
    """Writes the report; the files are read once more for its images.

    Args:
        folder: Folder of the page and its images.
        evaluation: The scores.
        keys: Measures of the report; None for all.
        on_frame: Callback with (done, of) after each frame.

    Raises:
        OutputError: If the report cannot be written; then the folder is as it was before.
    """
    # The columns of the frames, and what stands above them.
    request, measures = evaluation.request, evaluation.chosen(keys)
    columns = [replace(each, main=each.main or each.key in (keys or ())) for each in measures]
    columns.append(replace(COVERAGE, main=True))
    fill = " (filled in)" if request.is_devkit else ""
    head = Head(
        kind="Depth evaluation",
        title=str(request.prediction),
        facts=[
            ("Prediction", str(request.prediction)),
            ("Ground truth", str(request.ground_truth)),
            ("Protocol", request.describe()),
        ],
        notes=evaluation.notes,
        tables=[means_table(evaluation, keys)],
        without_title=f"Not scored: {evaluation.describe_unscored()}",
        without=[(f.name, f.message or "") for f in evaluation.frames if f.status != "done"],
        columns=columns,
        labels={
            "first": f"Prediction{fill}", "second": "Ground truth", "map": "Error",
            "image": "Image",
        },
        map_colours=hex_colours(signed_bar("error", 9)),
    )  # fmt: skip
    # The frames, one after the other.
    frames = zip(evaluation.pairs, evaluation.frames, strict=True)
    scored = [(pair, frame) for pair, frame in frames if frame.status == "done"]

    def entries(images: Path) -> Iterator[dict[str, Any]]:
        drawn = in_order(lambda each: _entry(*each, request, columns, images), scored, THREADS)
        for done, entry in enumerate(drawn, start=1):
            yield entry
            on_frame(done, len(scored))

    write_report(folder, {"command": "eval"}, head, entries)


def _entry(
    pair: FramePair,
    frame: FrameRecord,
    request: EvalRequest,
    columns: list[Measure],
    images: Path,
) -> dict[str, Any]:
    """The page's entry of a frame, whose images are written."""
    scores = scores_of(frame)
    notes = [f"Scored: {scores['pixels']:,} of {scores['known']:,} pixels of the ground truth."]
    if scores["given"]:
        notes.append(f"{scores['given']:,} of them were given to the network as sparse depth.")
    prediction, gt = (frame.inputs[name].path for name in FILES[:2])
    notes += [f"Prediction: {prediction}", f"Ground truth: {gt}"]
    try:
        drawn = _draw(pair, request, images)
    except InputError as error:  # the file has changed since it was scored
        notes.append(str(error))
        drawn = {"key": None}
    values = [scores.get(measure.key) for measure in columns]
    return {"name": frame.name, "values": values, "notes": notes, "tag": "", **drawn}


def _draw(pair: FramePair, request: EvalRequest, images: Path) -> dict[str, Any]:
    """Writes the images of a frame and returns the page's entry of them."""
    loaded = load_frame(pair, request)
    gt, depth, image = loaded.gt, loaded.depth, None
    if request.is_devkit:
        depth = np.maximum(fill_background(depth), np.float32(0))
    with suppress(PnpDepthError):
        image = image_of(pair, gt.shape)
    errors, strongest_m = error_map(depth, gt, None if image is None else grey_of(image))
    scale = depth_scale(depth, gt)
    views = {"first": scale.paint(depth), "second": scale.paint(gt), "map": errors}
    if image is not None:
        views["image"] = np.asarray(np.rint(255 * np.clip(image, 0, 1)), np.uint8)
    key = image_key(pair.files.name)
    amount = f"by {strongest_m:.3g} m or more"
    return {
        "key": key,
        "views": save_views(images, key, views),
        "scale_m": [scale.low_m, scale.high_m],
        "map": {
            "ends": [f"too near {amount}", f"too far {amount}"],
            "unknown": None if ((gt > 0) & (depth > 0)).all() else "not scored",
            "footer": "prediction against ground truth",
        },
    }
