"""`pnpdepth sweep`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.choices import PLOT_FORMATS
from pnpdepth_cli.cli import grouped_help, options
from pnpdepth_cli.cli.exit_codes import INTERRUPTED
from pnpdepth_cli.cli.progress import BatchProgress
from pnpdepth_cli.errors import FramesFailedError, StorageError
from pnpdepth_cli.pipeline.batch.request import FrameSelection
from pnpdepth_cli.pipeline.refinement.request import FrameFiles, NetworkChoice
from pnpdepth_cli.settings import Settings


@click.command(
    short_help="Vary the refinement or the points, and plot the errors.",
    cls=grouped_help.GroupedCommand,
    common=frozenset(
        {
            *("--vary", "--one-by-one", "--sample", "--seeds", "--layout", "--limit", "--calib"),
            *("--model", "--checkpoint", "--output", "--plots", "--json"),
        }
    ),
    groups={
        "Sweep": ("--vary", "--one-by-one", "--sample", "--seeds", "--seed"),
        "Frames": ("--layout", "--protocol", "--limit"),
        "Input": (*grouped_help.LIDAR, *grouped_help.FILE_READING),
        "Network": grouped_help.NETWORK,
        "Method": tuple(name for name in grouped_help.METHOD if name != "--seed"),
        "Output": ("--output", "--plots", "--plot-format", "--cost", "--json"),
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
    "--one-by-one",
    is_flag=True,
    help="Vary each parameter alone, with the others at their defaults.",
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
    help="Number of random draws of the points; the first uses --seed.",
)
@options.options_of_groups(FrameSelection)
@click.option("--plots/--no-plots", default=True, help="Draw plots, or write tables only.")
@click.option(
    "--plot-format",
    type=click.Choice(PLOT_FORMATS),
    default="png",
    show_default=True,
    help="File format of the plots.",
)
@click.option(
    "--cost", is_flag=True, help="Add the time of the refinement to tables, and a plot over it."
)
@options.scan
@options.options_of_groups(FrameFiles, NetworkChoice, Settings, without=["tile", "time_budget_s"])
@options.as_json
def sweep(
    source: Path,
    output: Path,
    vary: tuple[str, ...],
    one_by_one: bool,
    sample: str | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Vary the refinement or the points over frames with ground truth, and plot the errors.

    \b
    pnpdepth sweep frames.csv -o sweep/ --sample 500 --vary iterations=0,1,2,5,10,20
    pnpdepth sweep frames.csv -o sweep/ --seeds 3 --vary points=20,100,500 --vary iterations=0,5,20
    pnpdepth sweep frames.csv -o sweep/ --one-by-one --sample 500 --vary lr=1%,3%,10% \\
        --vary layer=0,0.5,1 --vary loss=l1,l2,log --vary update=sign,adam
    pnpdepth sweep kitti/ -o sweep/ --vary points=1%,3%,10%,30%,100%   # of the LiDAR's points
    pnpdepth sweep street/ -o sweep/ --vary sensor=vlp-16,vlp-32c,hdl-32e,hdl-64e

    FOLDER or LIST is what `pnpdepth batch` takes.

    \b
    points      N; or P% of the known pixels, of the frame's points or of the LiDAR's points
    sensor      own; a pattern of `pnpdepth sample` such as grid, grid:500 or lines:16; or a LiDAR
                of `pnpdepth simulate` at the camera, which needs a calibration
    noise, relative-noise, outliers, jitter
                noise of the points, as in `pnpdepth sample`
    rotation-noise
                rotation of a LiDAR, degrees
    iterations, layer, lr, loss, update, schedule, blur, parameters, proximity, align, propagate,
    target, mask, mask-scale, mask-fraction
                the options of the same names
    preset, model
                presets of the method; networks, as NETWORK or NETWORK@WEIGHTS
    seed        of the draw of the points, in place of --seeds; from 3 on, a second table has the
                means over seeds with their intervals

    One --vary gives one table and one plot; two give a table and a plot of their grid; with
    --one-by-one every --vary gives its own. Tables compare the refined depth with the network's
    prediction and with linear interpolation of the same points. Means are over frames, after the
    mean over seeds; 95 % intervals are over frames. Gains are in per cent, positive if refinement
    is better.

    OUTPUT gets sweep.csv, sweep.json and sweep.tex (means), sweep_frames.csv (every frame), a plot
    per table, and sweep.jsonl (the journal). Run again, also with other values, only missing values
    are computed. Plots need the extra pnpdepth[plot].
    """
    from pnpdepth_cli.pipeline.sweep.axes import read_axis, studies_of
    from pnpdepth_cli.pipeline.sweep.points import read_sampling
    from pnpdepth_cli.pipeline.sweep.sweep import SweepRequest, run_sweep

    own = options.taken(FrameSelection, values)
    request = SweepRequest(
        source=source,
        output=output,
        studies=studies_of([read_axis(text) for text in vary], one_by_one=one_by_one),
        sampling=None if sample is None else read_sampling(sample),
        seeds=values.pop("seeds"),
        plots=values.pop("plots"),
        plot_format=values.pop("plot_format"),
        cost=values.pop("cost"),
        refine=options.request_of(values),
        **own,
    )
    with _Progress() as progress:
        try:
            record = run_sweep(request, progress)
        except StorageError as error:
            raise StorageError(f"{error}; run the same command to continue") from error
        except KeyboardInterrupt:
            progress.say("stopped; run the same command to continue")
            raise click.exceptions.Exit(INTERRUPTED) from None
    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        _print(record)
    if progress.failed:
        raise FramesFailedError(
            f"{progress.failed:,} of {progress.to_do:,} runs failed; {output}/sweep.csv counts the"
            " frames missing from each mean; run the same command to retry them"
        )


