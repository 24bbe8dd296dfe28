"""`pnpdepth frames`: a bag as a folder of images, scans and their calibration.

The sensors of a bag are its topics of images and of points; they may have two clocks.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.frames_request import FramesRequest
from pnpdepth_cli.dataset.rectified_camera import choose_camera
from pnpdepth_cli.dataset.scan_returns import scan_returns
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
_NOT_IN_RECORD = ("output", "overwrite")
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
"""In topics of registered depth."""
_SAME_K = 0.05
"""Relative difference of intrinsics of one camera that was calibrated twice."""

Say = Callable[[str], None]


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
        sensors, of_scale = _with_scale(bag, sensors, request.depth_scale)
        if of_scale:
            say(of_scale)
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
        camera, is_calibrated = _write_calibration(request, bag, sensors, say)
        poses = _write_poses(request, bag, camera, times, say)
    # The record, which is complete now.
    record = _identity(request) | {
        "image_topic": sensors.images,
        "points_topic": sensors.points,
        "seconds_added_to_points": offset,
        "complete": True,
        "frames": len(times),
        "calibrated": is_calibrated,
        "poses": poses,
        "images_without_scan": lost,
    }
    write_json(request.output / RECORD, record)
    return len(times)


def unpack(request: BatchRequest, say: Say) -> BatchRequest:
    """Returns the request with the frames of its bag as source.

    The frames are written to OUTPUT_frames, and stay there for the next run.
    """
    folder = request.output.with_name(f"{request.output.name}_frames")
    whole = request.limit is None or request.names is not None
    between = None if whole else (0, request.every * (request.limit or 1) - 1)
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
    ours = (folder / RECORD).is_file()
    if ours and not request.overwrite:
        raise OutputError(f"{folder} holds the frames of a bag; --overwrite replaces them")
    if folder.is_file() or (not ours and folder.is_dir() and any(folder.iterdir())):
        raise OutputError(f"{folder} exists, and holds no frames of a bag; name another with -o")
    for name in _FOLDERS:
        inside = (folder / name).iterdir() if (folder / name).is_dir() else ()
        if (other := next((path for path in inside if path.is_dir()), None)) is not None:
            raise OutputError(f"{other} is a folder of yours; move it, or name another with -o")


def _clear(request: FramesRequest) -> None:
    """Removes the frames that were written before, and records that these are incomplete."""
    folder = request.output
    for name in _FOLDERS:
        make_folder(folder / name, below=folder)
        for path in _written(folder, name):
            path.unlink()
    before = read_json(folder / RECORD) if (folder / RECORD).is_file() else {}
    for name, written in ((_CALIBRATION, "calibrated"), (POSES_FILE, "poses")):
        if before.get(written):
            (folder / name).unlink(missing_ok=True)
    write_json(folder / RECORD, _identity(request) | {"complete": False})


def _written(folder: Path, name: str) -> list[Path]:
    """The files of frames in rgb/ or sparse/, in the order of their times' names."""
    return sorted(p for p in (folder / name).iterdir() if _FOLDERS[name].fullmatch(p.name))


class _Pairs(NamedTuple):
    """What was written of a bag."""

    times: list[float]
    """Seconds, of each image that was written with its scan."""
    lost: int
    """Number of images without a scan."""
    dropped: Counter[str]
    """Numbers of points that were dropped, by the reason."""


def _write_pairs(request: FramesRequest, bag: Bag, sensors: Sensors, offset: float) -> _Pairs:
    """Writes images with their scans.

    The files are rgb/NAME and sparse/NAME; the name is the image's time.
    """
    lost = 0
    times = list[float]()
    dropped = Counter[str]()
    first, last = request.between or (0, math.inf)
    numbers = itertools.count()
    pairs = messages.nearest_pairs(stream(bag, sensors, offset), request.tolerance)
    for time_s, image, scan in pairs:
        # Pairs are counted, of which the user may want some.
        if scan is None:
            lost += 1
            continue
        if (number := next(numbers)) > last:
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


def _write_calibration(
    request: FramesRequest, bag: Bag, sensors: Sensors, say: Say
) -> tuple[str, bool]:
    """Writes calib.txt if there is a calibration; returns the camera's frame_id, and whether."""
    # The camera, from camera_info.
    camera, points = (
        messages.frame_of(next(bag.messages([topic]))[2])
        for topic in (sensors.images, sensors.points)
    )
    if (of_bag := messages.camera_of_bag(bag, sensors.images)) is None:
        say(f"warning: {bag.path} has no camera_info of {sensors.images}; refine with --calib")
        return camera, False
    calibration, named = of_bag
    camera = named or camera
    source = calibration.camera.source
    # The pose of the scanner, from static transforms.
    if (scanner := messages.static_pose(bag, camera, points)) is not None:
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
        pairs = () if sensors.is_map else _some_frames(request.output)
        calibration, note = choose_camera(calibration, pairs, sensors.images)
        say(note)
    with atomic_path(request.output / _CALIBRATION) as temporary:
        temporary.write_text(_calibration_text(calibration))
    return camera, True


