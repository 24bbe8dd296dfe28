"""Depth images into every format, so that reading them back gives the same metres."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import OutputError, SizeError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.depth_reading import known_metres
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES, KITTI_SCALE, WriteOptions, format_of_suffix


def write_depth(
    path: Path,
    depth: NDArray[np.float32],
    *,
    scale: float = KITTI_SCALE,
    text: Mapping[str, str] | None = None,
) -> None:
    """Write depth in the format that the suffix names; not finite or <= 0 becomes 0, unknown.

    Args:
        path: The file to write, with a suffix of `DEPTH_SUFFIXES`.
        depth: (H, W) metres.
        scale: Codes per metre of a PNG, which keeps it in the file.
        text: Texts by key that a PNG keeps.

    Raises:
        OutputError: The suffix is unknown, the file cannot be written, or a depth is too large for
            16 bits or so small that it would become 0.
        SizeError: The depth is not (H, W).
    """
    depth_format = format_of_suffix(path.suffix)
    if depth_format is None:
        raise OutputError(
            f"{path}: depth cannot be written as {path.suffix or 'a file without suffix'!r}; "
            f"use one of {', '.join(DEPTH_SUFFIXES)}"
        )
    if depth.ndim != 2 or 0 in depth.shape:
        raise SizeError(f"{path}: depth of shape {depth.shape} is no image; give (H, W)")
    metres = known_metres(depth)
    with atomic_path(path) as temporary:
        options = WriteOptions(path=path, scale=scale, text=text or {})
        depth_format.write(temporary, metres, options)
