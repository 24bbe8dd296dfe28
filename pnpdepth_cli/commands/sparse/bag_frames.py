"""`pnpdepth frames`: a bag as a folder of images, scans and their calibration."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.commands.requests import FramesRequest
from pnpdepth_cli.commands.sparse.bag_sensors import (
    Say,
    Sensors,
    clock_offset,
    measurement,
    sensors_of,
    stream,
)
from pnpdepth_cli.dataset.scan_points import choose_camera
from pnpdepth_cli.errors import InputError, NoPointsError, OutputError
from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.bags import (
    CLOUDS,
    IMAGES,
    ODOMETRY,
    POSES,
    Bag,
    check_topics,
    open_bag,
)
from pnpdepth_cli.io.bags.messages import (
    Stamped,
    camera_info_topic,
    camera_of_bag,
    camera_trajectory,
    frame_of,
    image_file,
    nearest_pairs,
    poses_topics,
    static_pose,
)
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.poses import POSES_FILE
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan, write_cloud
from pnpdepth_cli.io.text_files import plain, read_json, write_json
from pnpdepth_cli.sensors.pixels import describe_dropped

RECORD = "frames.json"
_NOT_IN_RECORD = ("output", "overwrite")
_FOLDERS = ("rgb", "sparse")
_COMPARED_FRAMES = 5
_LONGEST_GAP_S = 0.5
"""Longest time between two poses that one is interpolated from."""


def _identity(request: FramesRequest) -> dict[str, object]:
    """The beginning of the record, which is the same for the same frames."""
    bag = request.bag
    paths = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    stated = {name: value for name, value in vars(request).items() if name not in _NOT_IN_RECORD}
    files = {p.name: [p.stat().st_size, p.stat().st_mtime_ns] for p in paths}
    return {"command": "frames", **stated, "bag": str(bag), "bag_files": files}


def write_frames(request: FramesRequest, say: Say) -> int:
    """Writes the frames of a bag in the layout `pairs`, one at a time, and returns their number.

    `say` receives what was guessed, and warnings.

    Raises:
        InputError: The bag cannot be read, or has no frame.
        UsageError: Topics are ambiguous.
        OutputError: The folder holds files that may not be replaced.
    """
    _check_output(request)
    with open_bag(request.bag) as bag:
        # The topics, and what their clocks differ by.
        check_topics(bag, request.topics, (*IMAGES, *CLOUDS, *ODOMETRY, *POSES))
        sensors = sensors_of(bag, request.topics, say)
        say(f"topics: images of {sensors.images}, points of {sensors.points}")
        _clear(request)
        offset = request.clock_offset
        if offset is None:
            offset = clock_offset(bag, sensors, say)
        # The frames.
        times, lost, dropped = _write_pairs(request, bag, sensors, offset)
        if dropped:
            say(f"points: dropped {describe_dropped(dropped)}")
        if lost:
            within = f"{request.tolerance:g} s"
            say(f"warning: {lost:,} images have no scan with points within {within}")
        if not times:
            raise InputError(
                f"{bag.path}: no image of {sensors.images} has a scan of {sensors.points} within"
                f" {request.tolerance:g} s; give --clock-offset, or a larger --tolerance"
            )
        # Calibration and poses.
        camera = _write_calibration(request, bag, sensors, say)
        poses = _write_poses(request, bag, camera, times, say)
    # The record, which is complete now.
    record = _identity(request) | {
        "image_topic": sensors.images,
        "points_topic": sensors.points,
        "seconds_added_to_points": offset,
        "complete": True,
        "frames": len(times),
        "poses": poses,
        "images_without_scan": lost,
    }
    write_json(request.output / RECORD, record)
    return len(times)


def has_frames(request: FramesRequest) -> bool:
    """Returns whether the folder holds the frames of this bag with these options."""
    path = request.output / RECORD
    if not path.is_file():
        return False
    identity, record = plain(_identity(request) | {"complete": True}), read_json(path)
    return all(record.get(name) == value for name, value in identity.items())


def _check_output(request: FramesRequest) -> None:
    """Raises OutputError unless the folder is new, or of an earlier run and to be replaced."""
    folder = request.output
    ours = (folder / RECORD).is_file()
    if ours and not request.overwrite:
        raise OutputError(f"{folder} holds the frames of a bag; --overwrite replaces them")
    if folder.is_file() or (not ours and folder.is_dir() and any(folder.iterdir())):
        raise OutputError(f"{folder} exists, and holds no frames of a bag; name another with -o")


def _clear(request: FramesRequest) -> None:
    """Removes the frames that were written before, and records that these are incomplete."""
    for name in _FOLDERS:
        make_folder(request.output / name, below=request.output)
        for path in (request.output / name).iterdir():
            path.unlink()
    for name in ("calib.txt", POSES_FILE):
        (request.output / name).unlink(missing_ok=True)
    write_json(request.output / RECORD, _identity(request) | {"complete": False})


def _write_pairs(
    request: FramesRequest, bag: Bag, sensors: Sensors, offset: float
) -> tuple[list[float], int, Counter[str]]:
    """Writes each image that is asked for with the scan nearest in time.

    Returns the time of each image in seconds, the number of images without a scan, and counts of
    dropped points.
    """
    lost, times, dropped = 0, list[float](), Counter[str]()
    first, last = request.between or (0, math.inf)
    numbers = itertools.count()
    for image, scan in nearest_pairs(stream(bag, sensors, offset), request.tolerance):
        if scan is None:
            lost += 1
            continue
        if (number := next(numbers)) > last:
            break
        if number < first or (number - first) % request.every:
            continue
        try:
            values, counts = measurement(sensors, scan.message)
        except NoPointsError:
            lost += 1
            continue
        dropped.update(counts)
        _write_frame(request.output, sensors, image, values)
        times.append(image.time_s)
    return times, lost, dropped


def _write_frame(
    folder: Path, sensors: Sensors, image: Stamped, values: NDArray[np.float32]
) -> None:
    """Writes rgb/NAME and sparse/NAME; the name is the image's time."""
    name = f"{image.time_s:.6f}".replace(".", "_")
    suffix, data = image_file(image.message, sensors.images)
    with atomic_path(folder / "rgb" / f"{name}{suffix}") as temporary:
        temporary.write_bytes(data)
    sparse = folder / "sparse" / name
    if sensors.is_map:
        write_depth(sparse.with_suffix(".exr"), values)
    else:
        write_cloud(sparse.with_suffix(".ply"), [(values, None, None)])


