"""Commands run in this process, and what they print, for fixtures that several tests share."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from pnpdepth_cli.cli.main import run


class Printed(NamedTuple):
    """The exit code of a command, and what it printed to stdout and stderr."""

    code: int
    out: str
    err: str


def printed(*arguments: str) -> Printed:
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        code = run([*arguments])
    return Printed(code=code, out=out.getvalue(), err=err.getvalue())


@contextlib.contextmanager
def working_in(folder: Path) -> Iterator[Path]:
    """The folder is the current one meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder
