"""The script that draws the 3D views of a report, and the file of each frame."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.record import read_json

VIEWER = "viewer.js"
"""Name of the script in the report's folder."""


def view_path(images: Path, key: str) -> Path:
    """Returns the file of a frame's 3D view in the report's folder for images."""
    return images / f"{key}_view.js"


def save_view(source: Path, path: Path) -> None:
    """Writes the 3D view of a frame as a script, which a page opened from disk can load.

    Args:
        source: As `write_view` of `pipeline.refinement.view_3d` wrote it.
        path: The script.

    Raises:
        InputError: The source cannot be read.
        OutputError: The script cannot be written.
    """
    text = json.dumps(read_json(source), allow_nan=False, separators=(",", ":"))
    _write(path, f"pnpdepthView({text});\n")


def megabytes(path: Path) -> float:
    """Returns the size of a file, rounded to 0.1 and at least that."""
    return max(0.1, round(path.stat().st_size / 1e6, 1))


def save_viewer(folder: Path) -> None:
    """Writes three.js and the viewer as one script. Raises OutputError if that fails."""
    package = files(__package__)
    parts = [package.joinpath("three", "three.min.js"), package.joinpath("report_view.js")]
    _write(folder / VIEWER, "\n".join(part.read_text(encoding="utf-8") for part in parts))


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
