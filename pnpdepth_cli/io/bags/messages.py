"""Images and point clouds of ROS messages, and which belong together.

Every size is checked against the bytes there are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.depth import known_metres
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.formats import format_of_content
from pnpdepth_cli.io.formats.images import PNG

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Data types of sensor_msgs/PointField."""

_MOST_WAITING = 64
"""Images or scans that wait for a partner; further ones push the oldest out."""

_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PN": ".png"}
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COMPRESSED_DEPTH, _DEPTH_HEADER, _MM_PER_M = "compressedDepth", 12, 1000.0
_TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    # OpenCV names a pattern by its second row and column.
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
}


def image_file(message: Any, topic: str) -> tuple[str, bytes]:
    """Returns (suffix, bytes) of the file in a CompressedImage, or of a PNG of an Image.

    Raises:
        FileFormatError: The message holds no image that is known here.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        suffix = next((s for start, s in _MAGIC.items() if data.startswith(start)), None)
        if suffix is None:
            raise FileFormatError(
                f"{topic}: a compressed image ({one_line(message.format)[:30]}) is neither JPEG nor"
                " PNG; name another topic with --topic"
            )
        return suffix, data
    done, encoded = cv2.imencode(".png", _pixels(message, topic), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise FileFormatError(f"{topic}: an image cannot be encoded as PNG")
    return ".png", encoded.tobytes()


def _pixels(message: Any, topic: str) -> NDArray[np.uint8]:
    """(H, W) or (H, W, 3) blue, green, red."""
    encoding = str(message.encoding)
    channels = 1 if encoding.startswith("bayer_") else _CHANNELS.get(encoding)
    if channels is None or (encoding.startswith("bayer_") and encoding not in _TO_BGR):
        raise FileFormatError(
            f"{topic}: images of encoding {one_line(encoding)[:30]!r} are not read; known are"
            f" {', '.join((*_CHANNELS, *(n for n in _TO_BGR if n.startswith('bayer'))))}"
        )
    rows = _rows(message, topic, channels)
    pixels = rows if channels == 1 else rows.reshape(len(rows), -1, channels)
    if encoding in _TO_BGR:
        pixels = np.asarray(cv2.cvtColor(pixels, _TO_BGR[encoding]), np.uint8)
    return pixels


def _rows(message: Any, topic: str, pixel_bytes: int) -> NDArray[np.uint8]:
    """The bytes of an Image's pixels, (H, W * pixel_bytes)."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if not 0 < width * pixel_bytes <= step or not 0 < height * step <= data.size:
        raise FileFormatError(
            f"{topic}: an image of {width}×{height} pixels and {step} bytes a row has"
            f" {data.size:,} bytes; the bag is damaged"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * pixel_bytes]
    return np.ascontiguousarray(rows)


def is_depth(message: Any, topic: str) -> bool:
    """Returns whether an Image, or CompressedImage, is a depth image.

    Grey images of 16 bits are if the topic says so, as those that librealsense records.
    """
    if hasattr(message, "encoding"):
        encoding = str(message.encoding)
        return encoding in _DEPTH and (encoding != "mono16" or "depth" in topic.lower())
    return _COMPRESSED_DEPTH in str(message.format)


def depth_image(message: Any, topic: str) -> NDArray[np.float32]:
    """Returns the depth image (H, W) of a message in metres, 0 where unknown.

    16UC1 holds millimetres, 32FC1 metres (REP 118). A compressed one is a PNG behind 12 bytes: a
    number, and a and b of the code a / depth + b of 32FC1 (compressed_depth_image_transport).

    Raises:
        FileFormatError: It is damaged, or compressed otherwise.
    """
    if hasattr(message, "encoding"):
        number = np.dtype(_DEPTH[str(message.encoding)])
        values = _rows(message, topic, number.itemsize).view(
            number.newbyteorder(">" if message.is_bigendian else "<")
        )
        return known_metres(values if number.kind == "f" else values / _MM_PER_M)
    data, kind = bytes(message.data), str(message.format).partition(";")[0].strip()
    if kind not in _DEPTH or format_of_content(data[_DEPTH_HEADER:]) is not PNG:
        raise FileFormatError(
            f"{topic}: compressed depth ({one_line(message.format)[:40]}) is not a PNG of"
            f" {' or '.join(_DEPTH)}; name another topic with --topic"
        )
    codes = PNG.read(Path(topic), data[_DEPTH_HEADER:]).values
    if _DEPTH[kind] == "u2":
        return known_metres(codes / _MM_PER_M)
    a, b = np.frombuffer(data, "<f4", 2, offset=4)
    with np.errstate(divide="ignore"):
        return known_metres(np.where(codes > 0, a / (codes.astype(np.float64) - b), 0))


