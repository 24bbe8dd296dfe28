"""Dense depth maps of COLMAP's stereo, `*.photometric.bin` and `*.geometric.bin`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged
from pnpdepth_cli.io.formats import DepthFile, Reading

_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")  # width, height, channels


def is_dense_map(data: bytes) -> bool:
    """Returns whether the content begins as a map of COLMAP's stereo does."""
    return _HEADER.match(data) is not None


def read_dense_map(path: Path, data: bytes) -> DepthFile:
    """Returns the depth (H, W) in a map of one channel, float32 in units of the COLMAP model.

    Depth is 0 where unknown. In the file, the numbers follow the header, row by row.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The file is cut short, or holds more channels, as maps of normals do.
    """
    # The header.
    header = _HEADER.match(data)
    if header is None:
        raise damaged(path, "COLMAP map", "has no header width&height&channels&")
    width, height, channels = (int(number) for number in header.groups())
    if channels != 1:
        raise InputError(
            f"{path} has {channels} channels, as a map of normals has; give that of depth, in"
            " stereo/depth_maps"
        )
    check_pixel_count(path, width, height, pixel_bytes=4)
    # The numbers.
    body = data[header.end() :]
    if len(body) != 4 * width * height:
        raise damaged(
            path,
            "COLMAP map",
            f"holds {len(body):,} bytes where {width}×{height} needs {4 * width * height:,}",
        )
    values = np.frombuffer(body, "<f4").reshape(height, width)
    return DepthFile(values=values, reading=Reading("COLMAP depth map"))
