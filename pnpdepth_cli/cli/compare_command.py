"""`pnpdepth compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json
from pnpdepth_cli.measures import parse_keys


@click.command(short_help="Compare runs that eval or batch scored.")
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN…")
@click.option("--csv", type=options.FILE, metavar="FILE|-", help="Write the table as CSV.")
@click.option(
    "--latex",
    type=options.FILE,
    metavar="FILE|-",
    help="Write a tabular of runs × measures: the best in bold, * where p < 0.05.",
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
    runs: tuple[str, ...], columns: tuple[str, ...] | None, plot: Path | None, **table_files: Any
) -> None:
    """Compare RUNs with the first of them, on the frames that all of them scored.

    \b
    pnpdepth compare runs/a.json runs/b.json
    pnpdepth compare out/summary.json:before out/summary.json
    pnpdepth compare study/*/ --columns mae --plot mae.png

    A RUN is the output of `pnpdepth eval --json`, or the folder or summary.json of a batch.
    FILE:before takes the depth before refinement. Gains are in per cent of the first run, and
    positive if the other run is better.

    p is the p-value of a paired permutation test over groups of frames: manifest column group,
    sequence or folder. In a single sequence the groups are blocks as long as its errors are
    correlated. p is adjusted for the number of measures and runs (Holm). It is exact for few
    groups, else computed with random permutations.
    """
    from pnpdepth_cli.cli.printing import TableFiles, print_notes, print_table
    from pnpdepth_cli.commands.evaluation import compare as command
    from pnpdepth_cli.commands.evaluation.plot import plot_comparison

    files = TableFiles(**table_files)
    files.check([Path(run) for run in runs])
    comparison = command.compare(runs, columns=columns)
    if plot is not None:
        plot_comparison(comparison, plot, overwrite=files.overwrite)
    print_notes(comparison.notes)
    table = command.comparison_table(comparison)
    to_stdout = files.write(table, command.methods_table(comparison))
    if files.as_json:
        print_json(comparison.to_json())
    elif not to_stdout:
        print_table(table)
