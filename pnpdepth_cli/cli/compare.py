"""`pnpdepth compare`: the options, and the tables of compared runs."""

from __future__ import annotations

from pathlib import Path

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json
from pnpdepth_cli.measures import parse_keys


@click.command("compare", short_help="Compare runs that eval or batch scored.")
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
def command(
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
    from pnpdepth_cli.commands.compare import compare
    from pnpdepth_cli.commands.comparisons.comparison_plot import plot_comparison
    from pnpdepth_cli.commands.comparisons.comparison_tables import (
        comparison_table,
        comparison_values,
        methods_table,
    )

    # All that can be wrong is found before anything is compared.
    inputs = [Path(run) for run in runs]
    check_tables(csv, latex, inputs=inputs, overwrite=overwrite, as_json=as_json)
    comparison = compare(runs, columns=columns)
    if plot is not None:
        plot_comparison(comparison, plot, overwrite=overwrite)
    print_notes(comparison.notes)
    # The comparison, as tables and as JSON.
    is_stdout_taken = write_tables(
        {csv: comparison_values(comparison).csv(), latex: methods_table(comparison).latex()}
    )
    if as_json:
        print_json(comparison.to_json())
    elif not is_stdout_taken:
        print_table(comparison_table(comparison))
