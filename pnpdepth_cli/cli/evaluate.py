"""`pnpdepth eval`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.errors import FramesFailedError, UsageError

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.evaluation.result import Evaluation

PROTOCOLS = ("paper", "nyu", "kitti", "kitti-devkit", "eigen", "garg")


@click.command(name="eval", short_help="Score depth files against ground truth.")
@click.argument("prediction", type=options.FILE, metavar="PRED")
@click.argument("truth", type=options.FILE, metavar="GT")
@click.option("--protocol", type=click.Choice(PROTOCOLS), default="paper", show_default=True)
@click.option("--min-depth", type=float, metavar="M", help="Truth is scored above it.")
@click.option("--max-depth", type=float, metavar="M", help="Truth is scored below it.")
@click.option("--clip/--no-clip", default=None, help="Predictions are moved into these bounds.")
@click.option("--crop", metavar="NAME|X,Y,W,H", help="none, nyu, eigen, garg, or a rectangle.")
@click.option("--mask", type=options.FILE, help="A picture, or a folder of one for each frame.")
@click.option("--average", type=click.Choice(("per-image", "pooled")), help="Pooled: over pixels.")
@click.option(
    "--delta",
    metavar="D|D1,D2,D3",
    help="δk counts ratios below D^k, or below Dk; the paper's KITTI rows used 1.01."
    "  [default: 1.25]",
)
@click.option("--pred-scale", type=float, metavar="S", help="Integer predictions hold metres × S.")
@click.option("--gt-scale", type=float, metavar="S", help="The same for GT.")
@options.channel
@click.option(
    "--resize",
    type=click.Choice(("nearest", "bilinear")),
    help="Bring predictions of another size to the truth's.",
)
@click.option(
    "--sparse",
    type=options.FILE,
    metavar="FILE|FOLDER",
    help="The networks' sparse input: errors by distance to it and by depth, and what of it is in"
    " the truth.",
)
@click.option("--sparse-scale", type=float, metavar="S", help="The same for --sparse.")
@click.option("--exclude-sparse", is_flag=True, help="Do not score pixels with a sparse point.")
@click.option(
    "--bootstrap",
    "resamples",
    type=int,
    default=2000,
    show_default=True,
    metavar="N",
    help="Resamples behind the 95 % intervals; 0 leaves them out.",
)
@click.option("--seed", type=options.SEED, default=0, show_default=True, help="Of the resampling.")
@click.option(
    "--no-groups",
    is_flag=True,
    help="Treat all frames as independent, also those of one sequence or group.",
)
@click.option("--workers", type=int, default=2, show_default=True, help="Frames read at once.")
@click.option("--csv", type=options.FILE, metavar="FILE|-", help="A line for each frame.")
@click.option("--markdown", type=options.FILE, metavar="FILE|-", help="The means as a table.")
@click.option("--latex", type=options.FILE, metavar="FILE|-", help="The means as a tabular.")
@click.option(
    "--html",
    type=options.FILE,
    metavar="FOLDER",
    help="A report to open in a browser: every frame beside its truth, the worst first.",
)
@options.overwrite
@options.as_json
def evaluate(
    prediction: Path,
    truth: Path,
    csv: Path | None,
    markdown: Path | None,
    latex: Path | None,
    html: Path | None,
    overwrite: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Score the depth PRED against the ground truth GT: two files, or two folders.

    \b
    pnpdepth eval pred.png gt.png
    pnpdepth eval out/ gt/ --protocol kitti --csv scores.csv --html report/
    pnpdepth eval out/ gt/ --sparse sparse/ --json > runs/a.json
    pnpdepth eval out/ gt/ --protocol eigen --max-depth 50 --average pooled

    Folders are matched by name; x_depth.png belongs to x.png. GT can also be a data set of a known
    layout. Frames of GT without a prediction are counted, and end the command with code 7. What a
    protocol sets, the options change one by one.

    \b
    paper         all known truth; mean over the images
    nyu           truth in 0.001–10 m, predictions clipped to it, Eigen's crop of 640×480
    kitti         the completion benchmark's measures in its units
    kitti-devkit  the figures of KITTI's development kit: missing depth filled in, metres, 1/m
    eigen, garg   truth in 0.001–80 m, predictions clipped to it, Eigen's or Garg's crop
    """
    from pnpdepth_cli.cli import score_tables
    from pnpdepth_cli.pipeline.evaluation import score_files
    from pnpdepth_cli.pipeline.report import evaluation as report_eval

    targets = (csv, markdown, latex)
    score_tables.check_stdout(targets, as_json)
    score_files.check_targets(targets, (prediction, truth), overwrite=overwrite)
    if html is not None:
        inputs = [p for p in (prediction, truth, given["sparse"], given["mask"]) if p is not None]
        report_eval.check_eval_report(html, inputs, overwrite=overwrite)
    evaluation = _evaluate(prediction, truth, **given)
    protocol = evaluation.protocol.describe()
    score_tables.print_notes([f"protocol {protocol}", *evaluation.notes])
    name = prediction.stem if prediction.is_file() else prediction.resolve().name
    table = score_files.means_table(evaluation, name)
    texts = (
        (csv, score_files.frames_csv(evaluation)),
        (markdown, score_files.markdown_text(*table, protocol)),
        (latex, score_files.latex_text(*table, protocol)),
    )
    to_stdout = score_tables.write_texts(texts)
    if as_json:
        click.echo(json.dumps(evaluation.as_record(), indent=2))
    elif not to_stdout:
        score_tables.print_evaluation(evaluation)
    if html is not None:
        with _bar("report") as show:
            report_eval.write_eval_report(html, evaluation, on_frame=show)
        click.echo(printable(f"wrote {html / 'index.html'}"), err=True)
    unscored = evaluation.unscored()
    if unscored is not None:
        raise FramesFailedError(unscored)


