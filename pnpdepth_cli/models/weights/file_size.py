"""Files of weights that this machine could not hold are refused before they are read."""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.budget import budget


def size_problem(path: Path, most: int | None = None) -> str | None:
    """Returns why a file is too large to be read, or None.

    Args:
        path: An existing file.
        most: Bytes that are allowed. None: half of this machine's memory.
    """
    most = budget().max_decoded_bytes if most is None else most
    size = path.stat().st_size
    if size <= most:
        return None
    return f"has {size:,} bytes; at most {most:,} are read on this machine"
