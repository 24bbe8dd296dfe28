"""`pnpdepth models` and `pnpdepth models check`: the options, and the table of networks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json


@click.group("models", short_help="List or check networks.", invoke_without_command=True)
@options.as_json
@click.pass_context
def command(context: click.Context, as_json: bool) -> None:
    """List the networks that --model takes by name, with their inputs, outputs and defaults.

    \b
    pnpdepth models
    pnpdepth models check net.onnx --image img.png
    """
    if context.invoked_subcommand is not None:
        return
    from pnpdepth_cli.commands.models import list_models

    listed = list_models()
    if as_json:
        print_json(listed)
        return
    from pnpdepth_cli.cli.printing import print_table
    from pnpdepth_cli.commands.shared.tables import Table

    columns = ("name", "takes", "size", "gives", "params", "weights", "defaults")
    print_table(Table(title="networks", columns=columns, rows=[*map(_cells, listed)]))


def _cells(network: Mapping[str, object]) -> tuple[object, ...]:
    """The row of a network, of its values by `list_models`; weights are shipped or the user's."""
    return (
        network["name"],
        network["input_kind"],
        network["size"],
        network["output_kind"],
        f"{network['parameters']:,}",
        "shipped" if network["checkpoint"] else "yours",
        "layer {layer}, K {iterations}, lr {lr}, {loss}, {update}".format(**network),
    )


@command.command("check", short_help="Load a network, run it and cut it at its layers.")
@click.argument("network", metavar="NAME|FILE|FOLDER")
@click.option("--image", type=options.FILE, help="Image to run the network on.")
@options.checkpoint
def check(network: str, image: Path | None, checkpoint: Path | None) -> None:
    """Load a network, run it, and cut it at its layers; print what was found as JSON.

    A .py file is Python code and is run.
    """
    from pnpdepth_cli.commands.models import check_model

    print_json(check_model(network, checkpoint, image))
