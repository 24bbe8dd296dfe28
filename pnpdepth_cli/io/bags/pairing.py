"""Images and the scans nearest in time, from a stream of both, with few of them in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

_MOST_WAITING = 64
"""Images or scans that wait for a partner; further ones push the oldest out."""


@dataclass(frozen=True, kw_only=True)
class Stamped:
    """A message with the time of its header."""

    time_s: float
    """Seconds."""

    message: Any
    """The message."""


def nearest_pairs(
    stream: Iterable[tuple[bool, Stamped]], tolerance_s: float
) -> Iterator[tuple[Stamped, Stamped | None]]:
    """Yields each image, in order, with the scan nearest in time; None without one.

    A scan may be the nearest of several images.

    Args:
        stream: (whether it is an image, the message); each kind in the order of its time.
        tolerance_s: Largest difference of the two times, seconds.
    """
    images: deque[Stamped] = deque()
    scans: deque[Stamped] = deque(maxlen=_MOST_WAITING)
    for is_image, each in stream:
        (images if is_image else scans).append(each)
        # an image is decided once a scan after it is known
        while images and (
            (scans and scans[-1].time_s >= images[0].time_s) or len(images) > _MOST_WAITING
        ):
            yield _paired(images.popleft(), scans, tolerance_s)
    for image in images:
        yield _paired(image, scans, tolerance_s)


def _paired(
    image: Stamped, scans: deque[Stamped], tolerance_s: float
) -> tuple[Stamped, Stamped | None]:
    while len(scans) > 1 and scans[1].time_s <= image.time_s:
        scans.popleft()
    nearest = min(scans, key=lambda scan: abs(scan.time_s - image.time_s), default=None)
    if nearest is None or abs(nearest.time_s - image.time_s) > tolerance_s:
        return image, None
    return image, nearest
