"""The sensors of a bag: its topics of images and points, their clocks, and what was measured."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.scan_returns import scan_returns
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.io.bags import CLOUDS, IMAGES, Bag, Message, choose_topic, messages
from pnpdepth_cli.sensors.lens import unproject

_DELAYS = 20
"""Messages of each topic, from the first, whose delay is measured."""
_SLOWEST_S = 1.0
"""A larger difference of delays is that of two clocks."""
_REGISTERED = re.compile("aligned|registered")
"""A word in topics of depth that is registered to the images."""
_SAME_K = 0.05
"""Largest relative difference of intrinsics of one camera that was calibrated twice."""

Say = Callable[[str], None]
"""Receives a line for a person; a warning begins with "warning"."""


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Which topics hold images and depth."""

    images: str
    """Topic of the images."""
    points: str
    """Topic of the points: clouds, or depth images."""
    is_map: bool = False
    """Whether the points are depth images of the images' own camera."""
    depth_camera: Camera | None = None
    """The camera of depth images that is another than the images'. None: the points are clouds, or
    depth images of the images' own camera."""
    scale: float | None = None
    """Numbers per metre of the points. None: as ROS has them (REP 118)."""


def sensors_of(bag: Bag, wanted: Sequence[str], say: Say) -> Sensors:
    """Returns the topics of images and points: those that are named, or the only ones.

    Clouds go before depth images, unless these are named. Of several depth images, those with the
    images' frame_id are taken.

    Args:
        bag: The open bag.
        wanted: Topics that the user names, of any kind.
        say: Receives what was guessed, and warnings.

    Raises:
        UsageError: There are several topics of a kind, or none.
    """
    # Topics of images hold colours or depth, which the first message tells.
    counts = bag.topics(IMAGES)
    first_messages = dict[str, Message]()
    for topic in counts:
        for _, _, message in itertools.islice(bag.messages([topic]), 1):
            first_messages[topic] = message
    depths = {topic: counts[topic] for topic in _depth_topics(bag, first_messages, wanted, say)}
    colours = {topic: counts[topic] for topic in first_messages if topic not in depths}
    # Points are clouds, unless depth images are named or alone.
    images = choose_topic(bag, wanted, colours, "images")
    clouds = bag.topics(CLOUDS)
    are_depths_named = not depths.keys().isdisjoint(wanted)
    if not depths or (clouds and not are_depths_named):
        points = choose_topic(bag, wanted, clouds, f"points ({CLOUDS[0]} or depth images)")
        return Sensors(images=images, points=points)
    # Depth images with the images' frame_id are preferred; they may be of a camera of their own.
    frame_id = messages.frame_of(first_messages[images])
    registered = {
        topic: count
        for topic, count in depths.items()
        if messages.frame_of(first_messages[topic]) == frame_id
    }
    candidates = registered if registered and not are_depths_named else depths
    points = choose_topic(bag, wanted, candidates, "depth images")
    depth_camera = _depth_camera(bag, images, points, points in registered, say)
    return Sensors(
        images=images, points=points, is_map=depth_camera is None, depth_camera=depth_camera
    )


def _depth_topics(
    bag: Bag, first_messages: Mapping[str, Message], wanted: Sequence[str], say: Say
) -> list[str]:
    """The topics of images that hold depth.

    Args:
        bag: The open bag.
        first_messages: The first message of each topic of images.
        wanted: Topics that the user names, of any kind.
        say: Receives what was guessed.
    """
    depths = [
        topic for topic, message in first_messages.items() if messages.is_depth(message, topic)
    ]
    if not set(depths).isdisjoint(wanted) or len(first_messages) < 2:
        return depths
    # Grey images of 16 bits are depth, too, if the user names them beside others, or if nothing
    # else gives points.
    grey = [
        topic
        for topic, message in first_messages.items()
        if topic not in depths and messages.is_wide_grey(message)
    ]
    guessed = [topic for topic in grey if topic in wanted]
    are_others_colours = len(grey) < len(first_messages)
    if not guessed and not depths and not bag.topics(CLOUDS) and are_others_colours:
        guessed = grey
    for topic in guessed:
        say(f"topics: {topic}, grey images of 16 bits, is taken for depth")
    return [*depths, *guessed]


def _depth_camera(
    bag: Bag, images: str, points: str, has_same_frame_id: bool, say: Say
) -> Camera | None:
    """The camera of depth images; None if their pixels are those of the images.

    Depth images without a camera_info of their own are taken to have the images' pixels.

    Args:
        bag: The open bag.
        images: Topic of the images.
        points: Topic of the depth images.
        has_same_frame_id: Whether both have one frame_id.
        say: Receives a warning if nothing tells that depth and images belong together.
    """
    cameras: list[Camera | None] = []
    for topic in (images, points):
        calibration_and_frame = messages.camera_of_bag(bag, topic)
        if calibration_and_frame is None:
            cameras.append(None)
        else:
            calibration, _ = calibration_and_frame
            cameras.append(calibration.camera)
    of_images, of_depth = cameras
    # Depth has no camera_info.
    if of_depth is None:
        _warn_of_unregistered(points, has_same_frame_id, say)
        return None
    # Only depth has a camera_info.
    if of_images is None:
        return of_depth
    # Both have one and the same camera_info, so depth has none of its own.
    if of_images.source == of_depth.source:
        _warn_of_unregistered(points, has_same_frame_id, say)
        return None
    # Two camera_infos that are alike are of one camera.
    has_same_k = np.allclose(of_images.intrinsics, of_depth.intrinsics, rtol=_SAME_K)
    if has_same_frame_id and has_same_k and of_images.size == of_depth.size:
        return None
    return of_depth


