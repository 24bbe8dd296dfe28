"""`pnpdepth models`."""

from __future__ import annotations

import json
from dataclasses import asdict

import click

from pnpdepth_cli.cli import options


@click.command(short_help="List the networks that can be named.")
@options.as_json
def models(as_json: bool) -> None:
    """List the networks that can be named: what they take, and their defaults."""
    from pnpdepth_cli.pipeline.models import list_models

    listed = [asdict(model) for model in list_models()]
    if as_json:
        click.echo(json.dumps(listed, indent=2))
        return
    from pnpdepth_cli.cli.tables import print_rows

    print_rows(
        "networks",
        ("name", "takes", "size", "gives", "parameters", "weights", "defaults"),
        [
            (
                f"{model['name']}: {model['summary']}",
                model["input_kind"],
                model["size"],
                model["output_kind"],
                f"{model['parameters']:,}",
                "shipped" if model["checkpoint"] else "--checkpoint",
                f"layer {model['layer']}, K {model['iterations']}, lr {model['lr']},"
                f" {model['loss']}, {model['update']}",
            )
            for model in listed
        ],
    )
