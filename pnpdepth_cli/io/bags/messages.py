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
"""Suffixes of images by the beginning of their content."""
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4", "64FC1": "f8"}
"""NumPy types of a pixel, without byte order, by the encodings of depth images."""
_SENSOR = re.compile(r"/device_\d+/sensor_\d+")
"""Beginning of the topics of a sensor that librealsense recorded."""
_COMPRESSED_DEPTH = "compressedDepth"
"""In the format of a CompressedImage that is a depth image."""
_DEPTH_HEADER = 12
"""Bytes in front of its PNG."""
_MM_PER_M = 1000.0
_FASTEST_PNG = 1  # of zlib's levels
_LONGEST_WORD = 40  # characters of a message's text that an error shows
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
"""Conversions by OpenCV to blue, green and red, by encoding; other colours are in that order."""
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
_CHANNELS |= {name: 1 for name in _TO_BGR if name.startswith("bayer_")}
"""Channels of a pixel, a byte each, by the encodings of images."""


def image_file(message: Message, topic: str) -> tuple[str, bytes]:
    """Returns the suffix and the content of an image file that shows what a message shows.

    A CompressedImage holds a JPEG or a PNG, which is returned as it is. An Image is encoded as PNG.

    Args:
        message: An Image or a CompressedImage.
        topic: Name of its topic, for messages.

    Raises:
        InputError: The message holds no image that is known here.
    """
    # A CompressedImage, which has no encoding.
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        for magic, suffix in _MAGIC.items():
            if data.startswith(magic):
                return suffix, data
        kind = one_line(message.format)[:_LONGEST_WORD]
        raise InputError(f"{topic}: {kind!r} is no JPEG and no PNG; name another --topic")
    # The pixels of an Image, in blue, green and red.
    encoding = str(message.encoding)
    if encoding not in _CHANNELS:
        raise InputError(
            f"{topic}: encoding {one_line(encoding)[:_LONGEST_WORD]!r} is none of"
            f" {', '.join(_CHANNELS)}; name another --topic"
        )
    channels = _CHANNELS[encoding]
    layout = np.dtype("u1" if channels == 1 else ("u1", channels))
    pixels = np.ascontiguousarray(_grid(message, topic, layout, int(message.step)))
    if not pixels.size:
        raise InputError(f"{topic}: an image without pixels; the bag is damaged")
    if encoding in _TO_BGR:
        pixels = cv2.cvtColor(pixels, _TO_BGR[encoding])
    _, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, _FASTEST_PNG])
    return ".png", png.tobytes()


def _grid(message: Message, topic: str, layout: np.dtype[_Kind], row_bytes: int) -> NDArray[_Kind]:
    """The values (H, W) in the data of an Image or a PointCloud2.

    Args:
        message: The message.
        topic: Name of its topic, for messages.
        layout: NumPy type of a value: of a pixel, or of a point.
        row_bytes: Distance of two rows in bytes.

    Raises:
        InputError: A row does not hold the values of the width, or the data do not hold the rows.
    """
    height, width = (int(side) for side in (message.height, message.width))
    data = np.frombuffer(message.data, np.uint8)
    if width * layout.itemsize > row_bytes or height * row_bytes > data.size:
        raise InputError(
            f"{topic}: {width}×{height} values of {layout.itemsize} bytes, {row_bytes} a row, have"
            f" {data.size:,} bytes; the bag is damaged"
        )
    strides = (row_bytes, layout.itemsize)
    return np.ndarray((height, width), layout, data, offset=0, strides=strides)


def is_depth(message: Message, topic: str) -> bool:
    """Returns whether an Image or a CompressedImage is a depth image.

    Args:
        message: The message.
        topic: Name of its topic. It decides for grey images of 16 bits, which are depth if it has
            "depth" in it, as those that librealsense records.
    """
    if not hasattr(message, "encoding"):  # a CompressedImage
        return _COMPRESSED_DEPTH in str(message.format)
    if is_wide_grey(message):
        return "depth" in topic.lower()
    return str(message.encoding) in _DEPTH