def _evaluate(
    prediction: Path,
    truth: Path,
    *,
    sparse: Path | None,
    protocol: str,
    pred_scale: float | None,
    gt_scale: float | None,
    sparse_scale: float | None,
    channel: str | None,
    resamples: int,
    seed: int,
    workers: int,
    delta: str | None,
    exclude_sparse: bool,
    no_groups: bool,
    **changes: Any,
) -> Evaluation:
    """The evaluation, with a bar over the frames where it takes longer than a second."""
    from pnpdepth_cli.pipeline.evaluation.evaluate import evaluate
    from pnpdepth_cli.pipeline.evaluation.frame_reading import Scales
    from pnpdepth_cli.pipeline.evaluation.result import EvalRequest

    changes |= {"thresholds": _thresholds(delta), "exclude_sparse": exclude_sparse or None}
    request = EvalRequest(
        prediction=prediction,
        ground_truth=truth,
        sparse=sparse,
        protocol=protocol,
        changes=changes,
        scales=Scales(
            prediction=pred_scale, ground_truth=gt_scale, sparse=sparse_scale, channel=channel
        ),
        resamples=resamples,
        seed=seed,
        grouped=not no_groups,
        workers=workers,
    )
    with _bar("eval") as show:
        return evaluate(request, on_frame=show)


@contextmanager
def _bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Inside, the function that is told (done, of) draws a bar if it takes more than a second."""
    from tqdm import tqdm

    with tqdm(desc=title, unit="frame", delay=1, leave=False, disable=None) as bar:

        def show(done: int, of: int) -> None:
            bar.total = of
            bar.update(done - bar.n)

        yield show


def _thresholds(text: str | None) -> tuple[float, float, float] | None:
    """Of δ1…3, from one number that is raised to powers or from all three."""
    if text is None:
        return None
    try:
        first, *others = (float(word) for word in text.split(","))
        second, third = others or (first**2, first**3)
    except (ValueError, OverflowError):
        raise UsageError(f"--delta {text!r} is neither a number such as 1.25 nor three") from None
    return first, second, third