def _write_calibration(request: FramesRequest, bag: Bag, sensors: Sensors, say: Say) -> str:
    """Writes calib.txt as far as there is a calibration; returns the frame_id of the camera."""
    # The camera, from camera_info.
    topic = camera_info_topic(bag, sensors.images)
    of_bag = None if topic is None else camera_of_bag(bag, topic)
    topics = sensors.images, sensors.points
    camera, points = (frame_of(next(bag.messages([each]))[2]) for each in topics)
    if of_bag is None:
        say(f"warning: {bag.path} has no camera_info of {sensors.images}; refine with --calib")
        return camera
    calibration, source, camera = of_bag[0], str(topic), of_bag[1] or camera
    # The pose of the scanner, from static transforms.
    scanner = None if calibration.scanner else static_pose(bag, camera, points)
    if scanner is not None:
        source += f", and /tf_static from {camera} to {points}"
        calibration = replace(calibration, scanner=scanner)
    if calibration.scanner is None and not sensors.is_map:
        say(
            f"warning: {bag.path} has no static transform from {camera} to {points}; refine"
            " with --extrinsics FILE"
        )
    else:
        say(f"calibration: {source}")
    # Whether the images are rectified.
    if calibration.rectified:
        pairs = () if sensors.is_map else _some_frames(request.output)
        calibration, note = choose_camera(calibration, pairs, sensors.images)
        say(note)
    with atomic_path(request.output / "calib.txt") as temporary:
        temporary.write_text(_calibration_text(calibration))
    return camera


def _some_frames(
    folder: Path,
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Yields the image and the points of a few frames."""
    scans = sorted((folder / "sparse").iterdir())
    positions = np.linspace(0, len(scans) - 1, min(_COMPARED_FRAMES, len(scans)))
    for scan in (scans[round(position)] for position in positions):
        (image,) = (folder / "rgb").glob(f"{scan.stem}.*")
        yield read_rgb(image).values, read_scan(scan).points


def _calibration_text(calibration: Calibration) -> str:
    camera, scanner = calibration.camera, calibration.scanner
    fields = {"K": camera.intrinsics.ravel().tolist(), "distortion": list(camera.distortion)}
    if scanner is not None:
        fields |= {"R": scanner.rotation.ravel().tolist(), "t": scanner.translation.tolist()}
    if camera.size is not None:
        fields["size"] = [camera.size[1], camera.size[0]]
    return "".join(f"{n}: {json.dumps(v)}\n" for n, v in fields.items()) + f"lens: {camera.lens}\n"


def _write_poses(
    request: FramesRequest, bag: Bag, camera: str, times: Sequence[float], say: Say
) -> str | None:
    """Writes poses.txt if the bag has a pose for every frame; returns the topic, else None."""
    topics = poses_topics(bag, request.topics)
    if len(topics) != 1:
        if topics:
            say(f"poses: none, as several topics give some; --topic {' | '.join(topics)}")
        return None
    (topic,) = topics
    trajectory = camera_trajectory(bag, topic, camera)
    if trajectory is None:
        say(f"warning: no transforms tie the camera's frame {camera} to the poses of {topic}")
        return None
    rows = list[str]()
    for time_s in times:
        if (pose := trajectory.at(time_s, _LONGEST_GAP_S)) is not None:
            numbers = (*pose[:, 3], *Rotation.from_matrix(pose[:, :3]).as_quat())
            rows.append(" ".join(map(str, [f"{time_s:.6f}", *numbers])) + "\n")
    if len(rows) < len(times):
        say(
            f"warning: {len(times) - len(rows):,} of {len(times):,} images have no pose in {topic}"
            f" within {_LONGEST_GAP_S:g} s, so poses.txt is not written"
        )
        return None
    with atomic_path(request.output / POSES_FILE) as temporary:
        temporary.write_text("".join(rows))
    say(f"poses: of {topic}")
    return topic
