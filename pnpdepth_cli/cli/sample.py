"""`pnpdepth sample`."""

from __future__ import annotations

import json
from typing import Any

import click

from pnpdepth_cli.choices import PATTERNS
from pnpdepth_cli.cli import options
from pnpdepth_cli.errors import UsageError

_NOISE = {
    "metres": "noise",
    "relative": "relative_noise",
    "outliers": "outliers",
    "jitter_px": "jitter",
}
"""Options by the kind of noise that they set."""


@click.command(short_help="Sample sparse depth from dense depth.")
@click.argument("depth", type=options.FILE)
@click.option("--pattern", type=click.Choice(PATTERNS), default="uniform", show_default=True)
@click.option(
    "--count", metavar="N|P%", help="Number of points (of lines for `lines`), or % of known pixels."
)
@click.option("--region", metavar="X,Y,W,H", help="Rectangle of the pattern `region`.")
@click.option("--image", type=options.FILE, help="Image for `features` and `edges`.")
@click.option(
    "--seed", type=options.SEED, default=0, show_default=True, metavar="N", help="Random seed."
)
@click.option("--noise", type=float, default=0.0, metavar="M", help="Gaussian noise, metres.")
@click.option(
    "--relative-noise",
    type=float,
    default=0.0,
    metavar="F",
    help="Gaussian noise, as a fraction of the depth.",
)
@click.option(
    "--outliers", type=float, default=0.0, metavar="F", help="Fraction of points of random depth."
)
@click.option(
    "--jitter",
    type=float,
    default=0.0,
    metavar="PX",
    help="Gaussian noise of the pixel coordinates.",
)
@options.depth_scale
@options.channel
@options.max_pixels
@options.sparse_output
@options.output_scale
@click.option("--overlay", type=options.FILE, help="Also write a PNG of the points on --image.")
@options.overwrite
@options.as_json
def sample(count: str | None, region: str | None, as_json: bool, **values: Any) -> None:
    """Sample sparse depth from the dense DEPTH.

    \b
    pnpdepth sample gt.png --pattern uniform --count 500 --seed 1 -o sparse.png
    pnpdepth sample gt.png --pattern lines --count 16 -o sparse.exr
    pnpdepth sample gt.png --pattern features --count 300 --image rgb.png -o sparse.png

    \b
    uniform    N random known pixels
    bernoulli  each known pixel with the same probability; N is the expected number
    grid       square grid with N nodes on a full map
    lines      all known pixels of N evenly spaced rows
    features   the N strongest ORB corners, as in structure from motion
    edges      N random pixels on image edges
    region     all known pixels of a rectangle, or N random ones

    The settings, with the seed, are stored in the file (PNG, CSV) and in a JSON file beside it.
    """
    from pnpdepth_cli.cli.tables import print_sparse
    from pnpdepth_cli.pipeline.sparse.sample import SampleRequest, sample_depth

    points, fraction = options.count_or_fraction(count)
    target = options.sparse_target(values)
    noise = {key: values.pop(name) for key, name in _NOISE.items()}
    record = sample_depth(
        SampleRequest(
            target=target,
            count=points,
            fraction=fraction,
            region=_region(region) if region else None,
            noise=noise,
            **values,
        )
    )
    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        print_sparse(record)


def _region(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, width, height = (int(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"region {text!r} is not of the form X,Y,WIDTH,HEIGHT") from None
    return left, top, width, height
