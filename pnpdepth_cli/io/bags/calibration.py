"""The calibration that a bag holds: camera_info of a camera, and static transforms."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from pnpdepth_cli.io.bags.bag import CAMERAS, TRANSFORMS, Bag
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.extrinsics import Extrinsics, inverse, pose_of_quaternion
from pnpdepth_cli.io.robot_calibration import camera_in_yaml

STATIC = "/tf_static"
"""End of the name of the topic of fixed transforms."""

Links = dict[str, dict[str, Extrinsics]]
"""Pose of the second frame in the first."""


def camera_info_topic(bag: Bag, image_topic: str) -> str | None:
    """Returns the topic of the camera's intrinsics: beside the image's, or the only one."""
    topics = bag.topics(CAMERAS)
    parts = image_topic.removesuffix("/compressed").split("/")[:-1]
    beside = "/".join([*parts, "camera_info"])
    if beside in topics:
        return beside
    return next(iter(topics)) if len(topics) == 1 else None


def camera_of_bag(bag: Bag, topic: str) -> tuple[Calibration, str] | None:
    """Returns the camera of the first message of a camera_info topic, and its frame's name."""
    for _, _, message in bag.messages([topic]):
        matrix, distortion = (getattr(message, n, getattr(message, n.upper(), ())) for n in "kd")
        if not np.any(matrix):
            return None  # an uncalibrated camera
        content = {
            "camera_matrix": [float(value) for value in matrix],
            "distortion_coefficients": [float(value) for value in distortion],
            "distortion_model": str(message.distortion_model) if len(distortion) else "none",
            "width": int(message.width),
            "height": int(message.height),
        }
        calibration = camera_in_yaml(bag.path, content, None)
        return replace(calibration, source=topic), frame_of(message)
    return None


def rectified_cameras(bag: Bag, topic: str, raw: Calibration) -> dict[str, Calibration]:
    """Returns the cameras of a rectified image of a camera_info topic, by what they are made of.

    None has distortion. Whether the transforms lead to the rectified camera (kitti2bag) or to the
    raw one, to which R and the last column of P then lead, no message says. The first is as the
    definition of CameraInfo has it. Empty without P, or where P describes the raw image.

    Args:
        bag: An open bag.
        topic: Of camera_info.
        raw: The camera of the raw image, without a pose.
    """
    _, _, message = next(iter(bag.messages([topic])))
    p, r = (np.array(getattr(message, n, getattr(message, n.upper(), ())), float) for n in "pr")
    if p.size != 12 or not (p[0] > 0 and p[5] > 0 and np.isfinite(p).all()):
        return {}
    projection = p.reshape(3, 4)
    intrinsics = projection[:, :3]
    turn = r.reshape(3, 3) if r.size == 9 and np.isfinite(r).all() and r.any() else np.eye(3)
    offset = np.linalg.solve(intrinsics, projection[:, 3])
    plain = replace(
        raw, intrinsics=intrinsics, distortion=(), lens="radial-tangential", source=topic
    )
    turned = replace(plain, rotation=turn, translation=offset)
    same = np.allclose(intrinsics, raw.intrinsics, atol=1e-3) and not any(raw.distortion)
    unturned = np.allclose(turn, np.eye(3), atol=1e-9)
    cameras = {"P": plain}
    if not unturned:
        cameras = {"P and R": replace(turned, translation=np.zeros(3))} | cameras
    if np.abs(offset).max() > 1e-9:
        name = "P with its offset" if unturned else "P with its offset, and R"
        cameras = {name: turned} | cameras
    return {} if same and len(cameras) == 1 else cameras


def frame_of(message: Any) -> str:
    """Returns the name of the frame in a message's header, without ROS 1's leading slash."""
    return str(message.header.frame_id).lstrip("/")


def static_pose(bag: Bag, camera: str, scanner: str) -> Extrinsics | None:
    """Returns the pose of the scanner's frame in the camera's, by /tf_static; None without one."""
    if camera == scanner:
        return np.eye(3), np.zeros(3)
    return chained(static_links(bag), camera, scanner)


def static_links(bag: Bag) -> Links:
    """Returns the transforms of /tf_static, each in both directions."""
    links: Links = {}
    topics = [name for name in bag.topics(TRANSFORMS) if name.endswith(STATIC)]
    for _, _, message in bag.messages(topics):
        for each in message.transforms:
            add_link(links, *link_of(bag, each))
    return links


def link_of(bag: Bag, message: Any) -> tuple[str, str, Extrinsics]:
    """Returns (parent, child, pose of the child in the parent) of a TransformStamped."""
    parent, child = frame_of(message), str(message.child_frame_id).lstrip("/")
    shift, turn = message.transform.translation, message.transform.rotation
    return parent, child, pose_in_message(bag, shift, turn)


def pose_in_message(bag: Bag, shift: Any, turn: Any) -> Extrinsics:
    """Returns the pose of a vector and a quaternion. Raises FileFormatError if it is none."""
    return pose_of_quaternion(
        bag.path, [shift.x, shift.y, shift.z], [turn.x, turn.y, turn.z, turn.w]
    )


def add_link(links: Links, parent: str, child: str, pose: Extrinsics) -> None:
    """Adds the pose of a child in its parent to the links, and its inverse."""
    links.setdefault(parent, {})[child] = pose
    links.setdefault(child, {})[parent] = inverse(pose)


def chained(links: Links, start: str, end: str) -> Extrinsics | None:
    """Returns the pose x_start = pose · x_end along the shortest chain of links; None if none."""
    poses: dict[str, Extrinsics] = {start: (np.eye(3), np.zeros(3))}
    waiting = deque([start])
    while waiting and end not in poses:
        frame = waiting.popleft()
        rotation, translation = poses[frame]
        for other, (turn, shift) in links.get(frame, {}).items():
            if other not in poses:
                poses[other] = rotation @ turn, rotation @ shift + translation
                waiting.append(other)
    return poses.get(end)
