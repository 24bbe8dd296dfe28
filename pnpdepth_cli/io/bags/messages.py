"""Images and point clouds of ROS messages; every size is checked against the bytes there are."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import one_line

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Data types of sensor_msgs/PointField."""

_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PN": ".png"}
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
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
    """Returns (suffix, bytes) of an image file with the pixels of a message.

    A compressed image is the file that it holds; any other becomes a PNG.

    Args:
        message: sensor_msgs/Image or sensor_msgs/CompressedImage.
        topic: Named in messages.

    Raises:
        FileFormatError: The message holds no image that is known here.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        # compressed depth has a header before the PNG, and is no image
        suffix = next((s for start, s in _MAGIC.items() if data.startswith(start)), None)
        if suffix is None:
            raise FileFormatError(
                f"{topic}: a compressed image ({one_line(message.format)[:30]}) is neither JPEG nor"
                " PNG; name another --bag image-topic"
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
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if not 0 < width * channels <= step or not 0 < height * step <= data.size:
        raise FileFormatError(
            f"{topic}: an image of {width}×{height} pixels and {step} bytes a row has"
            f" {data.size:,} bytes; the bag is damaged"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    shape = (height, width) if channels == 1 else (height, width, channels)
    pixels = np.ascontiguousarray(rows).reshape(shape)
    if encoding in _TO_BGR:
        pixels = np.asarray(cv2.cvtColor(pixels, _TO_BGR[encoding]), np.uint8)
    return pixels


def cloud_points(message: Any, topic: str) -> NDArray[np.float32]:
    """Returns the (N, 3) finite points x y z of a sensor_msgs/PointCloud2, of any field layout.

    Args:
        message: The cloud.
        topic: Named in messages.

    Raises:
        FileFormatError: It has no x, y and z, or claims more than it holds.
    """
    fields = {str(field.name): field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise FileFormatError(f"{topic}: a cloud without field {missing[0]}; name another topic")
    order = ">" if message.is_bigendian else "<"
    height, width = int(message.height), int(message.width)
    step, row = int(message.point_step), int(message.row_step)
    formats, offsets = [], [int(fields[name].offset) for name in "xyz"]
    for name in "xyz":
        kind = _NUMBERS.get(int(fields[name].datatype))
        if kind is None:
            raise FileFormatError(f"{topic}: field {name} of a cloud is of no known type")
        formats.append(order + kind)
    ends = [o + np.dtype(f).itemsize for o, f in zip(offsets, formats, strict=True)]
    data = np.frombuffer(message.data, np.uint8)
    row = row if height > 1 else width * step
    if max(ends) > step or width * step > row or height * row > data.size:
        raise FileFormatError(
            f"{topic}: a cloud of {width}×{height} points of {step} bytes has {data.size:,} bytes;"
            " the bag is damaged"
        )
    layout = np.dtype(
        {"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step}
    )
    rows = data[: height * row].reshape(height, row)[:, : width * step]
    points = np.frombuffer(np.ascontiguousarray(rows).tobytes(), layout)
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = np.column_stack([points[name] for name in "xyz"]).astype(np.float32)
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1)])


def seconds_of(message: Any, logged_ns: int) -> float:
    """Returns the time of a message's header; where it is 0, the time at which it was logged."""
    stamp = message.header.stamp
    time_s = int(stamp.sec) + 1e-9 * int(stamp.nanosec)
    return time_s if time_s > 0 else 1e-9 * logged_ns