def is_wide_grey(message: Message) -> bool:
    """Returns whether a message is an Image of grey of 16 bits, which may hold depth or heat."""
    return str(getattr(message, "encoding", "")) == "mono16"


def depth_unit(bag: Bag, points_topic: str) -> tuple[str, float] | None:
    """Returns the topic that states the unit of a depth sensor's codes, and the unit in metres.

    librealsense records the unit as an option of the sensor, in a topic such as
    /device_0/sensor_0/option/Depth_Units/value. None without such a topic, or without a message.

    Args:
        bag: The bag.
        points_topic: Name of the topic of the sensor's depth images.

    Raises:
        InputError: The unit is no length.
    """
    sensor = _SENSOR.match(points_topic)
    if sensor is None:
        return None  # another program's bag
    unit_topic = f"{sensor[0]}/option/Depth_Units/value"
    if unit_topic not in bag.topics(FLOATS):
        return None
    # The first message states the unit.
    for topic, _, message in bag.messages([unit_topic]):
        unit_m = float(message.data)
        if not (math.isfinite(unit_m) and unit_m > 0):
            raise InputError(f"{bag.path}: {topic} is {unit_m:g} m; state the unit: --depth-scale")
        # Six digits, as a float32 of 0.00025 is not quite that.
        return topic, float(f"{unit_m:.6g}")
    return None


def depth_image(message: Message, topic: str, scale: float | None = None) -> NDArray[np.float32]:
    """Returns the depth image (H, W) of a message in metres, 0 where unknown.

    16UC1 holds millimetres, 32FC1 metres (REP 118), unless a scale is stated. A compressed one is a
    PNG behind 12 bytes: a number, and a and b of the code a / depth + b of 32FC1
    (compressed_depth_image_transport).

    Args:
        message: An Image or a CompressedImage.
        topic: Name of its topic, for messages.
        scale: Numbers per metre. None: as ROS has them.

    Raises:
        InputError: The message is damaged, or compressed otherwise.
    """
    # An Image holds the numbers themselves.
    if hasattr(message, "encoding"):
        order = ">" if message.is_bigendian else "<"
        number = np.dtype(order + _DEPTH[str(message.encoding)])
        values = _grid(message, topic, number, int(message.step))
        scale_of_ros = 1.0 if number.kind == "f" else _MM_PER_M
        return known_metres(values / (scale or scale_of_ros))
    # A CompressedImage holds a PNG of 16UC1, or of codes of 32FC1; its format begins with these.
    data = bytes(message.data)
    kind = str(message.format).partition(";")[0].strip()
    if kind not in _DEPTH or kind_of(data[_DEPTH_HEADER:]) != "PNG":
        raise InputError(
            f"{topic}: {one_line(message.format)[:_LONGEST_WORD]!r} is no PNG of"
            f" {' or '.join(_DEPTH)}; name another --topic"
        )
    codes = read_png(Path(topic), data[_DEPTH_HEADER:]).values
    if _DEPTH[kind] == "u2":
        return known_metres(codes / (scale or _MM_PER_M))
    # The code a / depth + b, of which 0 means unknown.
    a, b = np.frombuffer(data, "<f4", 2, offset=4)
    with np.errstate(divide="ignore"):
        metres = a / (codes.astype(np.float64) - b) / (scale or 1.0)
        return known_metres(np.where(codes > 0, metres, 0))


