"""`pnpdepth sweep`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.batch import LAYOUTS, PROTOCOLS
from pnpdepth_cli.cli.exit_codes import INTERRUPTED
from pnpdepth_cli.cli.progress import BatchProgress
from pnpdepth_cli.errors import FramesFailedError, StorageError
from pnpdepth_cli.pipeline.refinement.request import FrameFiles, MethodOptions, NetworkChoice


@click.command(short_help="Vary the refinement or the points, and plot the errors.")
@click.argument("source", type=options.FILE, metavar="FOLDER|LIST")
@click.option("-o", "--output", type=options.FILE, required=True, help="The folder for results.")
@click.option(
    "--vary",
    multiple=True,
    required=True,
    metavar="NAME=V,V,…",
    help="A parameter and its values; two make a grid.",
)
@click.option("--one-by-one", is_flag=True, help="Vary each alone, the others at their defaults.")
@click.option(
    "--sample",
    metavar="[SENSOR:]N|P%",
    help="Where points come from unless that is varied.  [default: the frames' own]",
)
@click.option(
    "--seeds",
    type=int,
    default=1,
    show_default=True,
    metavar="N",
    help="Draws of the points, the first by --seed.",
)
@click.option("--layout", type=click.Choice(LAYOUTS), help="Of the folder.  [default: guessed]")
@click.option(
    "--protocol",
    type=click.Choice(PROTOCOLS),
    help="What is cut out of the frames first.  [default: the layout's own]",
)
@click.option("--limit", type=int, metavar="N", help="Only the first N frames.")
@click.option("--plots/--no-plots", default=True, help="Pictures, or tables alone.")
@options.scan
@options.options_of_groups(FrameFiles, NetworkChoice, MethodOptions, without=["tile"])
@options.seed
@options.as_json
def sweep(
    source: Path,
    output: Path,
    vary: tuple[str, ...],
    one_by_one: bool,
    sample: str | None,
    seeds: int,
    layout: str | None,
    protocol: str | None,
    limit: int | None,
    plots: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Vary the refinement or the points over frames with ground truth, and plot the errors.

    \b
    pnpdepth sweep frames.csv -o sweep/ --sample 500 --vary iterations=0,1,2,5,10,20
    pnpdepth sweep frames.csv -o sweep/ --seeds 3 --vary points=20,100,500 --vary iterations=0,5,20
    pnpdepth sweep frames.csv -o sweep/ --one-by-one --sample 500 --vary lr=1%,3%,10% \\
        --vary layer=0,0.5,1 --vary loss=l1,l2,log --vary update=sign,adam
    pnpdepth sweep kitti/ -o sweep/ --vary points=1%,3%,10%,30%,100%   # of the LiDAR's
    pnpdepth sweep street/ -o sweep/ --vary sensor=vlp-16,vlp-32c,hdl-32e,hdl-64e

    FOLDER or LIST is what `pnpdepth batch` takes.

    \b
    points      N, or P% of the known pixels, or of the points that a frame or a LiDAR has
    sensor      own; a pattern of `pnpdepth sample` such as grid, grid:500 or lines:16; a LiDAR
                of `pnpdepth simulate` in the camera's place, which needs a calibration
    noise, relative-noise, outliers, jitter
                of the points, as `pnpdepth sample` has them
    rotation-noise
                of a LiDAR, degrees
    iterations, layer, lr, loss, update, schedule, blur, parameters, proximity, align, propagate
                the options of these names

    One --vary makes a table and a picture of itself, two of their grid; with --one-by-one each of
    any number its own. The plain network and linear interpolation of the same points stand beside
    the refined depth. Means are over frames, of each frame's mean over the seeds; intervals (95 %)
    are of the frames. Gains are in per cent, positive where refinement is better.

    OUTPUT has sweep.csv and sweep.json with all means, sweep_frames.csv with every frame, a PNG for
    each picture, and sweep.jsonl, by which the same command, or one with other values, only
    computes what is missing. Plots need the extra pnpdepth[plot].
    """
    from pnpdepth_cli.pipeline.sweep.axes import read_axis, studies_of
    from pnpdepth_cli.pipeline.sweep.points import read_sampling
    from pnpdepth_cli.pipeline.sweep.sweep import SweepRequest, run_sweep

    request = SweepRequest(
        source=source,
        output=output,
        refine=options.request_of(given),
        studies=studies_of([read_axis(text) for text in vary], one_by_one=one_by_one),
        sampling=None if sample is None else read_sampling(sample),
        seeds=seeds,
        layout=layout,
        protocol=protocol,
        limit=limit,
        plots=plots,
    )
    with _Progress() as progress:
        try:
            record = run_sweep(request, progress)
        except StorageError as error:
            raise StorageError(f"{error}; the same command goes on from there") from error
        except KeyboardInterrupt:
            progress.say("stopped; the same command goes on from there")
            raise click.exceptions.Exit(INTERRUPTED) from None
    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        _print(record)
    if progress.failed:
        raise FramesFailedError(
            f"{progress.failed:,} of {progress.to_do:,} runs failed; {output}/sweep.csv counts the"
            " frames that each mean is without, and the same command tries them again"
        )


class _Progress(BatchProgress):
    """How far a sweep is; what is wrong with a frame is said once, though many runs fail of it."""

    def __init__(self) -> None:
        super().__init__("sweep", "run")
        self._said: set[tuple[str, str]] = set()

    def frame(self, row: Mapping[str, Any]) -> None:
        """A run is done, or has failed."""
        self.advance(failed=row["status"] == "failed")
        if row["message"] and (row["name"], row["message"]) not in self._said:
            self._said.add((row["name"], row["message"]))
            self.say(f"{row['status']}: {row['name']}: {row['message']}")


def _print(record: Mapping[str, Any]) -> None:
    """A table for each study on stdout, and where the files are on stderr."""
    from pnpdepth_cli.cli.tables import print_rows

    for study in record["studies"]:
        names = list(study["parameters"])
        print_rows(
            f"{' × '.join(names)}: means over frames, MAE in metres, gains over plain in %",
            [*names, "points used", "frames", "linear", "plain", "refined", "±", "gain", "95 %",
             "RMSE gain", "MRE gain", "δ1 gain"],
            [_cells(names, cell) for cell in study["cells"]],
        )  # fmt: skip
    folder = record["output"]
    files = ["sweep.csv", "sweep.json", "sweep_frames.csv"]
    files += [study["plot"] for study in record["studies"] if study["plot"]]
    click.echo("wrote " + "  ".join(f"{folder}/{name}" for name in files), err=True)


def _cells(names: list[str], cell: Mapping[str, Any]) -> list[str]:
    start = [cell["parameters"][name] for name in names]
    if cell["measures"] is None:
        return [*start, "–", "0", *["–"] * 9]
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
    ]


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:+.1f}"