class _Progress(BatchProgress):
    """Progress of a sweep; the same message about the same frame is printed once."""

    def __init__(self) -> None:
        super().__init__("sweep", "run")
        self._printed: set[tuple[str, str]] = set()

    def frame(self, row: Mapping[str, Any]) -> None:
        """Counts a run that is done or has failed."""
        self.advance(failed=row["status"] == "failed")
        if row["message"] and (row["name"], row["message"]) not in self._printed:
            self._printed.add((row["name"], row["message"]))
            self.say(f"{row['status']}: {row['name']}: {row['message']}")


def _print(record: Mapping[str, Any]) -> None:
    """Prints a table per study on stdout, and the names of the files on stderr."""
    from pnpdepth_cli.cli.tables import print_rows

    for study in record["studies"]:
        names = list(study["parameters"])
        cost = any("time_s" in cell for cell in study["cells"])
        print_rows(
            f"{' × '.join(names)}: means over frames, MAE in metres, gains over plain in %",
            [*names, "points used", "frames", "linear", "plain", "refined", "±", "gain", "95 %",
             "RMSE gain", "MRE gain", "δ1 gain", *(["time [s]"] if cost else [])],
            [_cells(names, cell) for cell in study["cells"]],
        )  # fmt: skip
        _print_over_seeds(study)
    folder = record["output"]
    files = ["sweep.csv", "sweep.json", "sweep.tex", "sweep_frames.csv"]
    files += [study["plot"] for study in record["studies"] if study["plot"]]
    click.echo("wrote " + "  ".join(f"{folder}/{name}" for name in files), err=True)


def _print_over_seeds(study: Mapping[str, Any]) -> None:
    """Prints the means over the draws of the points, where seeds were varied."""
    from pnpdepth_cli.cli.tables import print_rows

    rows = study["over_seeds"]
    if not rows:
        return
    others = list(rows[0]["parameters"])
    print_rows(
        "over seeds of the points: mean MAE in metres with its 95 % interval over draws, gain in %",
        [*others, "seeds", "linear", "plain", "refined", "gain"],
        [
            [
                *(row["parameters"][name] for name in others),
                str(row["seeds"]),
                *(
                    _with_interval(row["mae"][name], ".4f")
                    for name in ("linear", "plain", "refined")
                ),
                _with_interval(row["mae"]["gain"], "+.1f"),
            ]
            for row in rows
        ],
    )


def _with_interval(value: Mapping[str, float | None], form: str) -> str:
    if value["mean"] is None:
        return "–"
    return f"{value['mean']:{form}} [{value['low']:{form}}, {value['high']:{form}}]"


def _cells(names: list[str], cell: Mapping[str, Any]) -> list[str]:
    start = [cell["parameters"][name] for name in names]
    time = [] if "time_s" not in cell else [_seconds(cell["time_s"])]
    if cell["measures"] is None:
        return [*start, "–", "0", *["–"] * 9, *time]
    mae = cell["measures"]["mae"]
    low, high = mae["refined_low"], mae["refined_high"]
    return [
        *start,
        f"{cell['points']:,.0f}",
        f"{cell['frames']:,}" + (f", {cell['diverged']:,} diverged" if cell["diverged"] else ""),
        *(f"{mae[name]:.4f}" for name in ("linear", "plain", "refined")),
        "–" if low is None else f"{(high - low) / 2:.4f}",
        _percent(mae["gain"]),
        "–" if low is None else f"{_percent(mae['gain_low'])} … {_percent(mae['gain_high'])}",
        *(_percent(cell["measures"][key]["gain"]) for key in ("rmse", "mre", "delta1")),
        *time,
    ]


def _seconds(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:+.1f}"
