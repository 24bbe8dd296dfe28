"""The `pnpdepth` command: its subcommands, and the one place where errors become text."""

from __future__ import annotations

import errno
import gc
import importlib
import io
import os
import sys
from typing import Any

import click

from pnpdepth_cli import __version__
from pnpdepth_cli.cli.exit_codes import INTERRUPTED
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.errors import OutputError, PnpDepthError

_EXIT_CODES = """\b
Exit codes: 0 done · 1 a bug of ours · 2 wrong usage · 3 an input file · 4 network, layer or
checkpoint · 5 refinement diverged · 6 device · 7 some frames of a batch failed · 130 interrupted"""

_GARBAGE = 50_000
"""Objects between two looks for garbage. The usual 700 make them a tenth of what imports take."""

_SPINS = "3000"
"""Turns that an idle thread of GNU OpenMP, which torch computes with, waits for work before it
sleeps. With the usual 300,000 a frame takes 13 times as long as soon as another program keeps one
of two cores busy; with this, twice as long, and no longer than before on an idle machine."""

COMMANDS = {
    "refine": "refine:refine",
    "batch": "batch:batch",
    "models": "models:models",
    "layers": "layers:layers",
    "project": "project:project",
    "sample": "sample:sample",
    "simulate": "simulate:simulate",
    "eval": "evaluate:evaluate",
    "compare": "compare:compare",
    "sweep": "sweep:sweep",
    "bench": "bench:bench",
}
"""The subcommands in the order of the help: where each is below `pnpdepth_cli.cli`."""


class _Commands(click.Group):
    """A group that imports a subcommand only when it is needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, name = COMMANDS[cmd_name].split(":")
        command = getattr(importlib.import_module(f"pnpdepth_cli.cli.{module}"), name)
        assert isinstance(command, click.Command)
        return command

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("pnpdepth: interrupted", err=True)
            ctx.exit(INTERRUPTED)


@click.group(
    cls=_Commands, epilog=_EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(__version__, prog_name="pnpdepth")
def cli() -> None:
    """Better depth from any depth network and a few true points, without training."""


def main(arguments: list[str] | None = None) -> Any:
    """Run the command line; the process ends with the exit code of what happened."""
    gc.set_threshold(_GARBAGE)
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)  # read when torch is imported
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # who cannot be shown a σ still sees the rest
    try:
        try:
            return cli.main(arguments, prog_name="pnpdepth")
        finally:
            sys.stdout.flush()
    except PnpDepthError as error:
        click.echo(f"pnpdepth: {printable(error)}", err=True)
        sys.exit(error.exit_code)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left goes nowhere
        click.echo(f"pnpdepth: stdout cannot be written to: {error.strerror}", err=True)
        sys.exit(OutputError.exit_code)
