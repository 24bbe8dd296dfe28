"""`pnpdepth models`."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.errors import UsageError


@click.command(short_help="List the networks that can be named; check, convert or fetch one.")
@click.option("--check", metavar="NAME|FILE|FOLDER", help="Load a network, run it, cut it.")
@click.option("--image", type=options.FILE, help="For --check: a picture to run it on.")
@options.checkpoint
@click.option(
    "--convert",
    type=(options.FILE, options.FILE),
    metavar="IN OUT",
    help="Take the tensors of a published checkpoint out, as OUT.safetensors.",
)
@click.option("--fetch", metavar="ORG/NAME", help="Download a network from Hugging Face.")
@click.option("--revision", metavar="REV", help="For --fetch: a branch, tag or commit.")
@click.option("-o", "--output", type=options.FILE, help="For --fetch: the folder.")
@click.option("--all", "every", is_flag=True, help="List every variant of a network.")
@options.overwrite
@options.device
@options.as_json
def models(
    check: str | None,
    convert: tuple[Path, Path] | None,
    fetch: str | None,
    every: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """List the networks that can be named: what they take, and their defaults.

    \b
    pnpdepth models --check net.onnx --image img.png
    pnpdepth models --convert model_best.pth.tar weights.safetensors
    pnpdepth models --fetch depth-anything/Depth-Anything-V2-Small-hf

    --convert runs nothing that is in the file. --fetch is the only thing in this program that
    uses the network.
    """
    if sum(task is not None for task in (check, convert, fetch)) > 1:
        raise UsageError("--check, --convert and --fetch are three tasks; give one")
    if check is not None:
        from pnpdepth_cli.pipeline.networks.check import check_model

        checked = check_model(check, given["checkpoint"], given["image"], given["device"])
        _show(asdict(checked), as_json)
    elif convert is not None:
        from pnpdepth_cli.pipeline.networks.convert import convert_checkpoint

        _show(asdict(convert_checkpoint(*convert, overwrite=given["overwrite"])), as_json)
    elif fetch is not None:
        from pnpdepth_cli.pipeline.networks.fetch import fetch_model

        _show(asdict(fetch_model(fetch, given["revision"], given["output"])), as_json)
    else:
        _list(every, as_json)


def _show(found: Mapping[str, Any], as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(found, indent=2))
        return
    for key, value in found.items():
        if key == "notes":
            for note in value:
                click.echo(printable(note), err=True)
        elif isinstance(value, dict):
            click.echo(f"{key}:")
            for name, text in value.items():
                click.echo(f"  {name}: {text}")
        elif isinstance(value, list):
            click.echo(f"{key}: {' '.join(map(str, value))}")
        else:
            click.echo(f"{key}: {value}")


def _list(every: bool, as_json: bool) -> None:
    from pnpdepth_cli.pipeline.networks.list_models import list_models

    listed = [asdict(model) for model in list_models()]
    left_out = Counter(model["family"] for model in listed if model["variant"] and not every)
    if as_json:
        click.echo(json.dumps(listed, indent=2))
        return
    from pnpdepth_cli.cli.tables import print_rows

    print_rows(
        "networks",
        ("name", "takes", "size", "gives", "params", "weights", "defaults"),
        [
            (
                model["name"],
                model["input_kind"],
                model["size"],
                model["output_kind"],
                f"{model['parameters']:,}",
                "shipped" if model["checkpoint"] else "yours",
                f"layer {model['layer']}, K {model['iterations']}, lr {model['lr']},"
                f" {model['loss']}, {model['update']}",
            )
            for model in listed
            if every or not model["variant"]
        ],
    )
    for family, count in left_out.items():
        click.echo(f"{family}: {count} more; --all lists them", err=True)
