"""What ROS messages hold: images, point clouds, the camera and where it is; and which go together.

Every size is checked against the bytes there are.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Extrinsics
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.bags import (
    CAMERAS,
    COMPRESSED,
    FLOATS,
    ODOMETRY,
    POSES,
    TRANSFORMS,
    Bag,
    Message,
)
from pnpdepth_cli.io.calibration import Calibration, camera_in_yaml
from pnpdepth_cli.io.depth import known_metres
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.formats import kind_of
from pnpdepth_cli.io.formats.images import read_png
from pnpdepth_cli.io.poses import Trajectory, pose_of_quaternion, trajectory_of

_Kind = TypeVar("_Kind", bound=np.generic)
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Data types of sensor_msgs/PointField."""

_MOST_WAITING = 64  # images or scans that wait for a partner; further ones push the oldest out

_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PN": ".png"}
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4", "64FC1": "f8"}
_SENSOR = re.compile(r"/device_\d+/sensor_\d+")
"""Beginning of the topics of a sensor that librealsense recorded."""
_COMPRESSED_DEPTH = "compressedDepth"
"""In the format of a CompressedImage that is a depth image."""
_DEPTH_HEADER = 12
"""Bytes in front of its PNG."""
_MM_PER_M = 1000.0
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


def image_file(message: Message, topic: str) -> tuple[str, bytes]:
    """Returns (suffix, bytes) of the file in a CompressedImage, or of a PNG of an Image.

    Raises:
        InputError: The message holds no image that is known here.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        suffix = next((s for start, s in _MAGIC.items() if data.startswith(start)), None)
        if suffix is None:
            kind = one_line(message.format)[:30]
            raise InputError(f"{topic}: {kind!r} is no JPEG and no PNG; name another --topic")
        return suffix, data
    # The pixels, in blue, green and red.
    encoding = str(message.encoding)
    if encoding not in _CHANNELS:
        raise InputError(
            f"{topic}: encoding {one_line(encoding)[:30]!r} is none of {', '.join(_CHANNELS)}; name"
            " another --topic"
        )
    channels = _CHANNELS[encoding]
    layout = np.dtype("u1" if channels == 1 else ("u1", channels))
    pixels = np.ascontiguousarray(_grid(message, topic, layout, int(message.step)))
    if not pixels.size:
        raise InputError(f"{topic}: an image without pixels; the bag is damaged")
    if encoding in _TO_BGR:
        pixels = cv2.cvtColor(pixels, _TO_BGR[encoding])
    return ".png", cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _grid(message: Message, topic: str, layout: np.dtype[_Kind], row_bytes: int) -> NDArray[_Kind]:
    """The values (H, W) of an Image or a PointCloud2 whose rows have so many bytes."""
    height, width = int(message.height), int(message.width)
    data = np.frombuffer(message.data, np.uint8)
    if width * layout.itemsize > row_bytes or height * row_bytes > data.size:
        raise InputError(
            f"{topic}: {width}×{height} values of {layout.itemsize} bytes, {row_bytes} a row, have"
            f" {data.size:,} bytes; the bag is damaged"
        )
    return np.ndarray((height, width), layout, data, 0, (row_bytes, layout.itemsize))


def is_depth(message: Message, topic: str) -> bool:
    """Returns whether an Image, or CompressedImage, is a depth image.

    Grey images of 16 bits are if the topic says so, as those that librealsense records.
    """
    if hasattr(message, "encoding"):
        encoding = str(message.encoding)
        return encoding in _DEPTH and (encoding != "mono16" or "depth" in topic.lower())
    return _COMPRESSED_DEPTH in str(message.format)


def is_wide_grey(message: Message) -> bool:
    """Returns whether an Image is grey of 16 bits, which may hold depth or, say, heat."""
    return str(getattr(message, "encoding", "")) == "mono16"


def depth_unit(bag: Bag, points_topic: str) -> tuple[str, float] | None:
    """Returns the topic that states the unit of a depth sensor's codes, and the unit in metres.

    librealsense records it as an option of the sensor whose stream the points are:
    /device_0/sensor_0/option/Depth_Units/value. None without such a topic.

    Raises:
        InputError: The unit is no length.
    """
    sensor = _SENSOR.match(points_topic)
    wanted = "" if sensor is None else f"{sensor[0]}/option/Depth_Units/value"
    for topic, _, message in bag.messages([name for name in bag.topics(FLOATS) if name == wanted]):
        unit_m = float(message.data)
        if not (math.isfinite(unit_m) and unit_m > 0):
            raise InputError(f"{bag.path}: {topic} is {unit_m:g} m; state the unit: --depth-scale")
        # a float32 of 0.00025 is not quite that
        return topic, float(f"{unit_m:.6g}")
    return None


def depth_image(message: Message, topic: str, scale: float | None = None) -> NDArray[np.float32]:
    """Returns the depth image (H, W) of a message in metres, 0 where unknown.

    16UC1 holds millimetres, 32FC1 metres (REP 118), unless a scale is stated. A compressed one is a
    PNG behind 12 bytes: a number, and a and b of the code a / depth + b of 32FC1
    (compressed_depth_image_transport).

    Args:
        message: An Image or a CompressedImage.
        topic: Its topic.
        scale: Numbers per metre. None: as ROS has them.

    Raises:
        InputError: It is damaged, or compressed otherwise.
    """
    # An Image holds the numbers themselves.
    if hasattr(message, "encoding"):
        order = ">" if message.is_bigendian else "<"
        number = np.dtype(order + _DEPTH[str(message.encoding)])
        values = _grid(message, topic, number, int(message.step))
        of_ros = 1.0 if number.kind == "f" else _MM_PER_M
        return known_metres(values / (scale or of_ros))
    # A CompressedImage holds a PNG of 16UC1, or of codes of 32FC1.
    data = bytes(message.data)
    kind = str(message.format).partition(";")[0].strip()
    if kind not in _DEPTH or kind_of(data[_DEPTH_HEADER:]) != "PNG":
        raise InputError(
            f"{topic}: {one_line(message.format)[:40]!r} is no PNG of {' or '.join(_DEPTH)}; name"
            " another --topic"
        )
    codes = read_png(Path(topic), data[_DEPTH_HEADER:]).values
    if _DEPTH[kind] == "u2":
        return known_metres(codes / (scale or _MM_PER_M))
    a, b = np.frombuffer(data, "<f4", 2, offset=4)
    with np.errstate(divide="ignore"):
        metres = a / (codes.astype(np.float64) - b) / (scale or 1.0)
        return known_metres(np.where(codes > 0, metres, 0))


def cloud_points(message: Message, topic: str) -> NDArray[np.float32]:
    """Returns the (N, 3) points x y z of a sensor_msgs/PointCloud2, of any field layout.

    Raises:
        InputError: It has no x, y and z, or claims more than it holds.
    """
    fields = {str(field.name): field for field in message.fields}
    if any(name not in fields or int(fields[name].datatype) not in _NUMBERS for name in "xyz"):
        raise InputError(f"{topic}: a cloud without numbers x y z; name another topic")
    # Where x, y and z lie in a point.
    order = ">" if message.is_bigendian else "<"
    step = int(message.point_step)
    formats = [order + _NUMBERS[int(fields[name].datatype)] for name in "xyz"]
    offsets = [int(fields[name].offset) for name in "xyz"]
    try:
        layout = np.dtype(
            {"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step}
        )
    except ValueError as error:
        raise InputError(
            f"{topic}: points of {step} bytes do not hold x y z; the bag is damaged"
        ) from error
    # The row's length may be 0 in a cloud of one row.
    row_bytes = int(message.row_step) if message.height > 1 else int(message.width) * step
    points = _grid(message, topic, layout, row_bytes).ravel()
    with np.errstate(over="ignore", invalid="ignore"):
        return np.column_stack([points[name] for name in "xyz"]).astype(np.float32)


def seconds_of(message: Message, logged_ns: int) -> float:
    """Returns the time of a message's header; where it is 0, the time at which it was logged."""
    stamp = message.header.stamp
    time_s = int(stamp.sec) + 1e-9 * int(stamp.nanosec)
    return time_s if time_s > 0 else 1e-9 * logged_ns


