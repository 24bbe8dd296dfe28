"""The sensors of a bag: topics of images and of points, their clocks, and what was measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.plausible import scan_returns
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.io.bags import (
    CLOUDS,
    IMAGES,
    Bag,
    choose_topic,
)
from pnpdepth_cli.io.bags.messages import (
    Stamped,
    camera_info_topic,
    camera_of_bag,
    cloud_points,
    depth_image,
    frame_of,
    is_depth,
    seconds_of,
)
from pnpdepth_cli.sensors.lens import unproject

_DELAYS = 20
"""Number of messages of each topic whose delay is measured."""

_SLOWEST_S = 1.0
"""A larger difference of delays is that of two clocks."""

_SAME_K = 0.05
"""Relative difference of intrinsics of one camera, which a driver may have calibrated twice."""

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Which topics hold images and depth."""

    images: str
    points: str
    is_depth: bool
    """Whether the points are depth images."""
    depth_camera: Camera | None = None
    """Camera of the depth images. None: that of the images, or the points are clouds."""

    @property
    def is_map(self) -> bool:
        """Whether the points are depth images of the images' own camera."""
        return self.is_depth and self.depth_camera is None


def sensors_of(bag: Bag, wanted: Sequence[str], say: Say) -> Sensors:
    """Returns the topics that are named, or the only ones; clouds rather than depth images.

    Of several depth images, those with the images' frame_id are taken.
    """
    # Topics of images hold colours or depth, which the first message tells.
    topics = bag.topics(IMAGES)
    found = {name: next(bag.messages([name]), None) for name in topics}
    first = {name: message[2] for name, message in found.items() if message is not None}
    counts = {name: topics[name] for name in first}
    depths = {name: count for name, count in counts.items() if is_depth(first[name], name)}
    colours = {name: count for name, count in counts.items() if name not in depths}
    # Points are clouds, unless depth images are named or alone.
    images, clouds = choose_topic(bag, wanted, colours, "images"), bag.topics(CLOUDS)
    if not depths or (clouds and not set(wanted) & set(depths)):
        points = choose_topic(bag, wanted, clouds, f"points ({CLOUDS[0]} or depth images)")
        return Sensors(images=images, points=points, is_depth=False)
    # Depth images with the colours' frame_id are preferred.
    frame = frame_of(first[images])
    registered = {name: count for name, count in depths.items() if frame_of(first[name]) == frame}
    usable = depths if set(wanted) & set(depths) else registered or depths
    points = choose_topic(bag, wanted, usable, "depth images")
    same = Sensors(images=images, points=points, is_depth=True)
    # They may be of a camera of their own.
    infos = camera_info_topic(bag, images), camera_info_topic(bag, points)
    found_cameras = (None if info is None else camera_of_bag(bag, info) for info in infos)
    of_images, of_depth = (None if each is None else each[0].camera for each in found_cameras)
    if of_depth is None or infos[0] == infos[1]:
        if points not in registered and of_depth is None:
            say(f"warning: {points} has no camera_info; its pixels are taken for the images'")
        return same
    if (
        points in registered
        and of_images is not None
        and of_images.size == of_depth.size
        and np.allclose(of_images.intrinsics, of_depth.intrinsics, rtol=_SAME_K)
    ):
        return same
    return replace(same, depth_camera=of_depth)


def measurement(sensors: Sensors, message: Any) -> tuple[NDArray[np.float32], dict[str, int]]:
    """Returns depth (H, W) of the images' camera, or points (N, 3); and counts of what is none.

    Raises:
        NoPointsError: Nothing was measured.
    """
    topic = sensors.points
    if not sensors.is_depth:
        cloud = cloud_points(message, topic)
    else:
        depth = depth_image(message, topic)
        if not depth.any():
            raise NoPointsError(f"{topic}: a depth image without depth")
        if sensors.depth_camera is None:
            return depth, {}
        rows, columns = np.nonzero(depth)
        xy = np.column_stack([columns, rows]).astype(np.float64)
        cloud = unproject(sensors.depth_camera, xy, depth[rows, columns]).astype(np.float32)
    # the unit is left to what reads the frames
    points, counts, _ = scan_returns(topic, cloud, scale=1.0)
    return points, counts


def stream(bag: Bag, sensors: Sensors, offset: float = 0.0) -> Iterator[tuple[bool, Stamped]]:
    """Yields whether it is an image, and the message; `offset` is added to times of points."""
    for topic, logged_ns, message in bag.messages([sensors.images, sensors.points]):
        is_image = topic == sensors.images
        time_s = seconds_of(message, logged_ns) + (0.0 if is_image else offset)
        yield is_image, Stamped(time_s, message)


def clock_offset(bag: Bag, sensors: Sensors, say: Say) -> float:
    """Returns seconds to add to the times of points: the difference of two clocks if it is large.

    One clock times the log of both topics. So their delays from stamp to log differ by the offset,
    and by how long each message took, which is less than a second.
    """
    topics = sensors.images, sensors.points
    delays: dict[str, list[float]] = {topic: [] for topic in topics}
    for topic, logged_ns, message in bag.messages(topics):
        delays[topic].append(1e-9 * logged_ns - seconds_of(message, logged_ns))
        if min(map(len, delays.values())) >= _DELAYS or len(delays[topic]) >= 10 * _DELAYS:
            break
    if not all(delays.values()):
        return 0.0
    of_images, of_points = (float(np.median(delays[topic])) for topic in topics)
    offset = round(of_points - of_images, 6)
    if abs(offset) <= _SLOWEST_S:
        return 0.0
    say(
        f"warning: by the times of the log, {topics[0]} and {topics[1]} have two clocks;"
        f" {offset:+.3f} s are added to the times of points (--clock-offset gives another number)"
    )
    return offset
