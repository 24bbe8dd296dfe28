"""Sparse depth to a file: an image in any depth format, or a list of points that loses nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES, KITTI_SCALE

SPARSE_SUFFIXES = (*DEPTH_SUFFIXES, ".csv")
"""What `write_sparse` can write; .csv keeps coordinates between pixel centres."""

PROVENANCE_KEY = "pnpdepth:made"
"""Key of the text in a PNG or CSV that says how its sparse depth was made."""


def write_sparse(
    path: Path,
    xy: NDArray[np.float32],
    depth: NDArray[np.float32],
    image: NDArray[np.float32],
    *,
    provenance: Mapping[str, Any],
    scale: float = KITTI_SCALE,
) -> None:
    """Writes N points in the format that the suffix names.

    Args:
        path: The file to write, with a suffix of `SPARSE_SUFFIXES`.
        xy: (N, 2) pixel coordinates.
        depth: (N,) metres.
        image: The same points as (H, W) metres, for every format but .csv.
        provenance: How they were made; a PNG and a CSV keep it.
        scale: Codes per metre of a PNG.

    Raises:
        OutputError: The file cannot be written.
    """
    text = json.dumps(provenance, sort_keys=True)
    if path.suffix.lower() != ".csv":
        write_depth(path, image, scale=scale, text={PROVENANCE_KEY: text})
        return
    rows = [f"{x:.9g},{y:.9g},{z:.9g}" for (x, y), z in zip(xy, depth, strict=True)]
    with atomic_path(path) as temporary:
        content = "\n".join([f"# {PROVENANCE_KEY} {text}", "x,y,depth", *rows]) + "\n"
        temporary.write_text(content, encoding="utf-8", newline="\n")
