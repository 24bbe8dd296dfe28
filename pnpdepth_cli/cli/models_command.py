"""`pnpdepth models` and its subcommands, `pnpdepth layers` and `doctor`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json, progress_bar
from pnpdepth_cli.commands.refinement.refine_request import NetworkChoice


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
    keys = ("name", "input_kind", "size", "output_kind")
    defaults = "layer {layer}, K {iterations}, lr {lr}, {loss}, {update}"
    rows = [
        (
            *(each[key] for key in keys),
            f"{each['parameters']:,}",
            "shipped" if each["checkpoint"] else "yours",
            defaults.format(**each),
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
def layers(every: bool, as_json: bool, **values: Any) -> None:
    """List the layers a network can be cut at.

    For each layer: shape and stride of z, the fraction of the network's cost behind the cut (which
    every update repeats), and the influential field of one sparse point in z and in the depth map.
    """
    from pnpdepth_cli.commands.networks import list_layers

    choice = NetworkChoice(**values)
    with progress_bar("layers", "layer") as show:
        rows = [asdict(row) for row in list_layers(choice, every=every, on_layer=show)]
    if as_json:
        print_json(rows)
        return
    from pnpdepth_cli.cli.printing import print_table
    from pnpdepth_cli.commands.tables import Table

    columns = ("layer", "z", "stride", "cost\nbehind", "field\nin z", "field\nin depth")
    title = f"layers of {choice.model}"
    print_table(Table(title=title, columns=columns, rows=[_cells(row) for row in rows]))


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    if row["problem"]:
        reason = row["problem"].partition(": ")[2] or row["problem"]
        return (row["name"], "–", *[""] * 3, reason)
    return (
        row["name"],
        "×".join(str(n) for n in row["shape"]),
        f"{row['stride']:g}" if row["stride"] else "–",
        f"{row['cost_behind']:.0%}" if row["cost_behind"] is not None else "–",
        "{}×{}".format(*row["field_in_z"]) if row["field_in_z"] else "–",
        "{}×{}".format(*row["field_in_output"]),
    )


@click.command(short_help="Show versions, devices and extras, and test the installation.")
def doctor() -> None:
    """Show versions, devices, memory and extras, and refine a small frame.

    Paste the output into a bug report. It contains no names of files or users.
    """
    from pnpdepth_cli.commands.doctor import examine

    report = examine()
    for name, value in report.items():
        for number, line in enumerate(value if isinstance(value, list) else [value]):
            click.echo(f"{'' if number else name:<12}{line}")
    if str(report["self-test"]).startswith("FAILED"):
        click.get_current_context().exit(1)
