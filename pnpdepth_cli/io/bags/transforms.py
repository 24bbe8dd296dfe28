"""The camera of a bag and where it is: camera_info, static transforms, and poses over time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Extrinsics
from pnpdepth_cli.io.bags import CAMERAS, COMPRESSED, ODOMETRY, POSES, TRANSFORMS, Bag
from pnpdepth_cli.io.bags.messages import seconds_of
from pnpdepth_cli.io.calibration import Calibration, camera_in_yaml
from pnpdepth_cli.io.extrinsics import pose_of_quaternion
from pnpdepth_cli.io.poses import Trajectory, trajectory_of

_STATIC = "/tf_static"
"""End of the name of the topic of fixed transforms."""

_STILL = 1e-9
"""Largest change of a number of a transform that does not move."""

Links = dict[str, dict[str, Extrinsics]]
"""Pose of the second frame in the first."""
Floats = NDArray[np.float64]


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


def frame_of(message: Any) -> str:
    """Returns the frame_id in a message's header, without ROS 1's leading slash."""
    return str(message.header.frame_id).lstrip("/")


def static_pose(bag: Bag, camera: str, scanner: str) -> Extrinsics | None:
    """Returns the scanner's pose in the camera's coordinates, by /tf_static; None without one."""
    return _chain(_static_links(bag), camera, scanner)


def poses_topics(bag: Bag, wanted: Sequence[str]) -> tuple[str, ...]:
    """Returns the named topics of poses, else those of odometry, poses, or moving transforms."""
    moving = tuple(sorted(set(bag.topics(TRANSFORMS)) - set(_static_topics(bag))))
    kinds = tuple(bag.topics(ODOMETRY)), tuple(bag.topics(POSES)), moving
    named = tuple(name for name in wanted if any(name in names for names in kinds))
    return named or next((names for names in kinds if names), ())


def camera_trajectory(bag: Bag, topic: str, camera: str) -> Trajectory | None:
    """Returns the poses of the camera; None if nothing ties it to what the topic moves.

    An odometry message names the frame_id that it moves, and /tf_static gives the camera in it. A
    pose message names none, so its pose is the camera's own. Of transforms, the first above the
    camera that changes is taken. It is that of odometry, without later corrections of the map.
    """
    if topic in bag.topics(TRANSFORMS):
        return _of_transforms(bag, topic, camera)
    times, poses, body = [], [], camera
    for _, logged_ns, message in bag.messages([topic]):
        body = str(getattr(message, "child_frame_id", "")).lstrip("/") or camera
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        times.append(seconds_of(message, logged_ns))
        poses.append(_pose_in(bag, pose.position, pose.orientation).square())
    return _of_camera(times, poses, _chain(_static_links(bag), body, camera))


def _of_transforms(bag: Bag, topic: str, camera: str) -> Trajectory | None:
    series: dict[tuple[str, str], tuple[list[float], list[Floats]]] = {}
    for link, time_s, pose in _transforms(bag, [topic]):
        times, poses = series.setdefault(link, ([], []))
        times.append(time_s)
        poses.append(pose.square())
    links, moving = _static_links(bag), []
    for link, (_, poses) in series.items():
        if np.ptp(np.stack(poses), axis=0).max() > _STILL:
            moving.append(link)
        else:  # ROS 1 repeats fixed transforms
            _add_link(links, link, Extrinsics(poses[0][:3, :3], poses[0][:3, 3]))
    above = [
        link
        for link in moving
        if _chain(links, link[1], camera) is not None and _chain(links, link[0], camera) is None
    ]
    if len(above) != 1:
        return None
    return _of_camera(*series[above[0]], _chain(links, above[0][1], camera))


def _of_camera(
    times: list[float], poses: list[Floats], in_body: Extrinsics | None
) -> Trajectory | None:
    if not poses or in_body is None:
        return None
    return trajectory_of(np.array(times), (np.stack(poses) @ in_body.square())[:, :3])


def _static_topics(bag: Bag) -> list[str]:
    return [name for name in bag.topics(TRANSFORMS) if name.endswith(_STATIC)]


def _static_links(bag: Bag) -> Links:
    """The transforms of /tf_static, each in both directions."""
    links: Links = {}
    for link, _, pose in _transforms(bag, _static_topics(bag)):
        _add_link(links, link, pose)
    return links


def _transforms(
    bag: Bag, topics: Sequence[str]
) -> Iterator[tuple[tuple[str, str], float, Extrinsics]]:
    """Yields (parent, child), seconds and the pose of the child in the parent."""
    for _, logged_ns, message in bag.messages(topics):
        for each in message.transforms:
            link = frame_of(each), str(each.child_frame_id).lstrip("/")
            pose = _pose_in(bag, each.transform.translation, each.transform.rotation)
            yield link, seconds_of(each, logged_ns), pose


def _pose_in(bag: Bag, shift: Any, turn: Any) -> Extrinsics:
    xyzw = [turn.x, turn.y, turn.z, turn.w]
    return pose_of_quaternion(bag.path, [shift.x, shift.y, shift.z], xyzw)


def _add_link(links: Links, link: tuple[str, str], pose: Extrinsics) -> None:
    parent, child = link
    links.setdefault(parent, {})[child] = pose
    links.setdefault(child, {})[parent] = pose.inverse()


def _chain(links: Links, start: str, end: str) -> Extrinsics | None:
    """The pose x_start = pose · x_end along the shortest chain of links; None if none."""
    poses = {start: SAME_PLACE}
    waiting = deque([start])
    while waiting and end not in poses:
        frame = waiting.popleft()
        for other, pose in links.get(frame, {}).items():
            if other not in poses:
                poses[other] = poses[frame] @ pose
                waiting.append(other)
    return poses.get(end)
