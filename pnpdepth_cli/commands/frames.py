"""`pnpdepth frames`: a bag as a folder of images, scans and their calibration.

The sensors of a bag are its topics of images and of points; they may have two clocks.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.frames_request import FramesRequest
from pnpdepth_cli.dataset.plausible import scan_returns
from pnpdepth_cli.dataset.scan_points import choose_camera
from pnpdepth_cli.errors import InputError, NoPointsError, OutputError
from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.bags import (
    CLOUDS,
    IMAGES,
    ODOMETRY,
    POSES,
    Bag,
    Message,
    check_topics,
    choose_topic,
    messages,
    open_bag,
)
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import plain, read_json, write_json
from pnpdepth_cli.io.poses import POSES_FILE
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan, write_cloud
from pnpdepth_cli.sensors.lens import unproject
from pnpdepth_cli.sensors.projection import describe_dropped

RECORD = "frames.json"
"""The file of the output folder that says what the frames were made of."""
_NOT_IN_RECORD = ("output", "overwrite")
"""Fields of the request that do not change the frames."""
_FOLDERS = {
    "rgb": re.compile(r"-?\d+_\d{6}\.(png|jpg)"),
    "sparse": re.compile(r"-?\d+_\d{6}\.(exr|ply)"),
}
"""Names of the files that are written to each folder; any other file there is the user's."""
_CALIBRATION = "calib.txt"
_COMPARED_FRAMES = 5
"""Frames whose edges tell whether the images are rectified."""
_LONGEST_GAP_S = 0.5
"""Longest time between two poses that one is interpolated from."""
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


def _identity(request: FramesRequest) -> dict[str, object]:
    """The beginning of the record, which is the same for the same frames.

    It has what the user asks for, and size and time of the bag's files.
    """
    bag = request.bag
    paths = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    asked = {name: value for name, value in vars(request).items() if name not in _NOT_IN_RECORD}
    files = {path.name: [path.stat().st_size, path.stat().st_mtime_ns] for path in paths}
    return {"command": "frames", **asked, "bag": str(bag), "bag_files": files}


