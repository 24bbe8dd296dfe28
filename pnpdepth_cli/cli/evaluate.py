"""`pnpdepth eval`."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.cli.progress import progress_bar
from pnpdepth_cli.errors import FramesFailedError, UsageError

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.evaluation.result import EvalRequest

_REQUEST_OPTIONS = (
    "sparse",
    "protocol",
    "layout_protocol",
    "calib",
    "resamples",
    "seed",
    "workers",
)
"""Options that are fields of `EvalRequest`."""
_SCALE_OPTIONS = {
    "prediction": "pred_scale",
    "ground_truth": "gt_scale",
    "sparse": "sparse_scale",
    "channel": "channel",
}
"""Options by the field of `Scales` that they set."""


@click.command(
    name="eval",
    short_help="Score depth files against ground truth.",
    cls=grouped_help.GroupedCommand,
    common=frozenset(
        {
            *("--protocol", "--min-depth", "--max-depth", "--crop", "--average", "--gt-scale"),
            *("--pred-scale", "--sparse", "--csv", "--markdown", "--latex", "--html", "--json"),
            *("--overwrite", "--resize"),
        }
    ),
    groups={
        "Input": (
            *("--pred-scale", "--gt-scale", "--pred-kind", "--channel", "--resize", "--pred-crop"),
            *(
                "--mask",
                "--calib",
                "--layout-protocol",
                "--sparse",
                "--sparse-scale",
                "--workers",
            ),
        ),
        "Protocol": (
            *("--protocol", "--min-depth", "--max-depth", "--clip", "--crop", "--average"),
            *("--delta", "--exclude-sparse", "--missing", "--scale-by", "--bootstrap"),
            *("--no-groups", "--seed", "--measures"),
        ),
        "Output": ("--csv", "--markdown", "--latex", "--html", "--overwrite", "--json"),
    },
)
@click.argument("prediction", type=options.FILE, metavar="PRED")
@click.argument("ground_truth", type=options.FILE, metavar="GT")
@click.option(
    "--protocol",
    type=click.Choice(EVAL_PROTOCOLS),
    default="paper",
    show_default=True,
    help="Preset of the options below.",
)
@click.option("--min-depth", type=float, metavar="M", help="Score ground truth above M metres.")
@click.option("--max-depth", type=float, metavar="M", help="Score ground truth below M metres.")
@click.option("--clip/--no-clip", default=None, help="Clip predictions to these bounds.")
@click.option("--crop", metavar="NAME|X,Y,W,H", help="none, nyu, eigen, garg, or a rectangle.")
@click.option("--mask", type=options.FILE, help="Mask image, or folder with a mask per frame.")
@click.option(
    "--average",
    type=click.Choice(AVERAGES),
    help="Mean over images, or over all pixels of all images.",
)
@click.option(
    "--delta",
    metavar="D|D1,D2,D3",
    help="Thresholds of δ1…δ3: D, D², D³, or D1, D2, D3. The paper's KITTI rows use 1.01."
    "  [default: 1.25]",
)
@click.option(
    "--missing",
    type=click.Choice(MISSING),
    help="Empty predictions: not scored, scored as --min-depth or --max-depth, or an error."
    "  [default: the protocol's]",
)
@click.option(
    "--scale-by",
    type=click.Choice(SCALINGS),
    help="Scale each image to its ground truth, for relative predictions.  [default: none]",
)
@click.option(
    "--pred-kind",
    "prediction_kind",
    type=click.Choice(PREDICTION_KINDS),
    help="What predictions are.  [default: depth]",
)
@click.option(
    "--measures",
    metavar="GROUP,…",
    help=f"Additional measures: {', '.join(MEASURE_GROUPS)}.",
)
@click.option(
    "--calib",
    type=options.FILE,
    help="Calibration or K of all frames, for --measures normals and cloud.  [default: the data"
    " set's]",
)
@click.option("--pred-scale", type=float, metavar="S", help="Integer predictions hold metres × S.")
@click.option("--gt-scale", type=float, metavar="S", help="Integer ground truth holds metres × S.")
@options.channel
@click.option(
    "--resize",
    type=click.Choice(RESIZES),
    help="Resize predictions to the size of the ground truth.",
)
@click.option(
    "--pred-crop",
    "prediction_crop",
    metavar="kb|X,Y,W,H",
    help="Part of the frame that predictions show, such as the 1216×352 of KITTI's benchmark.",
)
@click.option(
    "--layout-protocol",
    type=click.Choice(FRAME_PROTOCOLS),
    help="Crop of the frames of a data set GT, as in batch.  [default: the layout's own]",
)
@click.option(
    "--sparse",
    type=options.FILE,
    metavar="FILE|FOLDER",
    help="Sparse depth the networks had: adds errors by distance to the points and by depth, and"
    " reports points that are part of the ground truth.",
)
@click.option(
    "--sparse-scale", type=float, metavar="S", help="Integer --sparse files hold metres × S."
)
@click.option("--exclude-sparse", is_flag=True, help="Leave out pixels that have a sparse point.")
@click.option(
    "--bootstrap",
    "resamples",
    type=int,
    default=2000,
    show_default=True,
    metavar="N",
    help="Number of bootstrap resamples for the intervals; 0 prints none.",
)
@options.bootstrap_seed
@click.option(
    "--workers",
    type=int,
    default=2,
    show_default=True,
    metavar="N",
    help="Number of frames read at once.",
)
@options.no_groups
@options.table_files(
    csv="Write a row per frame.",
    markdown="Write a table of the means.",
    latex="Write a tabular of the means.",
)
@click.option(
    "--html",
    type=options.FILE,
    metavar="FOLDER",
    help="Write an HTML report: every frame beside its ground truth, the worst first.",
)
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
    from pnpdepth_cli.cli import score_tables
    from pnpdepth_cli.pipeline.evaluation import score_files
    from pnpdepth_cli.pipeline.evaluation.evaluate import evaluate as run_evaluation
    from pnpdepth_cli.pipeline.report import evaluation as report_eval

    names = [each.name for each in fields(score_tables.TableFiles)]
    tables = score_tables.TableFiles(**{name: values.pop(name) for name in names})
    tables.check((prediction, ground_truth))
    if html is not None:
        inputs = [
            p for p in (prediction, ground_truth, values["sparse"], values["mask"]) if p is not None
        ]
        report_eval.check_eval_report(html, inputs, overwrite=tables.overwrite)
    request = _request(prediction, ground_truth, values)
    with progress_bar("eval", "frame") as show:
        evaluation = run_evaluation(request, on_frame=show)
    protocol = evaluation.protocol.describe()
    score_tables.print_notes([f"protocol {protocol}", *evaluation.notes])
    name = prediction.stem if prediction.is_file() else prediction.resolve().name
    table = score_files.means_table(evaluation, name)
    to_stdout = tables.write(
        score_files.frames_csv(evaluation),
        score_files.markdown_text(*table, protocol),
        score_files.latex_text(*table, protocol),
    )
    if tables.as_json:
        click.echo(json.dumps(evaluation.as_record(), indent=2))
    elif not to_stdout:
        score_tables.print_evaluation(evaluation)
    if html is not None:
        with progress_bar("report", "frame") as show:
            report_eval.write_eval_report(html, evaluation, on_frame=show)
        click.echo(printable(f"wrote {html / 'index.html'}"), err=True)
    unscored = evaluation.unscored()
    if unscored is not None:
        raise FramesFailedError(unscored)


def _request(prediction: Path, ground_truth: Path, values: dict[str, Any]) -> EvalRequest:
    """Returns the request of the other options; those without an own field change the protocol."""
    from pnpdepth_cli.pipeline.evaluation.frame_reading import Scales
    from pnpdepth_cli.pipeline.evaluation.result import EvalRequest

    own = {name: values.pop(name) for name in _REQUEST_OPTIONS}
    scales = {field: values.pop(name) for field, name in _SCALE_OPTIONS.items()}
    grouped = not values.pop("no_groups")
    groups = values.pop("measures")
    derived = {
        "groups": None if groups is None else tuple(dict.fromkeys(groups.split(","))),
        "thresholds": _thresholds(values.pop("delta")),
        "exclude_sparse": values.pop("exclude_sparse") or None,
    }
    return EvalRequest(
        prediction=prediction,
        ground_truth=ground_truth,
        grouped=grouped,
        scales=Scales(**scales),
        changes=values | derived,
        **own,
    )


def _thresholds(text: str | None) -> tuple[float, float, float] | None:
    """Returns the thresholds of δ1…δ3 from one number, which is raised to powers, or from three."""
    if text is None:
        return None
    try:
        first, *others = (float(word) for word in text.split(","))
        second, third = others or (first**2, first**3)
    except (ValueError, OverflowError):
        raise UsageError(
            f"--delta {text!r} is neither one number such as 1.25 nor three numbers"
        ) from None
    return first, second, third
