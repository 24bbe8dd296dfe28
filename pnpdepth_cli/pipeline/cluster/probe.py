"""A file that shows whether all nodes of a cluster share a folder."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pnpdepth_cli.io.atomic import cannot_write


@contextmanager
def probe_in(folder: Path) -> Iterator[Path]:
    """Yields a new file of the folder, which is removed at the end.

    Raises:
        OutputError: The folder cannot be written to.
    """
    probe = folder / f".{secrets.token_hex(6)}"  # removed by the next run if this one is killed
    try:
        probe.touch()
    except OSError as error:
        raise cannot_write(folder, error) from error
    try:
        yield probe
    finally:
        with suppress(OSError):
            probe.unlink()
