"""The camera's trajectory in a bag: of an odometry or pose topic, or of moving transforms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.bags.bag import TRANSFORMS, Bag
from pnpdepth_cli.io.bags.calibration import (
    STATIC,
    add_link,
    chained,
    link_of,
    pose_in_message,
    static_links,
)
from pnpdepth_cli.io.bags.messages import seconds_of
from pnpdepth_cli.io.extrinsics import Extrinsics
from pnpdepth_cli.io.poses import Trajectory, trajectory_of

ODOMETRY = ("nav_msgs/msg/Odometry",)
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")

_STILL = 1e-9
"""Largest change of a number of a transform that does not move."""

Floats = NDArray[np.float64]


def poses_topics(bag: Bag, wanted: str | None) -> tuple[str, ...]:
    """Returns the topics of odometry, else those of poses, else of moving transforms; or the named.

    Raises:
        UsageError: The named one is not there.
    """
    moving = tuple(name for name in bag.topics(TRANSFORMS) if not name.endswith(STATIC))
    kinds = tuple(bag.topics(ODOMETRY)), tuple(bag.topics(POSES)), moving
    if wanted is None:
        return next((names for names in kinds if names), ())
    if not any(wanted in names for names in kinds):
        there = ", ".join(name for names in kinds for name in names)
        raise UsageError(f"{bag.path} has no poses in {wanted}; there are {there or 'none'}")
    return (wanted,)


def camera_trajectory(bag: Bag, topic: str, camera: str) -> Trajectory | None:
    """Returns the poses of the camera; None if nothing ties it to what the topic moves.

    An odometry message names the frame that it moves, and /tf_static gives the camera in it. A pose
    message names none, so its pose is the camera's own. Of transforms, the first above the camera
    that changes is taken: that of odometry, without later corrections of the map.

    Args:
        bag: An open bag.
        topic: One of `poses_topics`.
        camera: Name of the camera's frame.

    Raises:
        FileFormatError: A message holds no pose.
    """
    if topic in bag.topics(TRANSFORMS):
        return _of_transforms(bag, topic, camera)
    times, poses, body = [], [], camera
    for _, logged_ns, message in bag.messages([topic]):
        body = str(getattr(message, "child_frame_id", "")).lstrip("/") or camera
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        times.append(seconds_of(message, logged_ns))
        poses.append(_square(pose_in_message(bag, pose.position, pose.orientation)))
    in_body = chained(static_links(bag), body, camera)
    return None if in_body is None else _of_camera(times, poses, in_body)


def _of_transforms(bag: Bag, topic: str, camera: str) -> Trajectory | None:
    times: dict[tuple[str, str], list[float]] = {}
    poses: dict[tuple[str, str], list[Floats]] = {}
    for parent, child, time_s, pose in _transforms(bag, topic):
        times.setdefault((parent, child), []).append(time_s)
        poses.setdefault((parent, child), []).append(pose)
    links, moving = static_links(bag), []
    for link, series in poses.items():
        if np.ptp(np.stack(series), axis=0).max() > _STILL:
            moving.append(link)
        else:  # ROS 1 repeats fixed transforms
            add_link(links, *link, (series[0][:3, :3], series[0][:3, 3]))
    above = [
        (link, in_body)
        for link in moving
        if (in_body := chained(links, link[1], camera)) is not None
        and chained(links, link[0], camera) is None
    ]
    if len(above) != 1:
        return None
    ((link, in_body),) = above
    return _of_camera(times[link], poses[link], in_body)


def _transforms(bag: Bag, topic: str) -> Iterator[tuple[str, str, float, Floats]]:
    """Yields (parent, child, seconds, pose (4, 4)) of every transform."""
    for _, logged_ns, message in bag.messages([topic]):
        for each in message.transforms:
            parent, child, pose = link_of(bag, each)
            yield parent, child, seconds_of(each, logged_ns), _square(pose)


def _of_camera(times: list[float], poses: list[Floats], in_body: Extrinsics) -> Trajectory | None:
    if not poses:
        return None
    return trajectory_of(np.array(times), (np.stack(poses) @ _square(in_body))[:, :3])


def _square(pose: Extrinsics) -> Floats:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = pose
    return result
