"""Output files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.opening import one_line


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """`path` holds what was written to the yielded path, or is untouched if anything failed.

    The yielded path is an empty file in the same folder with the same suffix. A link is
    followed, so the file it points to is the one replaced. Raises OutputError when the
    folder cannot be written to, also when that shows only inside the block.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise OutputError(f"{path} is a folder; give the name of a file to write")
    if target.exists() and not target.is_file():
        raise OutputError(f"{path} is not a regular file; choose another output file")
    temporary = _empty_file_beside(target, named=path)
    try:
        yield temporary
        temporary.replace(target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise _cannot_write(path, error) from error
        raise


def _empty_file_beside(target: Path, *, named: Path) -> Path:
    # The name does not contain the target's, so a name of the longest length still works.
    temporary = target.with_name(f".{secrets.token_hex(6)}{target.suffix}")
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        if not target.parent.exists():
            message = f"{named}: its folder does not exist; create it first"
            raise OutputError(message) from error
        raise _cannot_write(named, error) from error
    return temporary


def _cannot_write(path: Path, error: OSError) -> OutputError:
    reason = one_line(error.strerror or error).lower()
    return OutputError(f"{path} cannot be written ({reason}); choose another output folder")
