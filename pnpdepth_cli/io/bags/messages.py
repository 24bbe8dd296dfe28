"""What ROS messages hold: images, point clouds, the camera and where it is; and which go together.

Every size is checked against the bytes there are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Extrinsics
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.bags import CAMERAS, COMPRESSED, ODOMETRY, POSES, TRANSFORMS, Bag, Message
from pnpdepth_cli.io.calibration import Calibration, camera_in_yaml
from pnpdepth_cli.io.depth import known_metres
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.formats import format_of_content
from pnpdepth_cli.io.formats.images import PNG
from pnpdepth_cli.io.poses import Trajectory, pose_of_quaternion, trajectory_of

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Data types of sensor_msgs/PointField."""

_MOST_WAITING = 64
"""Images or scans that wait for a partner; further ones push the oldest out."""

_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PN": ".png"}
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
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
_CHANNELS |= {name: 1 for name in _TO_BGR if name.startswith("bayer_")}

_STATIC = "/tf_static"
"""End of the name of the topic of fixed transforms."""


def image_file(message: Message, topic: str) -> tuple[str, bytes]:
    """Returns (suffix, bytes) of the file in a CompressedImage, or of a PNG of an Image.

    Raises:
        FileFormatError: The message holds no image that is known here.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        suffix = next((s for start, s in _MAGIC.items() if data.startswith(start)), None)
        if suffix is None:
            kind = one_line(message.format)[:30]
            raise FileFormatError(f"{topic}: {kind!r} is no JPEG and no PNG; name another --topic")
        return suffix, data
    done, encoded = cv2.imencode(".png", _pixels(message, topic), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise FileFormatError(f"{topic}: an image cannot be encoded as PNG")
    return ".png", encoded.tobytes()


def _pixels(message: Message, topic: str) -> NDArray[np.uint8]:
    """(H, W) or (H, W, 3) blue, green, red."""
    encoding = str(message.encoding)
    if encoding not in _CHANNELS:
        known = ", ".join(_CHANNELS)
        raise FileFormatError(f"{topic}: encoding {one_line(encoding)[:30]!r} is none of {known}")
    channels = _CHANNELS[encoding]
    rows = _rows(message, topic, channels)
    pixels = rows if channels == 1 else rows.reshape(len(rows), -1, channels)
    conversion = _TO_BGR.get(encoding)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)


def _rows(message: Message, topic: str, pixel_bytes: int) -> NDArray[np.uint8]:
    """The bytes of an Image's pixels, (H, W * pixel_bytes)."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if not 0 < width * pixel_bytes <= step or not 0 < height * step <= data.size:
        image = f"an image of {width}×{height} pixels and {step} bytes a row"
        raise FileFormatError(f"{topic}: {image} has {data.size:,} bytes; the bag is damaged")
    rows = data[: height * step].reshape(height, step)[:, : width * pixel_bytes]
    return np.ascontiguousarray(rows)


def is_depth(message: Message, topic: str) -> bool:
    """Returns whether an Image, or CompressedImage, is a depth image.

    Grey images of 16 bits are if the topic says so, as those that librealsense records.
    """
    if hasattr(message, "encoding"):
        encoding = str(message.encoding)
        return encoding in _DEPTH and (encoding != "mono16" or "depth" in topic.lower())
    return _COMPRESSED_DEPTH in str(message.format)


def depth_image(message: Message, topic: str) -> NDArray[np.float32]:
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
        kind = one_line(message.format)[:40]
        raise FileFormatError(f"{topic}: {kind!r} is no PNG of {' or '.join(_DEPTH)}")
    codes = PNG.read(Path(topic), data[_DEPTH_HEADER:]).values
    if _DEPTH[kind] == "u2":
        return known_metres(codes / _MM_PER_M)
    a, b = np.frombuffer(data, "<f4", 2, offset=4)
    with np.errstate(divide="ignore"):
        return known_metres(np.where(codes > 0, a / (codes.astype(np.float64) - b), 0))


