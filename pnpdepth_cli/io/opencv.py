"""Pixels as a file stores them, decoded by OpenCV."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.file_bytes import damaged
from pnpdepth_cli.io.own_output import quiet_libraries
from pnpdepth_cli.io.shared_context import SharedContext


def decode_with_opencv(path: Path, data: bytes, kind: str) -> NDArray[Any]:
    """Returns the pixels in the file's own type, (H, W) or (H, W, C) with blue first.

    Args:
        path: Named in messages.
        data: Content of the file.
        kind: The kind of file that messages name.

    Raises:
        FileFormatError: OpenCV cannot decode it.
    """
    import cv2

    buffer = np.frombuffer(data, dtype=np.uint8)
    try:
        with _SILENT_OPENCV, quiet_libraries():
            pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise damaged(path, kind, f"cannot be decoded ({error})") from error
    if pixels is None:
        raise damaged(path, kind, "cannot be decoded")
    return pixels


@contextmanager
def _silent_opencv() -> Iterator[None]:
    """OpenCV does not print several lines of its own about a damaged file."""
    import cv2

    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


_SILENT_OPENCV = SharedContext(_silent_opencv)