def _warn_of_unregistered(points: str, has_same_frame_id: bool, say: Say) -> None:
    """Warns of depth images whose camera nothing tells, unless their frame or topic does.

    Args:
        points: Topic of the depth images.
        has_same_frame_id: Whether they have the images' frame_id.
        say: Receives the warning.
    """
    if has_same_frame_id or _REGISTERED.search(points):
        return
    say(
        f"warning: {points} has no camera_info and is in another frame than the images; its pixels"
        " are taken for the images', which is wrong unless it is registered to them"
    )


def with_scale(bag: Bag, sensors: Sensors, stated: float | None) -> tuple[Sensors, str | None]:
    """Returns the topics with the scale that the user or the bag states, and a line on it.

    Args:
        bag: The open bag.
        sensors: The topics without a scale.
        stated: Numbers per metre of the points that the user states. None: nothing.

    Returns:
        The topics as they are, and None, if nobody states a scale.
    """
    if stated is not None:
        line = f"points: ÷ {stated:g}, as --depth-scale states"
        return replace(sensors, scale=stated), line
    unit = messages.depth_unit(bag, sensors.points)
    if unit is None:
        return sensors, None
    topic, unit_m = unit
    line = f"points: {1000 * unit_m:g} mm a code, as {topic} says; --depth-scale to change"
    return replace(sensors, scale=1 / unit_m), line


def measurement(sensors: Sensors, message: Message) -> tuple[NDArray[np.float32], dict[str, int]]:
    """Returns what a message of the points measured, and how many of its points are no return.

    Args:
        sensors: Topic and camera of the points.
        message: A depth image or a cloud.

    Returns:
        What was measured, and the numbers of points that were dropped, by the reason. If the points
        are depth images of the images' own camera, it is depth (H, W) in metres, 0 where unknown,
        and nothing is dropped. Else it is points (N, 3) in the coordinates of the scanner or of the
        depth camera: in metres, or as stored in a cloud whose scale nobody states.

    Raises:
        NoPointsError: Nothing was measured.
        InputError: The message is damaged.
    """
    topic = sensors.points
    is_cloud = not sensors.is_map and sensors.depth_camera is None
    if is_cloud:
        cloud = messages.cloud_points(message, topic)
    else:
        depth = messages.depth_image(message, topic, sensors.scale)
        if not depth.any():
            raise NoPointsError(f"{topic}: a depth image without depth")
        if sensors.depth_camera is None:
            return depth, {}
        # Depth of a camera of its own becomes points in that camera's coordinates.
        rows, columns = np.nonzero(depth)
        xy = np.column_stack([columns, rows]).astype(np.float64)
        cloud = unproject(sensors.depth_camera, xy, depth[rows, columns]).astype(np.float32)
    # Depth images are in metres already. A cloud whose scale nobody states stays as it is stored,
    # and its unit is left to what reads the frames.
    scale = 1.0
    if is_cloud and sensors.scale is not None:
        scale = sensors.scale
    # Empty: the scale is stated of these very numbers, and not of the integers of another file.
    of_integers = ""
    returns = scan_returns(topic, cloud, scale=scale, of_integers=of_integers)
    return returns.points, returns.dropped


def stream(bag: Bag, sensors: Sensors, offset_s: float) -> Iterator[tuple[bool, float, Message]]:
    """Yields the messages of both topics: whether it is an image, its time, and the message.

    Args:
        bag: The open bag.
        sensors: The topics.
        offset_s: Seconds that are added to the times of points.
    """
    for topic, logged_ns, message in bag.messages([sensors.images, sensors.points]):
        is_image = topic == sensors.images
        time_s = messages.seconds_of(message, logged_ns)
        yield is_image, time_s if is_image else time_s + offset_s, message


def clock_offset(bag: Bag, sensors: Sensors, say: Say) -> float:
    """Returns seconds to add to the times of points: the difference of two clocks if it is large.

    One clock times the log of both topics. So their delays from stamp to log differ by the offset,
    and by how long each message took, which is less than a second.

    Args:
        bag: The open bag.
        sensors: The topics.
        say: Receives a warning if the clocks differ.

    Returns:
        0 if the clocks differ by less than that second, or a topic has no message.
    """
    # Seconds from stamp to log of the first messages of the images, then of the points.
    delays_s = list[list[float]]()
    for topic in (sensors.images, sensors.points):
        first = itertools.islice(bag.messages([topic]), _DELAYS)
        delays_s.append(
            [
                1e-9 * logged_ns - messages.seconds_of(message, logged_ns)
                for _, logged_ns, message in first
            ]
        )
    if not all(delays_s):
        return 0.0
    of_images, of_points = delays_s
    offset_s = round(float(np.median(of_points) - np.median(of_images)), 6)
    if abs(offset_s) <= _SLOWEST_S:
        return 0.0
    say(
        f"warning: by the times of the log, {sensors.images} and {sensors.points} have two clocks;"
        f" {offset_s:+.3f} s are added to the times of points (--clock-offset gives another number)"
    )
    return offset_s