def cloud_points(message: Message, topic: str) -> NDArray[np.float32]:
    """Returns the (N, 3) points x y z of a sensor_msgs/PointCloud2, of any field layout.

    Raises:
        FileFormatError: It has no x, y and z, or claims more than it holds.
    """
    # The fields of x, y and z.
    fields = {str(field.name): field for field in message.fields}
    if any(name not in fields or int(fields[name].datatype) not in _NUMBERS for name in "xyz"):
        raise FileFormatError(f"{topic}: a cloud without numbers x y z; name another topic")
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
        cloud = f"a cloud of {width}×{height} points of {step} bytes"
        raise FileFormatError(f"{topic}: {cloud} has {data.size:,} bytes; the bag is damaged")
    # The coordinates, without the bytes between rows and fields.
    layout = np.dtype(
        {"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step}
    )
    rows = data[: height * row].reshape(height, row)[:, : width * step]
    points = np.frombuffer(np.ascontiguousarray(rows).tobytes(), layout)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.column_stack([points[name] for name in "xyz"]).astype(np.float32)


def seconds_of(message: Message, logged_ns: int) -> float:
    """Returns the time of a message's header; where it is 0, the time at which it was logged."""
    stamp = message.header.stamp
    time_s = int(stamp.sec) + 1e-9 * int(stamp.nanosec)
    return time_s if time_s > 0 else 1e-9 * logged_ns


class Stamped(NamedTuple):
    """A message with the time of its header."""

    time_s: float
    message: Message


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


def camera_info_topic(bag: Bag, image_topic: str) -> str | None:
    """Returns the topic of the camera's intrinsics: beside the image's, or the only one."""
    topics = bag.topics(CAMERAS)
    for end in COMPRESSED:
        image_topic = image_topic.removesuffix(end)
    folder = image_topic.rpartition("/")[0]
    # librealsense has /device_0/sensor_1/Color_0/image/data and …/Color_0/info/camera_info
    for beside in (f"{folder}/camera_info", f"{folder.rpartition('/')[0]}/info/camera_info"):
        if beside in topics:
            return beside
    return next(iter(topics)) if len(topics) == 1 else None


def camera_of_bag(bag: Bag, topic: str) -> tuple[Calibration, str] | None:
    """Returns the camera of the first message of a camera_info topic, and its frame_id."""
    for _, _, message in bag.messages([topic]):
        k, d, r, p = (
            np.asarray(getattr(message, name, getattr(message, name.upper(), ())), np.float64)
            for name in "kdrp"
        )
        if not k.any():
            return None  # an uncalibrated camera
        content = {
            "camera_matrix": k.tolist(),
            "distortion_coefficients": d.tolist(),
            "distortion_model": str(message.distortion_model) if d.size else "none",
            "width": int(message.width),
            "height": int(message.height),
        }
        if np.isfinite(p).all() and np.isfinite(r).all():
            content |= {"projection_matrix": p.tolist(), "rectification_matrix": r.tolist()}
        calibration = camera_in_yaml(bag.path, content, None)
        camera = replace(calibration.camera, source=topic)
        return replace(calibration, camera=camera), frame_of(message)
    return None


def frame_of(message: Message) -> str:
    """Returns the frame_id in a message's header, without ROS 1's leading slash."""
    return str(message.header.frame_id).lstrip("/")


def static_pose(bag: Bag, camera: str, scanner: str) -> Extrinsics | None:
    """Returns the scanner's pose in the camera's coordinates, by /tf_static; None without one."""
    # The transforms, each in both directions.
    links: dict[str, dict[str, Extrinsics]] = {}
    topics = [name for name in bag.topics(TRANSFORMS) if name.endswith(_STATIC)]
    for _, _, message in bag.messages(topics):
        for each in message.transforms:
            parent, child = frame_of(each), str(each.child_frame_id).lstrip("/")
            pose = _pose_in(bag, each.transform.translation, each.transform.rotation)
            links.setdefault(parent, {})[child] = pose
            links.setdefault(child, {})[parent] = pose.inverse()
    # The shortest chain of them.
    poses, waiting = {camera: SAME_PLACE}, deque([camera])
    while waiting and scanner not in poses:
        frame = waiting.popleft()
        for other, pose in links.get(frame, {}).items():
            if other not in poses:
                poses[other] = poses[frame] @ pose
                waiting.append(other)
    return poses.get(scanner)


def poses_topics(bag: Bag, wanted: Sequence[str]) -> tuple[str, ...]:
    """Returns the named topics of poses, else those of odometry, else of poses."""
    kinds = tuple(bag.topics(ODOMETRY)), tuple(bag.topics(POSES))
    named = tuple(name for name in wanted if any(name in names for names in kinds))
    return named or next((names for names in kinds if names), ())


def camera_trajectory(bag: Bag, topic: str, camera: str) -> Trajectory | None:
    """Returns the poses of the camera; None if nothing ties it to what the topic moves.

    An odometry message names the frame_id that it moves, and /tf_static gives the camera in it. A
    pose message names none, so its pose is the camera's own.
    """
    times, poses, body = [], [], camera
    for _, logged_ns, message in bag.messages([topic]):
        body = str(getattr(message, "child_frame_id", "")).lstrip("/") or camera
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        times.append(seconds_of(message, logged_ns))
        poses.append(_pose_in(bag, pose.position, pose.orientation).square())
    in_body = static_pose(bag, body, camera)
    if not poses or in_body is None:
        return None
    return trajectory_of(np.array(times), (np.stack(poses) @ in_body.square())[:, :3])


def _pose_in(bag: Bag, shift: Message, turn: Message) -> Extrinsics:
    xyzw = [turn.x, turn.y, turn.z, turn.w]
    return pose_of_quaternion(bag.path, [shift.x, shift.y, shift.z], xyzw)
