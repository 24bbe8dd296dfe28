"""Output files of the commands that make sparse depth: checked before the work, then written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import __version__
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.io.sparse_writing import SPARSE_SUFFIXES, write_sparse
from pnpdepth_cli.io.visualisation import overlay
from pnpdepth_cli.sensors import Points, as_depth_image


@dataclass(frozen=True, kw_only=True)
class SparseTarget:
    """Where sparse depth is written."""

    output: Path
    """The sparse depth; its suffix is one of `SPARSE_SUFFIXES`."""

    overlay: Path | None = None
    """A PNG of the points on the image; None for none."""

    depth_scale: float = 256.0
    """Codes per metre of a PNG."""

    overwrite: bool = False
    """Existing files are replaced."""

    @property
    def record(self) -> Path:
        """The JSON beside the output, with everything it was made from."""
        return self.output.with_suffix(".json")

    def check(self, inputs: Iterable[Path | None]) -> None:
        """Raises OutputError for files that cannot be written, before any work is done.

        Args:
            inputs: Files that are read, which must not be replaced.
        """
        if self.output.suffix.lower() not in SPARSE_SUFFIXES:
            raise OutputError(
                f"{self.output}: sparse depth is written as one of {', '.join(SPARSE_SUFFIXES)}"
            )
        if not 0 < self.depth_scale < np.inf:
            raise UsageError(f"--output-scale must be a number above 0, not {self.depth_scale:g}")
        if self.overlay is not None and self.overlay.suffix.lower() != ".png":
            raise OutputError(f"{self.overlay}: the overlay is a PNG; name it so")
        taken = {p.resolve() for p in inputs if p is not None}
        for path in filter(None, (self.output, self.record, self.overlay)):
            if path.resolve() in taken:
                raise OutputError(f"{path} is an input or named twice; give another output")
            if path.exists() and not self.overwrite:
                raise OutputError(f"{path} exists; --overwrite replaces it, -o names another path")
            taken.add(path.resolve())


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """What sparse depth was made from, for its record."""

    command: str
    """The command that made it."""

    settings: dict[str, Any]
    """Its settings, seed included; a PNG or CSV keeps them too."""

    inputs: dict[str, Any]
    """Its input files."""

    notes: Sequence[str]
    """What was assumed, and warnings."""


def write_sparse_outputs(
    target: SparseTarget,
    points: Points,
    made_from: Provenance,
    *,
    rgb: NDArray[np.float32] | None = None,
) -> dict[str, Any]:
    """Writes the sparse depth, its record and the overlay, and returns the record.

    Args:
        target: The files.
        points: The sparse depth.
        made_from: Goes into the record.
        rgb: (H, W, 3) in 0..1, the image of the overlay.

    Raises:
        OutputError: A file cannot be written.
    """
    provenance = {"command": made_from.command, "version": __version__, **made_from.settings}
    for path in filter(None, (target.output, target.overlay)):
        make_folder(path.parent)
    write_sparse(
        target.output,
        points.xy,
        points.depth,
        as_depth_image(points),
        provenance=provenance,
        scale=target.depth_scale,
    )
    if target.overlay is not None and rgb is not None:
        overlay(rgb, points.xy, points.depth, target.overlay)
    height, width = points.size
    record = {
        **provenance,
        "inputs": made_from.inputs,
        "points": {
            "count": len(points.depth),
            "fraction_of_pixels": len(points.depth) / (height * width),
            "nearest": float(points.depth.min()),
            "farthest": float(points.depth.max()),
            "dropped": dict(points.dropped),
        },
        "size": [width, height],
        "notes": list(made_from.notes),
        "outputs": {
            "sparse": str(target.output),
            "overlay": str(target.overlay) if target.overlay else None,
            "record": str(target.record),
        },
    }
    write_json(target.record, record)
    return record