def _some_frames(folder: Path) -> Iterator[tuple[NDArray[np.float32], NDArray[np.floating]]]:
    """Yields the image and the points of a few frames."""
    scans = _written(folder, "sparse")
    images = _written(folder, "rgb")
    step = math.ceil(len(scans) / _COMPARED_FRAMES)
    for image, scan in zip(images[::step], scans[::step], strict=True):
        yield read_rgb(image).values, read_scan(scan)[0]


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
    # A row for each frame: time, place and turn, as TUM has them.
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


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Which topics hold images and depth."""

    images: str
    points: str
    is_map: bool = False
    """Whether the points are depth images of the images' own camera."""
    depth_camera: Camera | None = None
    """Camera of depth images of another camera. None: of the images' own, or clouds."""
    scale: float | None = None
    """Numbers per metre of the points. None: as ROS has them (REP 118)."""


def sensors_of(bag: Bag, wanted: Sequence[str], say: Say) -> Sensors:
    """Returns the topics that are named, or the only ones; clouds rather than depth images.

    Of several depth images, those with the images' frame_id are taken.
    """
    # Topics of images hold colours or depth, which the first message tells.
    topics = bag.topics(IMAGES)
    first = {
        name: found[2] for name in topics for found in itertools.islice(bag.messages([name]), 1)
    }
    depths = {n: topics[n] for n, message in first.items() if messages.is_depth(message, n)}
    if not set(wanted) & set(depths) and len(first) > 1:
        # grey images of 16 bits beside others: named by the user, or nothing else gives points
        grey = {n: topics[n] for n in first if n not in depths and messages.is_wide_grey(first[n])}
        named = {n: grey[n] for n in grey if n in wanted}
        nothing = not depths and not bag.topics(CLOUDS) and len(grey) < len(first)
        for name in named or (grey if nothing else {}):
            depths[name] = topics[name]
            say(f"topics: {name}, grey images of 16 bits, is taken for depth")
    colours = {name: topics[name] for name in first if name not in depths}
    # Points are clouds, unless depth images are named or alone.
    images = choose_topic(bag, wanted, colours, "images")
    clouds = bag.topics(CLOUDS)
    if not depths or (clouds and not set(wanted) & set(depths)):
        points = choose_topic(bag, wanted, clouds, f"points ({CLOUDS[0]} or depth images)")
        return Sensors(images=images, points=points)
    # Depth images with the colours' frame_id are preferred.
    frame = messages.frame_of(first[images])
    registered = {n: depths[n] for n in depths if messages.frame_of(first[n]) == frame}
    usable = depths if set(wanted) & set(depths) else registered or depths
    points = choose_topic(bag, wanted, usable, "depth images")
    same = Sensors(images=images, points=points, is_map=True)
    # They may be of a camera of their own.
    found = [messages.camera_of_bag(bag, topic) for topic in (images, points)]
    of_images, of_depth = (None if of_bag is None else of_bag[0].camera for of_bag in found)
    if of_depth is None:
        _say_unregistered(points, points in registered, say)
        return same
    if of_images is not None:
        close = np.allclose(of_images.intrinsics, of_depth.intrinsics, rtol=_SAME_K)
        alike = points in registered and of_images.size == of_depth.size and close
        if of_images.source == of_depth.source:  # the only camera_info of the bag
            _say_unregistered(points, points in registered, say)
            return same
        if alike:
            return same
    return Sensors(images=images, points=points, depth_camera=of_depth)


def _say_unregistered(points: str, is_registered: bool, say: Say) -> None:
    """Warns of depth images in another frame than the images', whose camera nothing tells."""
    if is_registered or _REGISTERED.search(points):
        return
    say(
        f"warning: {points} has no camera_info and is in another frame than the images; its pixels"
        " are taken for the images', which is wrong unless it is registered to them"
    )


def _with_scale(bag: Bag, sensors: Sensors, stated: float | None) -> tuple[Sensors, str | None]:
    """The topics with the scale that the user or the bag states, and a line that says so."""
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
    """Returns depth (H, W) of the images' camera, or points (N, 3); and counts of what is none.

    Raises:
        NoPointsError: Nothing was measured.
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
    # the unit of clouds is left to what reads the frames, unless the user states it
    of_cloud = None if sensors.is_map or sensors.depth_camera is not None else sensors.scale
    points, counts, _ = scan_returns(topic, cloud, scale=of_cloud or 1.0, of_integers="")
    return points, counts


def stream(bag: Bag, sensors: Sensors, offset: float) -> Iterator[tuple[bool, float, Message]]:
    """Yields whether it is an image, its time, and the message; adds `offset` to that of points."""
    for topic, logged_ns, message in bag.messages([sensors.images, sensors.points]):
        is_image = topic == sensors.images
        time_s = messages.seconds_of(message, logged_ns) + (0.0 if is_image else offset)
        yield is_image, time_s, message


def clock_offset(bag: Bag, sensors: Sensors, say: Say) -> float:
    """Returns seconds to add to the times of points: the difference of two clocks if it is large.

    One clock times the log of both topics. So their delays from stamp to log differ by the offset,
    and by how long each message took, which is less than a second.
    """
    delays = list[list[float]]()
    for topic in (sensors.images, sensors.points):
        first = itertools.islice(bag.messages([topic]), _DELAYS)
        delays.append([1e-9 * ns - messages.seconds_of(message, ns) for _, ns, message in first])
    if not all(delays):
        return 0.0
    offset = round(float(np.median(delays[1]) - np.median(delays[0])), 6)
    if abs(offset) <= _SLOWEST_S:
        return 0.0
    say(
        f"warning: by the times of the log, {sensors.images} and {sensors.points} have two clocks;"
        f" {offset:+.3f} s are added to the times of points (--clock-offset gives another number)"
    )
    return offset