def cloud_points(message: Message, topic: str) -> NDArray[np.float32]:
    """Returns the points (N, 3), x y z in metres, of a sensor_msgs/PointCloud2.

    The points are in the coordinates of the message's frame_id. Those without return are NaN, or
    whatever the sensor gives.

    Args:
        message: The message, with fields in any order.
        topic: Name of its topic, for messages.

    Raises:
        InputError: The message has no x, y and z, or claims more than it holds.
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
    # A cloud of one row may leave out the length of the row, row_step.
    row_bytes = int(message.row_step) if message.height > 1 else int(message.width) * step
    points = _grid(message, topic, layout, row_bytes).ravel()
    with np.errstate(over="ignore", invalid="ignore"):
        return np.column_stack([points[name] for name in "xyz"]).astype(np.float32)


def seconds_of(message: Message, logged_ns: int) -> float:
    """Returns the time in a message's header, or, where that is 0, at which it was logged; seconds.

    Args:
        message: A message with a header.
        logged_ns: Time in nanoseconds at which the message was logged.
    """
    stamp = message.header.stamp
    time_s = int(stamp.sec) + 1e-9 * int(stamp.nanosec)
    return time_s if time_s > 0 else 1e-9 * logged_ns


def nearest_pairs(
    stream: Iterable[tuple[bool, float, Message]], tolerance_s: float
) -> Iterator[tuple[float, Message, Message | None]]:
    """Yields the time in seconds of each image, the image, and the scan nearest to it in time.

    The scan is None if the nearest one is farther than the tolerance. Images keep their order. A
    scan may be the nearest of several images. Few messages are in memory at a time.

    Args:
        stream: (whether it is an image, not a scan; time in seconds; message), images in the order
            of their times, and scans in that of theirs.
        tolerance_s: Largest difference of the times of an image and its scan.
    """
    images = deque[tuple[float, Message]]()
    scans = deque[tuple[float, Message]](maxlen=_MOST_WAITING)
    # A scan after all others, so that the last images are decided.
    end = (False, math.inf, None)
    for is_image, time_s, message in itertools.chain(stream, [end]):
        waiting = images if is_image else scans
        waiting.append((time_s, message))
        while images:
            # An image is decided once a scan after it is known, or when too many wait.
            image_s, image = images[0]
            has_later_scan = len(scans) > 0 and scans[-1][0] >= image_s
            if not has_later_scan and len(images) <= _MOST_WAITING:
                break
            images.popleft()
            # Of the scans before the image, only the last can be the nearest, also of later images.
            while len(scans) > 1 and scans[1][0] <= image_s:
                scans.popleft()
            gaps_s = [abs(scan_s - image_s) for scan_s, _ in scans]
            least_gap_s = min(gaps_s, default=math.nan)
            scan = None
            if least_gap_s <= tolerance_s:
                _, scan = scans[gaps_s.index(least_gap_s)]
            yield image_s, image, scan


def camera_info_topic(bag: Bag, image_topic: str) -> str | None:
    """Returns the topic of camera_info that belongs to images; None if that is not clear.

    It is the topic beside that of the images, or else the only one.

    Args:
        bag: The bag.
        image_topic: Name of the topic of the images.
    """
    topics = bag.topics(CAMERAS)
    for end in COMPRESSED:
        image_topic = image_topic.removesuffix(end)
    folder = image_topic.rpartition("/")[0]
    folder_above = folder.rpartition("/")[0]
    # librealsense has /device_0/sensor_1/Color_0/image/data and …/Color_0/info/camera_info.
    for beside in (f"{folder}/camera_info", f"{folder_above}/info/camera_info"):
        if beside in topics:
            return beside
    return next(iter(topics)) if len(topics) == 1 else None


def camera_of_bag(bag: Bag, image_topic: str) -> tuple[Calibration, str] | None:
    """Returns the camera of images by its first camera_info, and its frame_id.

    None without camera_info, or if that is of an uncalibrated camera.

    Args:
        bag: The bag.
        image_topic: Name of the topic of the images.

    Raises:
        InputError: The camera_info is no camera's.
    """
    topic = camera_info_topic(bag, image_topic)
    if topic is None:
        return None
    for _, _, message in bag.messages([topic]):
        # K, D, R and P, which ROS 2 writes in lower case and ROS 1 in upper case.
        values = {
            name: np.asarray(getattr(message, name, getattr(message, name.upper(), ())), np.float64)
            for name in "kdrp"
        }
        if not values["k"].any():
            return None  # an uncalibrated camera
        content: dict[str, object] = {
            name: numbers for name, numbers in values.items() if np.isfinite(numbers).all()
        }
        model = str(message.distortion_model) if values["d"].size else "none"
        content |= {"distortion_model": model, "width": message.width, "height": message.height}
        calibration = camera_in_yaml(bag.path, content, None)
        camera = replace(calibration.camera, source=topic)
        return replace(calibration, camera=camera), frame_of(message)
    return None


def frame_of(message: Message) -> str:
    """Returns the frame_id in a message's header, without ROS 1's leading slash."""
    return str(message.header.frame_id).lstrip("/")


def static_pose(bag: Bag, camera: str, scanner: str) -> Extrinsics | None:
    """Returns the pose of a scanner in a camera's coordinates by the transforms of /tf_static.

    None if no chain of transforms leads from one to the other.

    Args:
        bag: The bag.
        camera: frame_id of the camera.
        scanner: frame_id of the scanner.
    """
    # The transforms in both directions: two frames, and the pose of the second in the first.
    links: list[tuple[str, str, Extrinsics]] = []
    topics = [name for name in bag.topics(TRANSFORMS) if name.endswith("/tf_static")]
    for _, _, message in bag.messages(topics):
        for stamped in message.transforms:
            parent = frame_of(stamped)
            child = str(stamped.child_frame_id).lstrip("/")
            pose = _pose_in(bag, stamped.transform.translation, stamped.transform.rotation)
            links += [(parent, child, pose), (child, parent, pose.inverse())]
    # The shortest chain: the poses in the camera's coordinates of all frames that one transform
    # reaches, then of those that two reach, and so on.
    poses = {camera: SAME_PLACE}
    while scanner not in poses:
        reached = {
            next_frame: poses[frame] @ pose
            for frame, next_frame, pose in links
            if frame in poses and next_frame not in poses
        }
        if not reached:
            return None
        poses |= reached
    return poses[scanner]


def poses_topics(bag: Bag, wanted: Sequence[str]) -> tuple[str, ...]:
    """Returns the topics of poses that the user named, else all of odometry, else all of poses.

    There are none if the bag has neither.

    Args:
        bag: The bag.
        wanted: Names of topics of any kind, which the user gave.
    """
    odometry = tuple(bag.topics(ODOMETRY))
    poses = tuple(bag.topics(POSES))
    named = tuple(name for name in wanted if name in odometry + poses)
    return named or odometry or poses


def camera_trajectory(bag: Bag, topic: str, camera: str) -> Trajectory | None:
    """Returns the poses of a camera over time, from its coordinates to the world's.

    A message of odometry moves the body that it names, and /tf_static gives the pose of the camera
    on that. A message of a pose names no body, so it moves the camera itself. None without a
    message, or if no transform ties the camera to the body.

    Args:
        bag: The bag.
        topic: Name of a topic of odometry or poses.
        camera: frame_id of the camera.
    """
    times_s = []
    body_poses = []
    body = camera
    for _, logged_ns, message in bag.messages([topic]):
        body = str(getattr(message, "child_frame_id", "")).lstrip("/") or camera
        # Odometry and PoseWithCovarianceStamped have the pose beside its covariance.
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        times_s.append(seconds_of(message, logged_ns))
        body_poses.append(_pose_in(bag, pose.position, pose.orientation).square())
    camera_on_body = static_pose(bag, body, camera)
    if not body_poses or camera_on_body is None:
        return None
    poses = np.stack(body_poses) @ camera_on_body.square()
    return trajectory_of(np.array(times_s), poses[:, :3])


def _pose_in(bag: Bag, shift: Message, turn: Message) -> Extrinsics:
    """The pose of a geometry_msgs/Vector3 or Point in metres, and a Quaternion.

    Raises:
        InputError: The quaternion is not of length 1, or the translation is of no sensor.
    """
    numbers = [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, turn.w]
    return pose_of_quaternion(bag.path, numbers)
