"""`pnpdepth eval`: the options, and the tables of the scores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json, progress_bar
from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.errors import FramesFailedError

_OUTPUT = ("--csv", "--columns", "--overwrite", "--json")


@click.command(
    "eval",
    short_help="Score depth files against ground truth.",
    cls=options.GroupedCommand,
    common=(
        "--protocol",
        "--max-depth",
        "--scale-by",
        "--gt-scale",
        "--pred-scale",
        "--resize",
        *_OUTPUT,
    ),
    groups={
        "Protocol": (EvalRequest,),
        "Input": ("--pred-scale", "--gt-scale", "--gt-range"),
        "Output": _OUTPUT,
    },
)
@click.argument("prediction", type=options.FILE, metavar="PRED")
@click.argument("ground_truth", type=options.FILE, metavar="GT")
@options.options_of_groups(EvalRequest)
@click.option("--csv", type=options.FILE, metavar="FILE|-", help="Write a row per frame.")
@options.overwrite
@options.as_json
def command(
    prediction: Path,
    ground_truth: Path,
    csv: Path | None,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Score the depth in PRED against the ground truth in GT: two files, or two folders.

    \b
    pnpdepth eval pred.png gt.png
    pnpdepth eval out/ gt/ --protocol kitti --csv scores.csv
    pnpdepth eval out/ gt/ --json > runs/a.json
    pnpdepth eval out/ gt/ --protocol eigen --max-depth 50

    Files in folders are matched by name; x_depth.png belongs to x.png. A folder PRED with such
    files has no other predictions. GT can also be a data set in a known layout. Frames of GT
    without a prediction are counted, and the exit code is 7. Options override single settings of
    the protocol.

    \b
    paper         all known ground truth; mean over images
    whole, nyu, kitti-odometry, marigold-dc-…, omni-dc-…
                  the same, of the part of the frames that `batch` refines by this name
    capa-…, streamtto-…
                  the same, without the pixels of sparse points
    nyu-eigen     0.001–10 m, predictions clipped to it, Eigen's crop of 640×480
    kitti         measures and units of the KITTI depth completion benchmark
    kitti-devkit  figures of KITTI's development kit: missing depth filled in, metres, 1/m
    eigen, garg   0.001–80 m, predictions clipped to it, Eigen's or Garg's crop
    """
    from pnpdepth_cli.cli.printing import check_tables, print_notes, print_table, write_tables
    from pnpdepth_cli.commands.eval import evaluate, frames_table, means_table

    # All that can be wrong is found before anything is scored.
    check_tables(csv, inputs=(prediction, ground_truth), overwrite=overwrite, as_json=as_json)
    request = EvalRequest(prediction=prediction, ground_truth=ground_truth, **values)
    # The scores, as tables and as JSON.
    with progress_bar("eval", "frame") as show:
        evaluation = evaluate(request, on_frame=show)
    print_notes([f"protocol {request.describe()}", *evaluation.notes])
    is_stdout_taken = write_tables({csv: frames_table(evaluation).csv()})
    if as_json:
        print_json(evaluation.to_json())
    elif not is_stdout_taken:
        print_table(means_table(evaluation))
    frames = evaluation.counts["frames"]
    unscored = frames - evaluation.counts["scored"]
    if unscored:
        raise FramesFailedError(f"{unscored:,} of {frames:,} frames were not scored")
