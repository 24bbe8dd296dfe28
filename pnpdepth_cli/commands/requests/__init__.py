"""What the user asks of each command, a file each, and which files a command may replace.

The command line declares its options by these. Imports neither numpy nor torch.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from pnpdepth_cli.errors import OutputError


def check_outputs(paths: Iterable[Path], inputs: Iterable[Path] = (), *, overwrite: bool) -> None:
    """Raises OutputError for a file that cannot be written.

    It is an input, or it exists and may not be replaced, or what it would lie in is no folder.

    Args:
        paths: Files to write.
        inputs: Files that are read.
        overwrite: Whether existing files may be replaced.
    """
    resolved = {os.path.realpath(path) for path in inputs}
    for path in paths:
        if os.path.realpath(path) in resolved:
            raise OutputError(f"{path} is one of the inputs; name another output")
        if path.exists() and not overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, or name another output")
        # Folders that are not there are made; the nearest that is there must be one.
        parent = next((parent for parent in path.parents if os.path.lexists(parent)), None)
        if parent is not None and not parent.is_dir():
            raise OutputError(f"{parent} is no folder; name another output")