def write_frames(request: FramesRequest, say: Say) -> int:
    """Writes the frames of a bag in the layout `pairs`, one at a time, and returns their number.

    Args:
        request: Which bag is written where, and how.
        say: Receives what was guessed, and warnings.

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
        sensors, line_on_scale = _with_scale(bag, sensors, request.depth_scale)
        if line_on_scale is not None:
            say(line_on_scale)
        _clear(request)
        offset_s = request.clock_offset
        if offset_s is None:
            offset_s = clock_offset(bag, sensors, say)
        # The frames, their calibration and their poses.
        pairs = _write_pairs(request, bag, sensors, offset_s)
        _report_pairs(pairs, request, sensors, say)
        camera, is_calibrated = _write_calibration(request, bag, sensors, say)
        poses_topic = _write_poses(request, bag, camera, pairs.times, say)
    # The record, which makes the folder complete.
    record = _identity(request) | {
        "image_topic": sensors.images,
        "points_topic": sensors.points,
        "seconds_added_to_points": offset_s,
        "complete": True,
        "frames": len(pairs.times),
        "calibrated": is_calibrated,
        "poses": poses_topic,
        "images_without_scan": pairs.lost,
    }
    write_json(request.output / RECORD, record)
    return len(pairs.times)


def unpack(request: BatchRequest, say: Say) -> BatchRequest:
    """Returns the request with the frames of its bag as source.

    The frames are written to OUTPUT_frames, and stay there for the next run.

    Args:
        request: A batch whose source is a bag.
        say: Receives what was guessed, and warnings.

    Raises:
        As `write_frames`.
    """
    folder = request.output.with_name(f"{request.output.name}_frames")
    # A batch of the first frames needs no others, unless it chooses by names, which come later.
    between = None
    if request.limit is not None and request.names is None:
        between = (0, request.every * request.limit - 1)
    # The points are metres in these files, so a scale that the user states is of the bag.
    frames = FramesRequest(
        bag=request.source,
        output=folder,
        between=between,
        depth_scale=request.reading.depth_scale,
        overwrite=True,
    )
    if not has_frames(frames):
        say(f"bag: wrote {write_frames(frames, say):,} frames to {folder}")
    refine = request.refine.with_fields(depth_scale=None)
    return replace(request, source=folder, refine=refine)


def has_frames(request: FramesRequest) -> bool:
    """Returns whether the folder holds the frames of this bag with these options."""
    path = request.output / RECORD
    if not path.is_file():
        return False
    identity = plain(_identity(request) | {"complete": True})
    record = read_json(path)
    return all(record.get(name) == value for name, value in identity.items())


def _check_output(request: FramesRequest) -> None:
    """Raises OutputError unless the folder is new, or of an earlier run and to be replaced."""
    folder = request.output
    is_ours = (folder / RECORD).is_file()
    if is_ours and not request.overwrite:
        raise OutputError(f"{folder} holds the frames of a bag; --overwrite replaces them")
    is_used = folder.is_dir() and any(folder.iterdir())
    if folder.is_file() or (is_used and not is_ours):
        raise OutputError(f"{folder} exists, and holds no frames of a bag; name another with -o")
    for name in _FOLDERS:
        paths = [*(folder / name).iterdir()] if (folder / name).is_dir() else []
        subfolders = [path for path in paths if path.is_dir()]
        if subfolders:
            raise OutputError(
                f"{subfolders[0]} is a folder of yours; move it, or name another with -o"
            )


def _clear(request: FramesRequest) -> None:
    """Removes what an earlier run wrote, and records that the folder is incomplete.

    Files of the user stay, a calibration and poses among them.
    """
    folder = request.output
    for name in _FOLDERS:
        make_folder(folder / name, below=folder)
        for path in _written(folder, name):
            path.unlink()
    record = read_json(folder / RECORD) if (folder / RECORD).is_file() else {}
    for name, entry in ((_CALIBRATION, "calibrated"), (POSES_FILE, "poses")):
        if record.get(entry):  # the earlier run wrote this file
            (folder / name).unlink(missing_ok=True)
    write_json(folder / RECORD, _identity(request) | {"complete": False})


def _written(folder: Path, name: str) -> list[Path]:
    """The files of frames that were written to a subfolder, in the order of their times.

    Args:
        folder: The output folder.
        name: Name of the subfolder: "rgb" or "sparse".
    """
    pattern = _FOLDERS[name]
    return sorted(path for path in (folder / name).iterdir() if pattern.fullmatch(path.name))


class _Pairs(NamedTuple):
    """What was written of a bag."""

    times: list[float]
    """Seconds, of each image that was written with its scan."""
    lost: int
    """Number of images without a scan that has points."""
    dropped: Counter[str]
    """Numbers of points that were dropped, by the reason."""


def _write_pairs(request: FramesRequest, bag: Bag, sensors: Sensors, offset_s: float) -> _Pairs:
    """Writes images with their scans, those that the request wants.

    The files are rgb/NAME and sparse/NAME; the name is the image's time.

    Args:
        request: Which pairs are written, and where.
        bag: The open bag.
        sensors: Topics of the images and the points.
        offset_s: Seconds that are added to the times of points.

    Raises:
        InputError: A message is damaged.
    """
    lost = 0
    times = list[float]()
    dropped = Counter[str]()
    first, last = request.between or (0, math.inf)
    number = -1  # of the pair, from 0
    messages_in_order = stream(bag, sensors, offset_s)
    for time_s, image, scan in messages.nearest_pairs(messages_in_order, request.tolerance):
        # Pairs are counted, of which the user may want some.
        if scan is None:
            lost += 1
            continue
        number += 1
        if number > last:
            break
        if number < first or (number - first) % request.every:
            continue
        try:
            values, counts = measurement(sensors, scan)
        except NoPointsError:
            lost += 1
            continue
        dropped.update(counts)
        times.append(time_s)
        # The image as it is in the bag, and its depth map or cloud.
        name = f"{time_s:.6f}".replace(".", "_")
        suffix, data = messages.image_file(image, sensors.images)
        with atomic_path(request.output / "rgb" / f"{name}{suffix}") as temporary:
            temporary.write_bytes(data)
        sparse = request.output / "sparse" / name
        if sensors.is_map:
            write_depth(sparse.with_suffix(".exr"), values)
        else:
            write_cloud(sparse.with_suffix(".ply"), [(values, None, None)])
    return _Pairs(times, lost, dropped)


def _report_pairs(pairs: _Pairs, request: FramesRequest, sensors: Sensors, say: Say) -> None:
    """Says what is not among the pairs that were written. Raises InputError if there is none."""
    if pairs.dropped:
        say(f"points: dropped {describe_dropped(pairs.dropped)}")
    if pairs.lost:
        within = f"{request.tolerance:g} s"
        say(f"warning: {pairs.lost:,} images have no scan with points within {within}")
    if not pairs.times:
        raise InputError(
            f"{request.bag}: no image of {sensors.images} has a scan of {sensors.points} within"
            f" {request.tolerance:g} s; give --clock-offset, or a larger --tolerance"
        )


def _write_calibration(
    request: FramesRequest, bag: Bag, sensors: Sensors, say: Say
) -> tuple[str, bool]:
    """Writes calib.txt if the bag has a calibration.

    Args:
        request: Where it is written.
        bag: The open bag.
        sensors: Topics of the images and the points.
        say: Receives what was found, and warnings.

    Returns:
        The frame_id of the camera, and whether the file was written.
    """
    # The camera, from camera_info.
    camera, points = (
        messages.frame_of(next(bag.messages([topic]))[2])
        for topic in (sensors.images, sensors.points)
    )
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
    # Whether the images are rectified.
    if calibration.rectified:
        frames = () if sensors.is_map else _some_frames(request.output)
        calibration, note = choose_camera(calibration, frames, sensors.images)
        say(note)
    with atomic_path(request.output / _CALIBRATION) as temporary:
        temporary.write_text(_calibration_text(calibration))
    return camera, True


def _some_frames(folder: Path) -> Iterator[tuple[NDArray[np.float32], NDArray[np.floating]]]:
    """Yields the image (H, W, 3) in 0…1 and the points (N, 3) of a few frames, evenly spaced."""
    scans = _written(folder, "sparse")
    images = _written(folder, "rgb")
    step = math.ceil(len(scans) / _COMPARED_FRAMES)
    for image, scan in zip(images[::step], scans[::step], strict=True):
        points, _ = read_scan(scan)
        yield read_rgb(image).values, points


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


def _write_poses(
    request: FramesRequest, bag: Bag, camera: str, times: Sequence[float], say: Say
) -> str | None:
    """Writes poses.txt if the bag has a pose for every frame; returns their topic, else None.

    Args:
        request: Where it is written, and which topics the user names.
        bag: The open bag.
        camera: frame_id of the camera.
        times: Seconds of each frame.
        say: Receives what was found, or why there is no file.
    """
    # The one topic, and its trajectory of the camera.
    topics = messages.poses_topics(bag, request.topics)
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
    with atomic_path(request.output / POSES_FILE) as temporary:
        temporary.write_text("".join(rows))
    say(f"poses: of {topic}")
    return topic


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


def _say_unregistered(points: str, is_registered: bool, say: Say) -> None:
    """Warns of depth images in another frame than the images', whose camera nothing tells."""
    if is_registered or _REGISTERED.search(points):
        return
    say(
        f"warning: {points} has no camera_info and is in another frame than the images; its pixels"
        " are taken for the images', which is wrong unless it is registered to them"
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
    bag: Bag, images: str, points: str, has_same_frame: bool, say: Say
) -> Camera | None:
    """The camera of depth images if it is another than that of the images, else None.

    Without a camera_info of its own, depth is taken for that of the images' pixels.

    Args:
        bag: The open bag.
        images: Topic of the images.
        points: Topic of the depth images.
        has_same_frame: Whether both have one frame_id.
        say: Receives a warning if nothing tells that depth and images belong together.
    """
    calibrations = [messages.camera_of_bag(bag, topic) for topic in (images, points)]
    of_images, of_depth = (
        None if calibration is None else calibration[0].camera for calibration in calibrations
    )
    if of_depth is None:
        _warn_of_unregistered(points, has_same_frame, say)
        return None
    if of_images is None:
        return of_depth
    if of_images.source == of_depth.source:  # the only camera_info of the bag
        _warn_of_unregistered(points, has_same_frame, say)
        return None
    has_same_k = np.allclose(of_images.intrinsics, of_depth.intrinsics, rtol=_SAME_K)
    if has_same_frame and has_same_k and of_images.size == of_depth.size:
        return None
    return of_depth


