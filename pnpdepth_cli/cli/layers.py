"""`pnpdepth layers`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.progress import progress_bar
from pnpdepth_cli.commands.refinement.request import NetworkChoice


@click.command(short_help="List the layers a network can be cut at.")
@options.model
@options.checkpoint
@click.option(
    "--all", "every", is_flag=True, help="List every submodule, not only the definition's."
)
@click.option("--size", metavar="HxW", help="Size of the frame to measure with.")
@click.option(
    "--sparse",
    type=options.FILE,
    help="Rank the layers for the point density of this sparse depth.",
)
@options.device
@options.as_json
def layers(
    size: str | None, every: bool, sparse: Path | None, as_json: bool, **values: Any
) -> None:
    """List the layers a network can be cut at.

    For each layer: shape and stride of z, the fraction of the network's cost behind the cut (which
    every update repeats), and the influential field of one sparse point in z and in the depth map.
    """
    from pnpdepth_cli.commands.networks.describe import list_layers

    choice = NetworkChoice(**values)
    with progress_bar("layers", "layer") as show:
        result = list_layers(
            choice,
            every=every,
            size=options.height_and_width(size) if size else None,
            sparse=sparse,
            on_layer=show,
        )
    if as_json:
        click.echo(json.dumps([asdict(row) for row in result.rows], indent=2))
        return
    from pnpdepth_cli.cli.tables import print_rows

    fields = ("field\nin z", "field\nin depth")
    spacing = "" if result.spacing is None else f", points {result.spacing:.3g} pixels apart"
    print_rows(
        f"layers of {choice.model}{spacing}",
        ("layer", "z", "stride", "params", "cost\nbehind", "time\nbehind", *fields, "rank"),
        [_cells(asdict(row)) for row in result.rows],
    )


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    if row["problem"]:
        reason = row["problem"].partition(": ")[2] or row["problem"]
        return (row["name"], "–", *[""] * 5, reason)
    return (
        row["name"],
        "×".join(str(n) for n in row["shape"]),
        f"{row['stride']:g}" if row["stride"] else "–",
        f"{row['parameters'] / 1000:,.0f} k",
        f"{row['cost_behind']:.0%}" if row["cost_behind"] is not None else "–",
        f"{1000 * row['seconds_behind']:.0f} ms",
        "{}×{}".format(*row["field_in_z"]) if row["field_in_z"] else "–",
        "{}×{}".format(*row["field_in_output"]),
        str(row["rank"] or ""),
    )