def nearest_pairs(
    stream: Iterable[tuple[bool, float, Message]], tolerance_s: float
) -> Iterator[tuple[float, Message, Message | None]]:
    """Yields each image, in order, after its time and with the scan nearest to it, else None.

    Few messages are in memory. A scan may be the nearest of several images.

    Args:
        stream: (whether it is an image, seconds, message); each kind in the order of its time.
        tolerance_s: Largest difference of the two times.
    """
    images = deque[tuple[float, Message]]()
    scans = deque[tuple[float, Message]](maxlen=_MOST_WAITING)
    for is_image, time_s, message in itertools.chain(stream, [(False, math.inf, None)]):
        (images if is_image else scans).append((time_s, message))
        # An image is decided once a scan after it is known.
        while images and ((scans and scans[-1][0] >= images[0][0]) or len(images) > _MOST_WAITING):
            image_s, image = images.popleft()
            while len(scans) > 1 and scans[1][0] <= image_s:
                scans.popleft()
            gaps_s = [abs(scan_s - image_s) for scan_s, _ in scans]
            least_s = min(gaps_s, default=math.nan)
            scan = scans[gaps_s.index(least_s)][1] if least_s <= tolerance_s else None
            yield image_s, image, scan


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


def camera_of_bag(bag: Bag, image_topic: str) -> tuple[Calibration, str] | None:
    """Returns the camera of images by its first camera_info, and its frame_id; None without one."""
    topic = camera_info_topic(bag, image_topic)
    for _, _, message in bag.messages([] if topic is None else [topic]):
        values = {
            name: np.asarray(getattr(message, name, getattr(message, name.upper(), ())), np.float64)
            for name in "kdrp"
        }
        if not values["k"].any():
            return None  # an uncalibrated camera
        content: dict[str, object] = {k: v for k, v in values.items() if np.isfinite(v).all()}
        model = str(message.distortion_model) if values["d"].size else "none"
        content |= {"distortion_model": model, "width": message.width, "height": message.height}
        calibration = camera_in_yaml(bag.path, content, None)
        camera = replace(calibration.camera, source=str(topic))
        return replace(calibration, camera=camera), frame_of(message)
    return None


