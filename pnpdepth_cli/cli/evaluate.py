"""`pnpdepth eval`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.choices import (
    AVERAGES,
    EVAL_PROTOCOLS,
    FRAME_PROTOCOLS,
    MEASURE_GROUPS,
    MISSING,
    PREDICTION_KINDS,
    RESIZES,
    SCALINGS,
)
from pnpdepth_cli.cli import grouped_help, options
from pnpdepth_cli.cli.compare import columns, names_in
from pnpdepth_cli.cli.progress import progress_bar
from pnpdepth_cli.cli.streams import printable
from pnpdepth_cli.errors import FramesFailedError, UsageError


def _thresholds(text: str) -> tuple[float, float, float]:
    """Returns the thresholds of δ1…δ3 from one number, which is raised to powers, or from three."""
    try:
        first, *others = (float(word) for word in text.split(","))
        second, third = others or (first**2, first**3)
    except (ValueError, OverflowError):
        raise UsageError(
            f"--delta {text!r} is neither one number such as 1.25 nor three numbers"
        ) from None
    return first, second, third


def _choice(flag: str, names: Sequence[str], text: str) -> Callable[[Any], Any]:
    field = "prediction_kind" if flag == "--pred-kind" else flag[2:].replace("-", "_")
    return click.option(flag, field, type=click.Choice(names), help=text)


def _option(flags: str, metavar: str | None, text: str, **details: Any) -> Callable[[Any], Any]:
    return click.option(*flags.split(), metavar=metavar, help=text, **details)


_FLAGS_OF_INPUT = (
    *("--pred-scale", "--gt-scale", "--pred-kind", "--channel", "--resize", "--pred-crop"),
    *("--mask", "--calib", "--layout-protocol", "--sparse", "--sparse-scale", "--workers"),
)
_FLAGS_OF_PROTOCOL = (
    *("--protocol", "--min-depth", "--max-depth", "--clip", "--crop", "--average", "--delta"),
    *("--exclude-sparse", "--missing", "--scale-by", "--bootstrap", "--no-groups", "--seed"),
    "--measures",
)
_FLAGS_OF_OUTPUT = (
    *("--csv", "--markdown", "--latex", "--columns", "--html", "--overwrite", "--json"),
)
_COMMON = (
    *("--protocol", "--min-depth", "--max-depth", "--crop", "--average", "--gt-scale"),
    *("--pred-scale", "--sparse", "--resize", *_FLAGS_OF_OUTPUT),
)


@click.command(
    name="eval",
    short_help="Score depth files against ground truth.",
    cls=grouped_help.GroupedCommand,
    common=frozenset(_COMMON) - {"--columns"},
    groups={"Input": _FLAGS_OF_INPUT, "Protocol": _FLAGS_OF_PROTOCOL, "Output": _FLAGS_OF_OUTPUT},
)
@click.argument("prediction", type=options.FILE, metavar="PRED")
@click.argument("ground_truth", type=options.FILE, metavar="GT")
@_option(
    "--protocol",
    None,
    "Preset of the options below.",
    type=click.Choice(EVAL_PROTOCOLS),
    default="paper",
    show_default=True,
)
@_option("--min-depth", "M", "Score ground truth above M metres.", type=float)
@_option("--max-depth", "M", "Score ground truth below M metres.", type=float)
@_option("--clip/--no-clip", None, "Clip predictions to these bounds.", default=None)
@_option("--crop", "NAME|X,Y,W,H", "none, nyu, eigen, garg, or a rectangle.")
@_option("--mask", None, "Mask image, or folder with a mask per frame.", type=options.FILE)
@_choice("--average", AVERAGES, "Mean over images, or over all pixels of all images.")
@_option(
    "--delta thresholds",
    "D|D1,D2,D3",
    "Thresholds of δ1…δ3: D, D², D³, or D1, D2, D3. The paper's KITTI rows use 1.01."
    "  [default: 1.25]",
    type=_thresholds,
)
@_choice(
    "--missing",
    MISSING,
    "Empty predictions: not scored, scored as --min-depth or --max-depth, or an error."
    "  [default: the protocol's]",
)
@_choice(
    "--scale-by",
    SCALINGS,
    "Scale each image to its ground truth, for relative predictions.  [default: none]",
)
@_choice("--pred-kind", PREDICTION_KINDS, "What predictions are.  [default: depth]")
@_option(
    "--measures groups",
    "GROUP,…",
    f"Additional measures: {', '.join(MEASURE_GROUPS)}.",
    type=names_in,
)
@_option(
    "--calib",
    None,
    "Calibration or K of all frames, for --measures normals and cloud.  [default: the data set's]",
    type=options.FILE,
)
@_option("--pred-scale", "S", "Integer predictions hold metres × S.", type=float)
@_option("--gt-scale", "S", "Integer ground truth holds metres × S.", type=float)
@options.channel
@_choice("--resize", RESIZES, "Resize predictions to the size of the ground truth.")
@_option(
    "--pred-crop prediction_crop",
    "kb|X,Y,W,H",
    "Part of the frame that predictions show, such as the 1216×352 of KITTI's benchmark.",
)
@_choice(
    "--layout-protocol",
    FRAME_PROTOCOLS,
    "Crop of the frames of a data set GT, as in batch.  [default: the layout's own]",
)
@_option(
    "--sparse",
    "FILE|FOLDER",
    "Sparse depth the networks had: points that are part of the ground truth are reported.",
    type=options.FILE,
)
@_option("--sparse-scale", "S", "Integer --sparse files hold metres × S.", type=float)
@_option(
    "--exclude-sparse", None, "Leave out pixels with a sparse point.", is_flag=True, default=None
)
@_option(
    "--bootstrap resamples",
    "N",
    "Number of bootstrap resamples for the intervals; 0 prints none.",
    type=int,
    default=2000,
    show_default=True,
)
@options.bootstrap_seed
@_option("--workers", "N", "Number of frames read at once.", type=int, default=2, show_default=True)
@options.no_groups
@options.table_files(
    csv="Write a row per frame.",
    markdown="Write a table of the means.",
    latex="Write a tabular of the means.",
)
@columns
@_option(
    "--html", "FOLDER",
    "Write an HTML report: every frame beside its ground truth, the worst first.",
    type=options.FILE,
)  # fmt: skip
def evaluate(prediction: Path, ground_truth: Path, html: Path | None, **values: Any) -> None:
    """Score the depth in PRED against the ground truth in GT: two files, or two folders.

    \b
    pnpdepth eval pred.png gt.png
    pnpdepth eval out/ gt/ --protocol kitti --csv scores.csv --html report/
    pnpdepth eval out/ gt/ --sparse sparse/ --json > runs/a.json
    pnpdepth eval out/ gt/ --protocol eigen --max-depth 50 --average pooled

    Files in folders are matched by name; x_depth.png belongs to x.png. GT can also be a data set in
    a known layout. Frames of GT without a prediction are counted, and the exit code is 7. Options
    override single settings of the protocol.

    \b
    paper         all known ground truth; mean over images
    nyu-eigen     0.001–10 m, predictions clipped to it, Eigen's crop of 640×480
    kitti         measures and units of the KITTI depth completion benchmark
    kitti-devkit  figures of KITTI's development kit: missing depth filled in, metres, 1/m
    eigen, garg   0.001–80 m, predictions clipped to it, Eigen's or Garg's crop
    """
    from pnpdepth_cli.cli.tables import TableFiles, print_notes, print_table
    from pnpdepth_cli.commands.evaluation import tables
    from pnpdepth_cli.commands.evaluation.evaluate import EvalRequest
    from pnpdepth_cli.commands.evaluation.evaluate import evaluate as run_evaluation
    from pnpdepth_cli.commands.evaluation.frames import Scales
    from pnpdepth_cli.commands.evaluation.protocols import choose_protocol
    from pnpdepth_cli.commands.report import evaluation as report_eval
    from pnpdepth_cli.commands.tables import chosen_measures

    files = TableFiles(**{each.name: values.pop(each.name) for each in fields(TableFiles)})
    files.check((prediction, ground_truth))
    keys = values.pop("columns")
    if html is not None:
        inputs = [prediction, ground_truth, values["sparse"], values["mask"]]
        report_eval.check_eval_report(
            html, [path for path in inputs if path is not None], overwrite=files.overwrite
        )
    request = EvalRequest(
        prediction=prediction,
        ground_truth=ground_truth,
        grouped=not values.pop("no_groups"),
        scales=Scales(
            prediction=values.pop("pred_scale"),
            truth=values.pop("gt_scale"),
            sparse=values.pop("sparse_scale"),
            channel=values.pop("channel"),
        ),
        **{each.name: values.pop(each.name) for each in fields(EvalRequest) if each.name in values},
        changes=values,
    )
    chosen_measures(choose_protocol(request.protocol, **values).measures, keys)
    with progress_bar("eval", "frame") as show:
        evaluation = run_evaluation(request, on_frame=show)
    print_notes([f"protocol {evaluation.protocol.describe()}", *evaluation.notes])
    name = prediction.stem if prediction.is_file() else prediction.resolve().name
    means = tables.means_row(evaluation, name, keys)
    to_stdout = files.write(csv=tables.frames_csv(evaluation), markdown=means, latex=means)
    if files.as_json:
        click.echo(json.dumps(evaluation.as_record(), indent=2))
    elif not to_stdout:
        for table in tables.text_tables(evaluation, keys):
            print_table(table)
    if html is not None:
        with progress_bar("report", "frame") as show:
            report_eval.write_eval_report(html, evaluation, on_frame=show)
        click.echo(printable(f"wrote {html / 'index.html'}"), err=True)
    unscored = evaluation.unscored()
    if unscored is not None:
        raise FramesFailedError(unscored)
