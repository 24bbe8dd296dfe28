"""Frames of a video, MP4 or MOV, decoded by OpenCV.

A frame is reached by decoding all before it: seeking is exact at a constant frame rate only, which
phones do not keep.
"""

from __future__ import annotations

import functools
import threading
from collections import deque
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.decoding import silence
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged, size_of_regular_file

_IN_MEMORY = 8
"""Frames that are kept, as threads ask for them slightly out of order."""
_lock = threading.Lock()


def read_video_frame(path: Path, index: int) -> NDArray[np.float32]:
    """Returns frame `index` from 0, (H, W, 3) float32 in 0..1, as it is stored: not turned.

    Raises:
        InputError: There is no such file, or the video is shorter.
        FileFormatError: It is no MP4 or MOV file, cannot be decoded, or exceeds the budget.
    """
    size_of_regular_file(path)
    with _lock, silence():
        bgr = _open(path, path.stat().st_mtime_ns).frame(index)
    return np.divide(bgr[:, :, ::-1], np.float32(255), dtype=np.float32)


class _Video:
    """A video that is being decoded, and the last of its frames."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._begin()

    def _begin(self) -> None:
        import cv2

        with self._path.open("rb") as file:
            if file.read(8)[4:] != b"ftyp":  # FFmpeg would follow the addresses in a playlist
                raise FileFormatError(f"{self._path} is not an MP4 or MOV video; convert it")
        self._capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise damaged(self._path, "video", "cannot be decoded")
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        sides = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        width, height = (int(self._capture.get(side)) for side in sides)
        check_pixel_count(self._path, width, height, channels=3)
        self._done = 0
        self._last = deque[NDArray[np.uint8]](maxlen=_IN_MEMORY)

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Returns a frame (H, W, 3), blue first."""
        if index < self._done - len(self._last):
            self._begin()
        while self._done <= index:
            found, pixels = self._capture.read()
            if not found:
                raise InputError(
                    f"{self._path} has {self._done:,} frames, so none of number {index:,}"
                )
            self._last.append(np.asarray(pixels, np.uint8))
            self._done += 1
        return self._last[index - self._done]


@functools.lru_cache(maxsize=1)
def _open(path: Path, mtime_ns: int) -> _Video:
    return _Video(path)