def cloud_points(message: Any, topic: str) -> NDArray[np.float32]:
    """Returns the (N, 3) points x y z of a sensor_msgs/PointCloud2, of any field layout.

    Raises:
        FileFormatError: It has no x, y and z, or claims more than it holds.
    """
    # The fields of x, y and z.
    fields = {str(field.name): field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise FileFormatError(f"{topic}: a cloud without field {missing[0]}; name another topic")
    unknown = [name for name in "xyz" if int(fields[name].datatype) not in _NUMBERS]
    if unknown:
        raise FileFormatError(f"{topic}: field {unknown[0]} of a cloud is of no known type")
    # Where they lie in a point.
    order = ">" if message.is_bigendian else "<"
    formats = [order + _NUMBERS[int(fields[name].datatype)] for name in "xyz"]
    offsets = [int(fields[name].offset) for name in "xyz"]
    end = max(o + np.dtype(f).itemsize for o, f in zip(offsets, formats, strict=True))
    # How many points the message holds.
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row = int(message.row_step) if height > 1 else width * step
    data = np.frombuffer(message.data, np.uint8)
    if end > step or width * step > row or height * row > data.size:
        raise FileFormatError(
            f"{topic}: a cloud of {width}×{height} points of {step} bytes has {data.size:,} bytes;"
            " the bag is damaged"
        )
    # The coordinates, without the bytes between rows and fields.
    layout = np.dtype(
        {"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step}
    )
    rows = data[: height * row].reshape(height, row)[:, : width * step]
    points = np.frombuffer(np.ascontiguousarray(rows).tobytes(), layout)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.column_stack([points[name] for name in "xyz"]).astype(np.float32)


def seconds_of(message: Any, logged_ns: int) -> float:
    """Returns the time of a message's header; where it is 0, the time at which it was logged."""
    stamp = message.header.stamp
    time_s = int(stamp.sec) + 1e-9 * int(stamp.nanosec)
    return time_s if time_s > 0 else 1e-9 * logged_ns


class Stamped(NamedTuple):
    """A message with the time of its header."""

    time_s: float
    message: Any


def nearest_pairs(
    stream: Iterable[tuple[bool, Stamped]], tolerance_s: float
) -> Iterator[tuple[Stamped, Stamped | None]]:
    """Yields each image, in order, with the scan nearest in time; None without one.

    Few messages are in memory. A scan may be the nearest of several images.

    Args:
        stream: (whether it is an image, the message); each kind in the order of its time.
        tolerance_s: Largest difference of the two times.
    """
    images: deque[Stamped] = deque()
    scans: deque[Stamped] = deque(maxlen=_MOST_WAITING)
    for is_image, each in stream:
        (images if is_image else scans).append(each)
        # an image is decided once a scan after it is known
        while images and (
            (scans and scans[-1].time_s >= images[0].time_s) or len(images) > _MOST_WAITING
        ):
            yield _pair(images.popleft(), scans, tolerance_s)
    for image in images:
        yield _pair(image, scans, tolerance_s)


def _pair(
    image: Stamped, scans: deque[Stamped], tolerance_s: float
) -> tuple[Stamped, Stamped | None]:
    while len(scans) > 1 and scans[1].time_s <= image.time_s:
        scans.popleft()
    nearest = min(scans, key=lambda scan: abs(scan.time_s - image.time_s), default=None)
    near = nearest is not None and abs(nearest.time_s - image.time_s) <= tolerance_s
    return image, nearest if near else None
