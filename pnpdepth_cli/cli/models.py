"""`pnpdepth models` and its subcommands, `pnpdepth layers` and `doctor`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json, progress_bar

if TYPE_CHECKING:
    from pnpdepth_cli.commands.networks import MeasuredLayer


@click.group(short_help="List or check networks.", invoke_without_command=True)
@options.as_json
@click.pass_context
def models(context: click.Context, as_json: bool) -> None:
    """List the networks that --model takes by name, with their inputs, outputs and defaults.

    \b
    pnpdepth models
    pnpdepth models check net.onnx --image img.png
    """
    if context.invoked_subcommand is not None:
        return
    from pnpdepth_cli.commands.networks import list_models

    listed = list_models()
    if as_json:
        print_json(listed)
        return
    from pnpdepth_cli.cli.printing import print_table
    from pnpdepth_cli.commands.tables import Table

    columns = ("name", "takes", "size", "gives", "params", "weights", "defaults")
    rows = [
        (
            *(each[key] for key in ("name", "input_kind", "size", "output_kind")),
            f"{each['parameters']:,}",
            "shipped" if each["checkpoint"] else "yours",
            "layer {layer}, K {iterations}, lr {lr}, {loss}, {update}".format(**each),
        )
        for each in listed
    ]
    print_table(Table(title="networks", columns=columns, rows=rows))


@models.command(short_help="Load a network, run it and cut it at its layers.")
@click.argument("network", metavar="NAME|FILE|FOLDER")
@click.option("--image", type=options.FILE, help="Image to run the network on.")
@options.checkpoint
def check(network: str, image: Path | None, checkpoint: Path | None) -> None:
    """Load a network, run it, and cut it at its layers; print what was found as JSON.

    A .py file is Python code and is run.
    """
    from pnpdepth_cli.commands.networks import check_model

    print_json(check_model(network, checkpoint, image))


@click.command(short_help="List the layers a network can be cut at.")
@options.model
@options.checkpoint
@click.option(
    "--all", "every", is_flag=True, help="List every submodule, not only the definition's."
)
@options.as_json
def layers(model: str, checkpoint: Path | None, every: bool, as_json: bool) -> None:
    """List the layers a network can be cut at.

    For each layer: shape and stride of z, the fraction of the network's cost behind the cut (which
    every update repeats), and the influential field of one sparse point in z and in the depth map.
    """
    from pnpdepth_cli.commands.networks import list_layers

    with progress_bar("layers", "layer") as show:
        listed = list_layers(model, checkpoint, every=every, on_layer=show)
    if as_json:
        print_json([asdict(layer) for layer in listed])
        return
    from pnpdepth_cli.cli.printing import print_table
    from pnpdepth_cli.commands.tables import Table

    columns = ("layer", "z", "stride", "cost\nbehind", "field\nin z", "field\nin depth")
    print_table(Table(title=f"layers of {model}", columns=columns, rows=[*map(_cells, listed)]))


def _cells(layer: MeasuredLayer) -> tuple[str, ...]:
    if layer.problem is not None:
        return (layer.name, "–", *[""] * 3, layer.problem.partition(": ")[2] or layer.problem)
    in_z, in_depth = layer.field_in_z, layer.field_in_output
    return (
        layer.name,
        "×".join(map(str, layer.shape or ())),
        f"{layer.stride:g}" if layer.stride else "–",
        f"{layer.cost_behind:.0%}" if layer.cost_behind is not None else "–",
        "×".join(map(str, in_z)) if in_z else "–",
        "×".join(map(str, in_depth or ())),
    )


@click.command(short_help="Show versions, devices and extras, and test the installation.")
@click.option(
    "--clear-cache", is_flag=True, help="Forget what was decided about networks in earlier runs."
)
def doctor(clear_cache: bool) -> None:
    """Show versions, devices, memory and extras, and refine a small frame.

    Paste the output into a bug report. It contains no names of files or users.
    """
    from pnpdepth_cli.commands.doctor import examine

    report = examine(clear_cache=clear_cache)
    for name, lines in report.items():
        click.echo(f"{name:<12}" + f"\n{'':<12}".join(lines))
    if report["self-test"][0].startswith("FAILED"):
        click.get_current_context().exit(1)
