"""Sources of sparse depth: projected scans, sampled dense depth, and simulated LiDARs.

All return `SparsePoints` of numpy arrays: N depths in metres at pixel coordinates of one image,
x right, y down, whole numbers at pixel centres. Nothing here reads a file.
"""

from __future__ import annotations

from pnpdepth_cli.sensors.accumulation import NeighbourScan, accumulated
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.lidar import FORWARD_LEFT_UP, LIDARS, Lidar, simulate_lidar
from pnpdepth_cli.sensors.projection import edge_agreement, occluded_in_map, project_velodyne
from pnpdepth_cli.sensors.samplers import (
    PATTERNS,
    SampleNoise,
    SamplePattern,
    sample_points,
    with_noise,
)
from pnpdepth_cli.sensors.sparse import Points, as_depth_image, describe_dropped

__all__ = [
    "FORWARD_LEFT_UP",
    "LIDARS",
    "PATTERNS",
    "Camera",
    "Lidar",
    "NeighbourScan",
    "Points",
    "SampleNoise",
    "SamplePattern",
    "accumulated",
    "as_depth_image",
    "describe_dropped",
    "edge_agreement",
    "occluded_in_map",
    "project_velodyne",
    "sample_points",
    "simulate_lidar",
    "with_noise",
]
