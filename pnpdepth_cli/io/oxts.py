"""Poses of KITTI's raw drives: packets of the inertial system, oxts/data/*.txt.

A packet begins with latitude, longitude (degrees), altitude (metres), roll, pitch and yaw
(radians). As in the data set's development kit, positions are in a Mercator projection, scaled at
the latitude of the first packet, and the frame of the inertial system is x forward, y left, z up.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.calibration import read_calibration, read_rigid_motion
from pnpdepth_cli.io.file_bytes import read_bytes

PACKETS = "oxts/data"
"""Folder of the packets in a drive."""
IMU_CALIBRATION = "calib_imu_to_velo.txt"

_EARTH_RADIUS_M = 6378137.0
_FIELDS = 30

Floats = NDArray[np.float64]


def read_oxts_poses(packets: list[Path], calibration: Path, camera: int | None) -> Floats:
    """Returns the poses (N, 3, 4) from the camera's frame to one world's, metres.

    Args:
        packets: Of one drive.
        calibration: The folder with KITTI's raw calibrations.
        camera: Number of the camera, None for the left colour camera.

    Raises:
        FileFormatError: A packet or a calibration is damaged.
        InputError: A file cannot be read.
    """
    to_camera = read_calibration(calibration, camera)
    of_scanner = _square(to_camera.rotation, to_camera.translation)
    of_imu = _square(*read_rigid_motion(calibration / IMU_CALIBRATION))
    from_camera = np.linalg.inv(of_scanner @ of_imu)
    read = [_packet(path) for path in packets]
    scale = math.cos(math.radians(read[0][0]))
    return np.stack([(_pose(packet, scale) @ from_camera)[:3] for packet in read])


def _packet(path: Path) -> Floats:
    words = read_bytes(path).decode("utf-8", "replace").split()
    try:
        values = np.array(words, np.float64)
    except ValueError:
        values = np.empty(0)
    if len(values) != _FIELDS or not np.isfinite(values).all() or abs(values[0]) >= 90:
        raise FileFormatError(f"{path} is no packet of KITTI's inertial system; copy it again")
    return values


def _pose(packet: Floats, scale: float) -> Floats:
    """(4, 4) from the inertial system's frame to the world's."""
    latitude, longitude, altitude, roll, pitch, yaw = packet[:6]
    radius = scale * _EARTH_RADIUS_M
    east = radius * math.radians(longitude)
    north = radius * math.log(math.tan(math.pi / 4 + math.radians(latitude) / 2))
    return _square(_turn(yaw, 2) @ _turn(pitch, 1) @ _turn(roll, 0), (east, north, altitude))


def _turn(angle: float, axis: int) -> Floats:
    """(3, 3) rotation about a coordinate axis."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[first, first] = rotation[second, second] = math.cos(angle)
    rotation[second, first], rotation[first, second] = math.sin(angle), -math.sin(angle)
    return rotation


def _square(rotation: Floats, translation: Floats | tuple[float, ...]) -> Floats:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, translation
    return result
