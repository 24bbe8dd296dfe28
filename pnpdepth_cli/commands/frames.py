"""`pnpdepth frames`: a bag as a folder of images, scans, their calibration and their poses."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from pnpdepth_cli.commands.bag_frames.bag_sensors import (
    Say,
    Sensors,
    clock_offset,
    measurement,
    sensors_of,
    stream,
    with_scale,
)
from pnpdepth_cli.commands.bag_frames.camera_files import (
    ImageAndScan,
    write_calibration,
    write_poses,
)
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.frames_request import FramesRequest
from pnpdepth_cli.errors import InputError, NoPointsError, OutputError
from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.bags import (
    CLOUDS,
    IMAGES,
    ODOMETRY,
    POSES,
    Bag,
    check_topics,
    messages,
    open_bag,
)
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import plain, read_json, write_json
from pnpdepth_cli.io.poses import POSES_FILE
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan, write_cloud
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


def _identity(request: FramesRequest) -> dict[str, object]:
    """What decides the frames: the user's request, and size and time of change of the bag's files.

    The record begins with it. Where it is the same as in a record, the frames are, too.
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
        sensors, line_on_scale = with_scale(bag, sensors, request.depth_scale)
        if line_on_scale is not None:
            say(line_on_scale)
        _clear(request)
        offset_s = request.clock_offset
        if offset_s is None:
            offset_s = clock_offset(bag, sensors, say)
        # The frames, their calibration and their poses.
        pairs = _write_pairs(request, bag, sensors, offset_s)
        _report_pairs(pairs, request, sensors, say)
        folder = request.output
        some_frames = _some_frames(folder)
        camera, is_calibrated = write_calibration(
            folder / _CALIBRATION, bag, sensors, some_frames, say
        )
        poses_topic = write_poses(
            folder / POSES_FILE, bag, request.topics, camera, pairs.times, say
        )
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
        InputError: The bag cannot be read, or has no frame.
        UsageError: Topics are ambiguous.
        OutputError: The folder holds files that may not be replaced.
    """
    folder = request.output.with_name(f"{request.output.name}_frames")
    # A batch of the first frames needs no others: `limit` frames, each the `every`-th. One that
    # chooses by names needs all, as the names are those of the written files.
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
            measured, counts = measurement(sensors, scan)
        except NoPointsError:
            lost += 1
            continue
        dropped.update(counts)
        times.append(time_s)
        # The image as it is in the bag, and its depth map or cloud.
        name = f"{time_s:.6f}".replace(".", "_")
        suffix, image_bytes = messages.image_file(image, sensors.images)
        with atomic_path(request.output / "rgb" / f"{name}{suffix}") as temporary:
            temporary.write_bytes(image_bytes)
        sparse = request.output / "sparse" / name
        if sensors.is_map:
            write_depth(sparse.with_suffix(".exr"), measured)
        else:
            write_cloud(sparse.with_suffix(".ply"), [(measured, None, None)])
    return _Pairs(times, lost, dropped)


def _report_pairs(pairs: _Pairs, request: FramesRequest, sensors: Sensors, say: Say) -> None:
    """Says what was left out of the pairs that were written.

    Args:
        pairs: What was written, and what not.
        request: Which bag, and how near in time image and scan must be.
        sensors: Topics of the images and the points.
        say: Receives the lines.

    Raises:
        InputError: No pair was written.
    """
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


def _some_frames(folder: Path) -> Iterator[ImageAndScan]:
    """Yields the image and the scan of a few of the written frames, evenly spaced.

    Args:
        folder: The output folder.
    """
    scans = _written(folder, "sparse")
    images = _written(folder, "rgb")
    step = math.ceil(len(scans) / _COMPARED_FRAMES)
    for image, scan in zip(images[::step], scans[::step], strict=True):
        points, _ = read_scan(scan)
        yield read_rgb(image).values, points
