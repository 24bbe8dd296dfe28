"""The `pnpdepth` command: its subcommands, and the one place where errors become text."""

from __future__ import annotations

import sys
from typing import Any

import click

from pnpdepth_cli import __version__
from pnpdepth_cli.cli.layers import layers
from pnpdepth_cli.cli.models import models
from pnpdepth_cli.cli.project import project
from pnpdepth_cli.cli.refine import refine
from pnpdepth_cli.cli.sample import sample
from pnpdepth_cli.cli.simulate import simulate
from pnpdepth_cli.errors import PnpDepthError

_EXIT_CODES = """\b
Exit codes: 0 done · 1 a bug of ours · 2 wrong usage · 3 an input file · 4 network, layer or
checkpoint · 5 refinement diverged · 6 device"""


@click.group(epilog=_EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="pnpdepth")
def cli() -> None:
    """Better depth from any depth network and a few true points, without training."""


cli.add_command(refine)
cli.add_command(models)
cli.add_command(layers)
cli.add_command(project)
cli.add_command(sample)
cli.add_command(simulate)


def main(arguments: list[str] | None = None) -> Any:
    """Run the command line; the process ends with the exit code of what happened."""
    try:
        return cli.main(arguments, prog_name="pnpdepth")
    except PnpDepthError as error:
        click.echo(f"pnpdepth: {error}", err=True)
        sys.exit(error.exit_code)