def frame_of(message: Message) -> str:
    """Returns the frame_id in a message's header, without ROS 1's leading slash."""
    return str(message.header.frame_id).lstrip("/")


def static_pose(bag: Bag, camera: str, scanner: str) -> Extrinsics | None:
    """Returns the scanner's pose in the camera's coordinates, by /tf_static; None without one."""
    # The transforms, each in both directions.
    links: list[tuple[str, str, Extrinsics]] = []
    topics = [name for name in bag.topics(TRANSFORMS) if name.endswith("/tf_static")]
    for _, _, message in bag.messages(topics):
        for stamped in message.transforms:
            parent = frame_of(stamped)
            child = str(stamped.child_frame_id).lstrip("/")
            pose = _pose_in(bag, stamped.transform.translation, stamped.transform.rotation)
            links += [(parent, child, pose), (child, parent, pose.inverse())]
    # The shortest chain of them.
    poses = {camera: SAME_PLACE}
    while scanner not in poses:
        next_poses = {b: poses[a] @ pose for a, b, pose in links if a in poses and b not in poses}
        if not next_poses:
            return None
        poses |= next_poses
    return poses[scanner]


def poses_topics(bag: Bag, wanted: Sequence[str]) -> tuple[str, ...]:
    """Returns the named topics of poses, else those of odometry, else of poses."""
    odometry = tuple(bag.topics(ODOMETRY))
    poses = tuple(bag.topics(POSES))
    named = tuple(name for name in wanted if name in odometry + poses)
    return named or odometry or poses


def camera_trajectory(bag: Bag, topic: str, camera: str) -> Trajectory | None:
    """Returns the poses of the camera; None if nothing ties it to what the topic moves.

    An odometry message names the frame_id that it moves, and /tf_static gives the camera in it. A
    pose message names none, so its pose is the camera's own.
    """
    times = []
    poses = []
    body = camera
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
    numbers = [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, turn.w]
    return pose_of_quaternion(bag.path, numbers)
