"""`pnpdepth sweep`."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.choices import PLOT_FORMATS
from pnpdepth_cli.cli import grouped_help, options
from pnpdepth_cli.cli.progress import BatchProgress
from pnpdepth_cli.cli.streams import INTERRUPTED, print_json
from pnpdepth_cli.commands.batch.request import FrameSelection
from pnpdepth_cli.commands.refinement.request import FrameFiles, NetworkChoice
from pnpdepth_cli.commands.sparse.options import ScanOptions
from pnpdepth_cli.errors import FramesFailedError, StorageError

_SCAN_DETAILS = ("inverse_extrinsics", "euclidean", "keep_occluded", "point_fields")
"""A scan that needs these is projected first."""
_RARE = ("output_kind", "normalise", "precision", "sparse_size_ok", "channel")
"""Options of one frame; --set of sweep has parameters."""


@click.command(
    short_help="Vary the refinement or the points, and plot the errors.",
    cls=grouped_help.GroupedCommand,
    common=frozenset(
        {
            *("--vary", "--set", "--one-by-one", "--sample", "--seeds", "--layout", "--limit"),
            *("--calib", "--model", "--checkpoint", "--output", "--plots", "--json"),
        }
    ),
    groups={
        "Sweep": ("--vary", "--set", "--one-by-one", "--sample", "--seeds"),
        "Frames": (FrameSelection,),
        "Input": (ScanOptions, FrameFiles),
        "Network": (NetworkChoice, "--output-kind", "--normalise"),
        "Output": ("--output", "--plots", "--cost", "--json"),
    },
)
@click.argument("source", type=options.FILE, metavar="FOLDER|LIST")
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@click.option(
    "--vary",
    multiple=True,
    required=True,
    metavar="NAME=V,V,…",
    help="Parameter and its values; two --vary make a grid.",
)
@click.option(
    "--set", "settings", multiple=True, metavar="NAME=V", help="Parameter that is not varied."
)
@click.option(
    "--one-by-one",
    is_flag=True,
    help="Vary each parameter alone, with the others as set or at their defaults.",
)
@click.option(
    "--sample",
    metavar="[SENSOR:]N|P%",
    help="Source of the points, unless varied.  [default: the frames' own points]",
)
@click.option(
    "--seeds",
    type=int,
    default=1,
    show_default=True,
    metavar="N",
    help="Number of random draws of the points, with consecutive seeds.",
)
@options.options_of_groups(FrameSelection)
@click.option(
    "--plots",
    type=click.Choice((*PLOT_FORMATS, "none")),
    default="png",
    show_default=True,
    help="Format of the plots; none writes tables only.",
)
@click.option(
    "--cost", is_flag=True, help="Add the time of the refinement to tables, and a plot over it."
)
@options.options_of_groups(ScanOptions, without=_SCAN_DETAILS)
@options.options_of_groups(FrameFiles, NetworkChoice, without=_RARE)
@options.output_kind
@options.normalise
@options.as_json
def sweep(
    vary: tuple[str, ...],
    settings: tuple[str, ...],
    one_by_one: bool,
    sample: str | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Vary the refinement or the points over frames with ground truth, and plot the errors.

    \b
    pnpdepth sweep frames.csv -o sweep/ --sample 500 --vary iterations=0,1,2,5,10,20
    pnpdepth sweep frames.csv -o sweep/ --seeds 3 --vary points=20,100,500 --vary iterations=0,5,20
    pnpdepth sweep frames.csv -o sweep/ --one-by-one --sample 500 --set iterations=10 \\
        --vary lr=1%,3%,10% --vary layer=0,0.5,1 --vary loss=l1,l2,log
    pnpdepth sweep kitti/ -o sweep/ --vary sensor=vlp-16,vlp-32c,hdl-32e,hdl-64e

    FOLDER or LIST is what `pnpdepth batch` takes.

    \b
    points      N; or P% of the known pixels, of the frame's points or of the LiDAR's points
    sensor      own; a pattern of `pnpdepth sample` such as grid, grid:500 or lines:16; or a LiDAR
                of `pnpdepth simulate` at the camera, which needs a calibration
    noise, relative-noise, outliers, jitter, rotation-noise
                faults of the points as in `pnpdepth sample`, of a LiDAR as in `pnpdepth simulate`
    preset, layer, iterations, lr, loss, update, schedule, blur, target, parameters, mask,
    mask-fraction, mask-scale, proximity, line-search, keep-best, align, align-every, propagate
                the options of `pnpdepth refine` of these names; switches are on or off
    model       networks, as NETWORK or NETWORK@WEIGHTS
    seed        of the draw of the points, in place of --seeds

    One --vary gives a table and a plot of one parameter, two of their grid, and with --one-by-one
    every --vary its own. The refined depth stands beside the network's prediction and linear
    interpolation of the same points. Means are over frames, after the mean over seeds; intervals
    (95 %) are over frames. Gains are in per cent, positive if refinement is better.

    OUTPUT gets sweep.csv, sweep.json and sweep.tex (means), sweep_frames.csv (every frame), a plot
    per table (extra pnpdepth[plot]), and sweep.jsonl (the journal). Run again, also with other
    values, only missing values are computed.
    """
    from pnpdepth_cli.cli.tables import print_table
    from pnpdepth_cli.commands.sweep.axes import PARAMETERS, read_axis, studies_of, values_of
    from pnpdepth_cli.commands.sweep.outputs import study_table
    from pnpdepth_cli.commands.sweep.points import read_sampling
    from pnpdepth_cli.commands.sweep.running import RESULTS
    from pnpdepth_cli.commands.sweep.sweep import SweepRequest, run_sweep

    fixed = dict(text.partition("=")[::2] for text in settings)
    method = values_of(fixed, of_points=False)
    own = {name: values.pop(name) for name in ("output", "source", "seeds", "plots", "cost")}
    request = SweepRequest(
        **own,
        **options.taken(FrameSelection, values),
        studies=studies_of([read_axis(text) for text in vary], one_by_one=one_by_one),
        sampling=None if sample is None else read_sampling(sample),
        points={name: text for name, text in fixed.items() if PARAMETERS[name].of_points},
        refine=options.request_of(values).with_fields(**method),
    )
    with BatchProgress("sweep", "run") as progress:
        try:
            record = run_sweep(request, progress)
        except StorageError as error:
            raise StorageError(f"{error}; run the same command to continue") from error
        except KeyboardInterrupt:
            progress.say("stopped; run the same command to continue")
            raise click.exceptions.Exit(INTERRUPTED) from None
    if as_json:
        print_json(record)
    else:
        for study in record["studies"]:
            print_table(study_table(study, record))
        plots = [study["plot"] for study in record["studies"] if study["plot"]]
        written = "  ".join(f"{record['output']}/{name}" for name in (*RESULTS, *plots))
        click.echo(f"wrote {written}", err=True)
    if progress.failed:
        raise FramesFailedError(
            f"{progress.failed:,} of {progress.to_do:,} runs failed; {request.output}/sweep.csv"
            " counts the frames missing from each mean; run the same command to retry them"
        )
