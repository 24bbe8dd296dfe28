"""`pnpdepth adapt`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.streams import print_json, say
from pnpdepth_cli.commands.batch.request import AdaptRequest
from pnpdepth_cli.commands.refinement.request import parse_sample


@click.command(short_help="Adapt a network to the sparse points of a folder.")
@click.argument("source", type=options.FILE, metavar="FOLDER|LIST")
@click.option(
    "-o", "--output", type=options.FILE, required=True, help="File NAME.safetensors to write."
)
@options.sample
@options.options_of_groups(AdaptRequest)
@options.model
@options.checkpoint
@options.device
@options.seed
@options.depth_scale
@options.scan
@options.overwrite
@options.as_json
def adapt(source: Path, output: Path, sample: str | None, as_json: bool, **values: Any) -> None:
    """Adapt the weights of a network to the frames of FOLDER, without ground truth.

    \b
    pnpdepth adapt drive_0001/ -o adapted.safetensors
    pnpdepth batch drive_0001/ -o out/ --checkpoint adapted.safetensors

    Some points of a frame are hidden from the network's input, and the weights learn to predict
    them. The network must take sparse depth. Every tenth frame is for validation: the weights with
    the smallest loss at its hidden points are written, with a model card beside them.
    """
    from pnpdepth_cli.cli.progress import progress_bar
    from pnpdepth_cli.commands.adapt import adapt as adapt_network

    own = options.taken(AdaptRequest, values)
    refine = options.request_of(values, sample=parse_sample(sample))
    request = AdaptRequest(source=source, output=output, refine=refine, **own)
    with progress_bar("adapt", "update") as show:
        adapted = adapt_network(request, say, show)
    if as_json:
        print_json(adapted)
        return
    before, after = adapted["losses"][0], adapted["losses"][adapted["kept"]]
    click.echo(
        f"loss at hidden points of the frames for validation ({adapted['validation_frames']}):"
        f" {before:.5f} → {after:.5f} ({adapted['change']:+.1%}), after {adapted['kept']} updates"
    )
    say(f"wrote {request.output} and {request.card}")
