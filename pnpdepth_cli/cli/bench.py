"""`pnpdepth bench`."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from pnpdepth_cli.cli import grouped_help, options
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.cli.progress import progress_bar
from pnpdepth_cli.errors import UsageError

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.bench import Bench, BenchPart, PaperTime


@click.command(
    short_help="Measure the run time of a refinement on this machine.",
    cls=grouped_help.GroupedCommand,
    groups={
        "Input": ("--size", "--points"),
        "Network": grouped_help.NETWORK,
        "Method": grouped_help.METHOD,
        "Run": ("--repeats", "--table"),
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
    "--points", type=int, default=500, show_default=True, metavar="N", help="Number of points."
)
@click.option("--iterations", type=int, metavar="K", help="Number of updates of z.")
@options.target
@options.precision
@options.device
@click.option(
    "--repeats", type=int, default=10, show_default=True, metavar="N", help="Runs of each part."
)
@click.option(
    "--table",
    is_flag=True,
    help="Measure the paper's seven networks, beside its Table IV.",
)
@options.as_json
def bench(size: str | None, repeats: int, table: bool, as_json: bool, **values: Any) -> None:
    """Measure the run time of a refinement on this machine, by part and in forward passes.

    \b
    pnpdepth bench
    pnpdepth bench --model net.onnx --layer Relu_315 --size 480x640
    pnpdepth bench --precision bf16
    pnpdepth bench --table --repeats 5

    The frame is synthetic; a network without weights gets random ones. The parts run alternately.
    The table has median, quartiles, and median in forward passes. The limit is the least cost of K
    updates: (front + (2K+1) rear) / (front + rear). Memory is the peak of a part beyond the memory
    in use before it.
    """
    if repeats < 1:
        raise UsageError(f"repeats {repeats}: there must be at least one")
    if table:
        if values["target"] != "given":
            raise UsageError("--table measures the paper's updates and not --target masked")
        refused = {"--size": size} | {
            f"--{name}": values[name] for name in ("checkpoint", "layer", "iterations")
        }
        if clash := [name for name, value in refused.items() if value is not None]:
            raise UsageError(
                f"--table measures the paper's networks and cannot be combined with {clash[0]}"
            )
        _table(repeats, values["precision"], values["device"], as_json)
        return
    from pnpdepth_cli.pipeline.bench import BenchRequest, run_bench

    request = BenchRequest(
        size=options.height_and_width(size) if size else None, repeats=repeats, **values
    )
    with progress_bar("bench", "round") as show:
        result = run_bench(request, on_round=show)
    if as_json:
        click.echo(json.dumps(asdict(result), indent=2))
        return
    _print(result)


def _print(result: Bench) -> None:
    from pnpdepth_cli.cli.tables import print_rows

    _print_notes(result)
    height, width = result.size
    print_rows(
        f"{result.model} cut at {result.layer}, {width}×{height}, {result.points:,} points,"
        f" K = {result.iterations}, {result.precision}",
        ("", "median", "quartiles", "× forward", "memory"),
        [_cells(part) for part in result.parts],
    )
    limits = [f"{result.limit_measured:.2f} by the times of front and rear"]
    if result.limit_by_flops is not None:
        limits.append(f"{result.limit_by_flops:.2f} by counts of operations")
    refinement = result.part("refinement").forwards
    click.echo(
        f"a refinement takes {refinement:.2f} forward passes; the limit is {', '.join(limits)}"
    )
    if result.depth_change is not None:
        click.echo(f"depth differs from fp32 by {result.depth_change:.3%} on average")


def _cells(part: BenchPart) -> tuple[str, ...]:
    seconds = part.seconds
    return (
        part.name,
        _ms(seconds.median),
        f"{1000 * seconds.lower:,.1f}–{_ms(seconds.upper)}",
        f"{part.forwards:.2f}",
        "" if part.peak_mb is None else f"{part.peak_mb:,.0f} MB",
    )


def _table(repeats: int, precision: str, device: str, as_json: bool) -> None:
    from pnpdepth_cli.pipeline.bench import bench_table, table_record

    with progress_bar("bench", "network") as show:
        rows = bench_table(repeats=repeats, precision=precision, device=device, on_network=show)
    if as_json:
        click.echo(json.dumps(table_record(rows), indent=2))
        return
    from pnpdepth_cli.cli.tables import print_rows

    print_rows(
        f"Table IV: random weights, K = 5, {precision}, {device}, {rows[0][1].threads} threads,"
        f" medians of {repeats}; beside the paper's figures",
        (
            "network",
            "paper's\nname",
            "size",
            "forward",
            "refinement",
            "×",
            "limit\n(times)",
            "limit\n(counts)",
            "memory",
            "paper,\nforward",
            "paper,\nrefinement",
            "paper,\n×",
        ),
        [_row_cells(paper, bench) for paper, bench in rows],
    )


def _row_cells(paper: PaperTime, bench: Bench) -> tuple[str, ...]:
    refinement, forward = bench.part("refinement"), bench.part("forward")
    flops, memory = bench.limit_by_flops, refinement.peak_mb
    printed = (paper.before, paper.after)
    return (
        paper.model,
        f"{paper.name}, {paper.data}",
        f"{paper.size[1]}×{paper.size[0]}",
        _ms(forward.seconds.median),
        _ms(refinement.seconds.median),
        f"{refinement.forwards:.2f}",
        f"{bench.limit_measured:.2f}",
        "–" if flops is None else f"{flops:.2f}",
        "–" if memory is None else f"{memory:,.0f} MB",
        *("–" if seconds is None else _ms(seconds) for seconds in printed),
        "–" if paper.forwards is None else f"{paper.forwards:.2f}",
    )


def _print_notes(bench: Bench) -> None:
    threads = f"{bench.threads} thread{'' if bench.threads == 1 else 's'}"
    click.echo(f"{bench.device}, {threads}, torch {bench.versions['torch']}", err=True)
    for note in bench.notes:
        click.echo(printable(note), err=True)


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:,.1f} ms"
