"""Options that several commands share, each defined once."""

from __future__ import annotations

from pathlib import Path

import click

FILE = click.Path(path_type=Path)

model = click.option(
    "--model",
    default="compact",
    show_default=True,
    metavar="NAME|FILE.py[:ATTR]",
    help="A network that `pnpdepth models` lists, or a Python file with a definition.",
)
checkpoint = click.option(
    "--checkpoint", type=FILE, help="Its weights: .safetensors, or a torch file of tensors only."
)
layer = click.option(
    "--layer",
    metavar="NAME|0..1",
    help="Where to cut: a submodule's name (NAME#2 its second call, NAME[KEY] one of several"
    " outputs), or a share of the definition's layers, 0 the shallowest.",
)
device = click.option("--device", default="cpu", show_default=True, help="cpu, cuda, cuda:1, mps …")
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