def _warn_of_unregistered(points: str, has_same_frame: bool, say: Say) -> None:
    """Warns of depth images whose camera nothing tells, unless their frame or topic does.

    Args:
        points: Topic of the depth images.
        has_same_frame: Whether they have the images' frame_id.
        say: Receives the warning.
    """
    if has_same_frame or _REGISTERED.search(points):
        return
    say(
        f"warning: {points} has no camera_info and is in another frame than the images; its pixels"
        " are taken for the images', which is wrong unless it is registered to them"
    )


def _with_scale(bag: Bag, sensors: Sensors, stated: float | None) -> tuple[Sensors, str | None]:
    """The topics with the scale that the user or the bag states, and a line that says so.

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
        Depth (H, W) in metres of the images' camera, 0 where unknown, if `is_map`; else points
        (N, 3) in metres in the coordinates of the scanner or the depth camera. The numbers of points
        that were dropped, by the reason; none of depth.

    Raises:
        NoPointsError: Nothing was measured.
        InputError: The message is damaged.
    """
    topic = sensors.points
    if not sensors.is_map and sensors.depth_camera is None:
        cloud = messages.cloud_points(message, topic)
    else:
        depth = messages.depth_image(message, topic, sensors.scale)
        if not depth.any():
            raise NoPointsError(f"{topic}: a depth image without depth")
        if sensors.depth_camera is None:
            return depth, {}
        rows, columns = np.nonzero(depth)
        xy = np.column_stack([columns, rows]).astype(np.float64)
        cloud = unproject(sensors.depth_camera, xy, depth[rows, columns]).astype(np.float32)
    # The unit of clouds is left to what reads the frames, unless the user states it. Depth images
    # are in metres already.
    is_cloud = not sensors.is_map and sensors.depth_camera is None
    scale = sensors.scale if is_cloud else None
    points, counts, _ = scan_returns(topic, cloud, scale=scale or 1.0, of_integers="")
    return points, counts


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
