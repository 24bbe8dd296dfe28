"""The camera's files of a bag: its calibration as calib.txt, and its poses as poses.txt."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.commands.bag_frames.bag_sensors import Say, Sensors
from pnpdepth_cli.dataset.rectified_camera import choose_camera
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.bags import Bag, messages
from pnpdepth_cli.io.calibration import Calibration

_LONGEST_GAP_S = 0.5
"""Longest time between two poses between which a pose is interpolated."""

ImageAndScan = tuple[NDArray[np.float32], NDArray[np.floating]]
"""An image (H, W, 3) in 0…1, and the points (N, 3) of its scan in the scanner's coordinates."""


def write_calibration(
    path: Path, bag: Bag, sensors: Sensors, frames: Iterable[ImageAndScan], say: Say
) -> tuple[str, bool]:
    """Writes the calibration of a bag's sensors, if the bag has one.

    Args:
        path: File to write.
        bag: The open bag.
        sensors: Topics of the images and the points.
        frames: A few images with their scans, whose edges tell whether the images are rectified.
        say: Receives what was found, and warnings.

    Returns:
        The frame_id of the camera's coordinates, and whether the file was written.
    """
    # The frame_ids of both sensors, as their first messages have them.
    frame_ids = []
    for topic in (sensors.images, sensors.points):
        _, _, first_message = next(bag.messages([topic]))
        frame_ids.append(messages.frame_of(first_message))
    camera, points = frame_ids
    # The camera, from camera_info, which may name its frame.
    calibration_and_frame = messages.camera_of_bag(bag, sensors.images)
    if calibration_and_frame is None:
        say(f"warning: {bag.path} has no camera_info of {sensors.images}; refine with --calib")
        return camera, False
    calibration, frame_of_info = calibration_and_frame
    camera = frame_of_info or camera
    source = calibration.camera.source
    # The pose of the scanner, from static transforms.
    scanner = messages.static_pose(bag, camera, points)
    if scanner is not None:
        source += f", and /tf_static from {camera} to {points}"
        calibration = replace(calibration, scanner=scanner)
    if scanner is None and not sensors.is_map:
        say(
            f"warning: {bag.path} has no static transform from {camera} to {points}; refine"
            " with --extrinsics FILE"
        )
    else:
        say(f"calibration: {source}")
    # Whether the images are rectified, which edges tell only with scans.
    if calibration.rectified:
        compared = () if sensors.is_map else frames
        calibration, note = choose_camera(calibration, compared, sensors.images)
        say(note)
    with atomic_path(path) as temporary:
        temporary.write_text(_calibration_text(calibration))
    return camera, True


def _calibration_text(calibration: Calibration) -> str:
    """The calibration as `read_calibration` reads it: a line for each of K, distortion, R, t, …"""
    camera = calibration.camera
    scanner = calibration.scanner
    fields = {"K": camera.intrinsics.ravel().tolist(), "distortion": list(camera.distortion)}
    if scanner is not None:
        fields["R"] = scanner.rotation.ravel().tolist()
        fields["t"] = scanner.translation.tolist()
    if camera.size is not None:
        fields["size"] = [camera.size[1], camera.size[0]]  # width, height
    lines = [f"{name}: {json.dumps(numbers)}\n" for name, numbers in fields.items()]
    return "".join([*lines, f"lens: {camera.lens}\n"])


def write_poses(
    path: Path, bag: Bag, wanted: Sequence[str], camera: str, times: Sequence[float], say: Say
) -> str | None:
    """Writes poses.txt if the bag has a pose for every frame; returns their topic, else None.

    Args:
        path: File to write.
        bag: The open bag.
        wanted: Topics that the user names, of any kind.
        camera: frame_id of the camera.
        times: Seconds of each frame.
        say: Receives what was found, or why there is no file.
    """
    # The one topic, and its trajectory of the camera.
    topics = messages.poses_topics(bag, wanted)
    if len(topics) != 1:
        if topics:
            say(f"poses: none, as several topics give some; --topic {' | '.join(topics)}")
        return None
    (topic,) = topics
    trajectory = messages.camera_trajectory(bag, topic, camera)
    if trajectory is None:
        say(f"warning: no transforms tie the camera's frame {camera} to the poses of {topic}")
        return None
    # A row for each frame: time, place and turn (x y z w), as TUM has them.
    rows = list[str]()
    for time_s in times:
        pose = trajectory.at(time_s, _LONGEST_GAP_S)
        if pose is not None:
            turn = Rotation.from_matrix(pose[:, :3]).as_quat()
            numbers = [f"{time_s:.6f}", *pose[:, 3], *turn]
            rows.append(" ".join(map(str, numbers)) + "\n")
    if len(rows) < len(times):
        say(
            f"warning: {len(times) - len(rows):,} of {len(times):,} images have no pose in {topic}"
            f" within {_LONGEST_GAP_S:g} s, so poses.txt is not written"
        )
        return None
    with atomic_path(path) as temporary:
        temporary.write_text("".join(rows))
    say(f"poses: of {topic}")
    return topic
