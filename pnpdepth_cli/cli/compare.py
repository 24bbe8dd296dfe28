"""`pnpdepth compare`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from pnpdepth_cli.cli import options


@click.command(short_help="Compare runs that eval or batch scored.")
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN…")
@click.option(
    "--bootstrap",
    "resamples",
    type=int,
    default=10_000,
    show_default=True,
    metavar="N",
    help="Resamples behind the intervals, and swaps behind the p-values.",
)
@click.option("--seed", type=options.SEED, default=0, show_default=True, help="Of both.")
@click.option(
    "--no-groups",
    is_flag=True,
    help="Treat all frames as independent, also those of one sequence or group.",
)
@click.option("--csv", type=options.FILE, metavar="FILE|-", help="The table as CSV.")
@click.option("--markdown", type=options.FILE, metavar="FILE|-", help="The table as Markdown.")
@click.option("--latex", type=options.FILE, metavar="FILE|-", help="The table as a tabular.")
@options.overwrite
@options.as_json
def compare(
    runs: tuple[str, ...],
    resamples: int,
    seed: int,
    no_groups: bool,
    csv: Path | None,
    markdown: Path | None,
    latex: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare RUNs with the first of them, on the frames that all of them scored.

    \b
    pnpdepth compare runs/a.json runs/b.json
    pnpdepth compare out/summary.json:before out/summary.json

    A RUN is what `pnpdepth eval --json` printed, or a batch's summary or a refinement's record
    with ground truth, of which the result is meant, or with :before what it started from. Gains
    are in per cent of the first run, and positive where the other is better. p is the probability
    of so large a difference if the runs are equally good: the two are swapped in whole sequences
    or groups of frames, in all ways where there are few, else in N random ones; in a single
    sequence, in blocks as long as its errors are correlated. p is adjusted for the number of
    measures.
    """
    from pnpdepth_cli.cli import score_tables
    from pnpdepth_cli.pipeline.evaluation import score_files
    from pnpdepth_cli.pipeline.evaluation.compare import CompareRequest
    from pnpdepth_cli.pipeline.evaluation.compare import compare as compare_runs

    targets = (csv, markdown, latex)
    score_tables.check_stdout(targets, as_json)
    score_files.check_targets(targets, [Path(run) for run in runs], overwrite=overwrite)
    comparison = compare_runs(
        CompareRequest(paths=runs, resamples=resamples, seed=seed, grouped=not no_groups)
    )
    score_tables.print_notes(comparison.notes)
    table = score_files.comparison_table(comparison)
    caption = score_files.comparison_caption(comparison)
    texts = (
        (csv, score_files.csv_text(*table)),
        (markdown, score_files.markdown_text(*table, caption)),
        (latex, score_files.latex_text(*table, caption)),
    )
    to_stdout = score_tables.write_texts(texts)
    if as_json:
        click.echo(json.dumps(comparison.as_record(), indent=2))
    elif not to_stdout:
        score_tables.print_comparison(comparison)
