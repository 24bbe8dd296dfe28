"""`pnpdepth doctor`."""

from __future__ import annotations

import click


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
