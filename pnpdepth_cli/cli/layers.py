"""`pnpdepth layers`: the options, and the table of layers."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json, progress_bar

if TYPE_CHECKING:
    from pnpdepth_cli.commands.layers import MeasuredLayer


@click.command("layers", short_help="List the layers a network can be cut at.")
@options.model
@options.checkpoint
@click.option(
    "--all", "every", is_flag=True, help="List every submodule, not only the definition's."
)
@options.as_json
def command(model: str, checkpoint: Path | None, every: bool, as_json: bool) -> None:
    """List the layers a network can be cut at.

    For each layer: shape and stride of z, the fraction of the network's cost behind the cut (which
    every update repeats), and the influential field of one sparse point in z and in the depth map.
    """
    from pnpdepth_cli.commands.layers import list_layers

    with progress_bar("layers", "layer") as show:
        listed = list_layers(model, checkpoint, every=every, on_layer=show)
    if as_json:
        print_json([asdict(layer) for layer in listed])
        return
    from pnpdepth_cli.cli.printing import print_table
    from pnpdepth_cli.commands.shared.tables import Table

    columns = ("layer", "z", "stride", "cost\nbehind", "field\nin z", "field\nin depth")
    print_table(Table(title=f"layers of {model}", columns=columns, rows=[*map(_cells, listed)]))


def _cells(layer: MeasuredLayer) -> tuple[str, ...]:
    """The texts of a layer's row: – for what there is not, a problem in the last column."""
    if layer.problem is not None:
        # The message begins with the layer's name and a colon, where it has one.
        reason = layer.problem.partition(": ")[2] or layer.problem
        return (layer.name, "–", "", "", "", reason)
    in_z = layer.field_in_z
    in_depth = layer.field_in_output
    return (
        layer.name,
        "×".join(map(str, layer.shape or ())),
        f"{layer.stride:g}" if layer.stride else "–",
        f"{layer.cost_behind:.0%}" if layer.cost_behind is not None else "–",
        "×".join(map(str, in_z)) if in_z else "–",
        "×".join(map(str, in_depth or ())),
    )
