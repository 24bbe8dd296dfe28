"""`pnpdepth bench`."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.cli import grouped_help, options
from pnpdepth_cli.cli.progress import progress_bar
from pnpdepth_cli.cli.streams import print_json, say
from pnpdepth_cli.commands.refinement.request import NetworkChoice
from pnpdepth_cli.settings import Settings


@click.command(
    short_help="Measure the run time of a refinement on this machine.",
    cls=grouped_help.GroupedCommand,
    groups={
        "Input": ("--size", "--points"),
        "Network": (NetworkChoice, "--precision"),
        "Method": (Settings,),
        "Run": ("--repeats",),
        "Output": ("--json",),
    },
)
@options.model
@options.checkpoint
@options.layer
@click.option(
    "--size", metavar="HxW", help="Size of the frame.  [default: 480x640, or the network's]"
)
@click.option(
    "--points",
    type=click.IntRange(1),
    default=500,
    show_default=True,
    metavar="N",
    help="Number of points.",
)
@click.option("--iterations", type=int, metavar="K", help="Number of updates of z.")
@options.precision
@options.device
@click.option(
    "--repeats",
    type=click.IntRange(1),
    default=10,
    show_default=True,
    metavar="N",
    help="Runs of each part.",
)
@options.as_json
def bench(size: str | None, as_json: bool, **values: Any) -> None:
    """Measure the run time of a refinement on this machine, by part and in forward passes.

    \b
    pnpdepth bench
    pnpdepth bench --model net.onnx --layer Relu_315 --size 480x640
    pnpdepth bench --precision bf16

    The frame is synthetic; a network without weights gets random ones. The parts run alternately.
    The table has median, quartiles, and median in forward passes. The limit is the least cost of K
    updates: (front + (2K+1) rear) / (front + rear). Memory is the peak of a part beyond the memory
    in use before it.
    """
    from pnpdepth_cli.commands.bench import run_bench

    values["size"] = options.height_and_width(size) if size else None
    with progress_bar("bench", "round") as show:
        result = run_bench(**values, on_round=show)
    if as_json:
        print_json(result)
    else:
        _print(result)


def _print(result: dict[str, Any]) -> None:
    from pnpdepth_cli.cli.tables import print_rows

    threads = f"{result['threads']} thread{'' if result['threads'] == 1 else 's'}"
    click.echo(f"{result['device']}, {threads}, torch {result['versions']['torch']}", err=True)
    for note in result["notes"]:
        say(note)
    height, width = result["size"]
    print_rows(
        f"{result['model']} cut at {result['layer']}, {width}×{height}, {result['points']:,}"
        f" points, K = {result['iterations']}, {result['precision']}",
        ("", "median", "quartiles", "× forward", "memory"),
        [
            (
                name,
                _ms(part["median_s"]),
                f"{1000 * part['lower_s']:,.1f}–{_ms(part['upper_s'])}",
                f"{part['forwards']:.2f}",
                "" if part["peak_mb"] is None else f"{part['peak_mb']:,.0f} MB",
            )
            for name, part in result["parts"].items()
        ],
    )
    click.echo(
        f"a refinement takes {result['parts']['refinement']['forwards']:.2f} forward passes; the"
        f" limit is {result['limit']:.2f}"
    )


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:,.1f} ms"
