"""`pnpdepth sample`: the options, and what is printed of sampled points."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.commands.requests.refine_request import parse_sample


@click.command("sample", short_help="Sample sparse depth from dense depth.")
@click.argument("depth", type=options.FILE)
@click.option(
    "--count",
    "pattern",
    type=parse_sample,
    required=True,
    metavar="[PATTERN:]N|P%",
    help="Number of points (of lines for `lines`), or % of known pixels.",
)
@click.option("--image", type=options.FILE, help="Image for `features`.")
@options.seed
@options.sparse_files
def command(**values: Any) -> None:
    """Sample sparse depth from the dense DEPTH.

    \b
    pnpdepth sample gt.png --count 500 --seed 1 -o sparse.png
    pnpdepth sample gt.png --count features:300 --image rgb.png -o sparse.png

    \b
    uniform    N random known pixels; the default pattern
    shuffle    the first N known pixels as numpy's legacy generator shuffles them
    grid       square grid with N nodes on a full map
    lines      all known pixels of N evenly spaced rows
    features   the N strongest ORB corners, as in structure from motion

    A JSON file beside the output records the settings.
    """
    from pnpdepth_cli.cli.printing import print_sparse
    from pnpdepth_cli.commands.sample import sample_depth

    print_sparse(sample_depth(**values))
