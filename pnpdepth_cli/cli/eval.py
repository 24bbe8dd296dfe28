"""`pnpdepth eval`, `compare`, `cloud` and `export`: what is done with results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.choices import EXPORTS, UNKNOWN
from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json, progress_bar
from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.requests import CloudRequest
from pnpdepth_cli.errors import FramesFailedError
from pnpdepth_cli.measures import parse_keys

_OUTPUT = ("--csv", "--columns", "--overwrite", "--json")


@click.command(
    name="eval",
    short_help="Score depth files against ground truth.",
    cls=options.GroupedCommand,
    common=(
        *("--protocol", "--max-depth", "--scale-by", "--gt-scale", "--pred-scale", "--resize"),
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
def evaluate(
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
    from pnpdepth_cli.commands.evaluation import evaluate as command

    # All that can be wrong is found before anything is scored.
    check_tables(csv, inputs=(prediction, ground_truth), overwrite=overwrite, as_json=as_json)
    request = EvalRequest(prediction=prediction, ground_truth=ground_truth, **values)
    # The scores, as tables and as JSON.
    with progress_bar("eval", "frame") as show:
        evaluation = command.evaluate(request, on_frame=show)
    print_notes([f"protocol {request.describe()}", *evaluation.notes])
    to_stdout = write_tables({csv: command.frames_table(evaluation).csv()})
    if as_json:
        print_json(evaluation.to_json())
    elif not to_stdout:
        print_table(command.means_table(evaluation))
    frames = evaluation.counts["frames"]
    if failed := frames - evaluation.counts["scored"]:
        raise FramesFailedError(f"{failed:,} of {frames:,} frames were not scored")


@click.command(short_help="Compare runs that eval or batch scored.")
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN…")
@click.option("--csv", type=options.FILE, metavar="FILE|-", help="Write the table as CSV.")
@click.option(
    "--latex",
    type=options.FILE,
    metavar="FILE|-",
    help="Write a tabular of runs × measures: the best in bold, * where p < 0.05; it needs the"
    " package booktabs.",
)
@options.overwrite
@options.as_json
@click.option(
    "--columns",
    type=parse_keys,
    metavar="KEY,…",
    help="Measures of the tables, in this order, such as rmse,mae,delta1.",
)
@click.option(
    "--plot",
    type=options.FILE,
    metavar="FILE",
    help="Plot results of `batch --vary` over the varied values: PNG, SVG or PDF. Needs the extra"
    " plot.",
)
def compare(
    runs: tuple[str, ...],
    columns: tuple[str, ...] | None,
    plot: Path | None,
    csv: Path | None,
    latex: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare RUNs with the first of them, on the frames that all of them scored.

    \b
    pnpdepth compare runs/a.json runs/b.json
    pnpdepth compare out/summary.json:before out/summary.json
    pnpdepth compare study/*/ --columns mae --plot mae.png

    A RUN is the output of `pnpdepth eval --json`, or the folder or summary.json of a batch.
    FILE:before takes the depth before refinement. Gains are in per cent of the first run, and
    positive if the other run is better. Runs of a study are listed in the order of its values.

    p is the p-value of a paired permutation test over groups of frames: manifest column group,
    sequence or folder. In a single sequence the groups are blocks as long as its errors are
    correlated. p is adjusted for the number of measures and runs (Holm). It is exact for few
    groups, else computed with random permutations.
    """
    from pnpdepth_cli.cli.printing import check_tables, print_notes, print_table, write_tables
    from pnpdepth_cli.commands.evaluation import compare as command

    inputs = [Path(run) for run in runs]
    check_tables(csv, latex, inputs=inputs, overwrite=overwrite, as_json=as_json)
    comparison = command.compare(runs, columns=columns)
    if plot is not None:
        command.plot_comparison(comparison, plot, overwrite=overwrite)
    print_notes(comparison.notes)
    table = command.comparison_table(comparison)
    methods = command.methods_table(comparison)
    values = command.comparison_values(comparison)
    to_stdout = write_tables({csv: values.csv(), latex: methods.latex()})
    if as_json:
        print_json(comparison.to_json())
    elif not to_stdout:
        print_table(table)


@click.command(short_help="Write depth as a coloured point cloud.")
@click.argument("depth", type=options.FILE)
@options.options_of_groups(CloudRequest)
@options.pose_kind
@options.depth_scale
@click.option("-o", "--output", type=options.FILE, required=True, help="PLY file.")
@options.overwrite
def cloud(**values: Any) -> None:
    """Write DEPTH, a depth file or the results of a batch, as a coloured point cloud.

    \b
    pnpdepth cloud out/img_depth.png -o img.ply
    pnpdepth cloud out/ --calib calib.txt --poses poses.txt --min-views 2 -o drive.ply
    pnpdepth cloud depth.exr --image img.png --calib k.txt -o img.ply

    The cloud is in the camera's coordinates (x right, y down, z forward), with poses in the
    world's. Pixels that NAME_valid.png beside NAME_depth excludes are left out.
    """
    from pnpdepth_cli.cli.printing import print_notes
    from pnpdepth_cli.commands.cloud import write_depth_cloud

    with progress_bar("cloud", "frame") as show:
        what, notes = write_depth_cloud(CloudRequest(**values), show)
    print_notes(notes)
    click.echo(f"wrote {what}: {values['output']}")


@click.command(short_help="Write depth for COLMAP, Nerfstudio, 3DGS, ROS.")
@click.argument("results", type=options.FILE)
@click.option("--to", type=click.Choice(list(EXPORTS)), required=True, help="The program.")
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@click.option(
    "--unknown",
    type=click.Choice(UNKNOWN),
    default="keep",
    show_default=True,
    help="Of 3DGS, which reads no masks: pixels that are not valid keep a depth, or have zero.",
)
@options.overwrite
def export(results: Path, output: Path, **values: Any) -> None:
    """Write RESULTS, a folder of `batch` or `refine`, for a reconstruction program or a viewer.

    \b
    pnpdepth export out/ --to nerfstudio -o scene/
    pnpdepth export out/ --to colmap -o dense/               # the undistorted project
    pnpdepth export out/ --to gaussian-splatting -o dense/
    pnpdepth export out/ --to mcap -o bag/

    \b
    colmap              stereo/depth_maps, stereo/normal_maps, for `colmap stereo_fusion`
    nerfstudio          transforms.json (also for Instant-NGP), depths/ (16-bit PNG), images/,
                        start.ply
    gaussian-splatting  inverse_depths/ (its option -d), sparse/0/depth_params.json,
                        and images/ and a model in sparse/0/ unless they are there
    mcap                a bag of ROS 2, also for Foxglove and Rerun: image, camera_info, depth
                        (32FC1), sigma, points used, cloud, poses as /tf; needs the extra ros

    Camera and pose come from the records, so RESULTS are best those of a COLMAP project
    (`pnpdepth batch --layout colmap`). OUTPUT may be the project itself.
    """
    from pnpdepth_cli.cli.printing import print_notes
    from pnpdepth_cli.commands.exports import export_results

    with progress_bar("export", "frame") as show:
        what, notes = export_results(results, output, show=show, **values)
    print_notes(notes)
    click.echo(f"wrote {what}: {output}")
