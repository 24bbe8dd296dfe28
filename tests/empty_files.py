"""Empty files, for layouts that are recognised by names alone."""

from __future__ import annotations

from pathlib import Path


def touch(*paths: Path) -> None:
    """Creates the files and their folders."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
