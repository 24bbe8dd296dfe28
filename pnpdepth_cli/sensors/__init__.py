"""Sources of sparse depth: projected scans, sampled dense depth, and simulated LiDARs.

All return `SparsePoints` of numpy arrays: N depths in metres at pixel coordinates of one image,
x right, y down, whole numbers at pixel centres. Nothing here reads a file.
"""

from __future__ import annotations

from pnpdepth_cli.sensors.accumulation import NeighbourScan as NeighbourScan
from pnpdepth_cli.sensors.accumulation import accumulate as accumulate
from pnpdepth_cli.sensors.lidar import FORWARD_LEFT_UP as FORWARD_LEFT_UP
from pnpdepth_cli.sensors.lidar import LIDARS as LIDARS
from pnpdepth_cli.sensors.lidar import Lidar as Lidar
from pnpdepth_cli.sensors.lidar import ideal_lidar as ideal_lidar
from pnpdepth_cli.sensors.lidar import simulate_lidar as simulate_lidar
from pnpdepth_cli.sensors.pixels import Points as Points
from pnpdepth_cli.sensors.pixels import as_depth_image as as_depth_image
from pnpdepth_cli.sensors.pixels import describe_dropped as describe_dropped
from pnpdepth_cli.sensors.projection import behind_foreground as behind_foreground
from pnpdepth_cli.sensors.projection import edge_agreement as edge_agreement
from pnpdepth_cli.sensors.projection import occluded_in_map as occluded_in_map
from pnpdepth_cli.sensors.projection import project_velodyne as project_velodyne
from pnpdepth_cli.sensors.samplers import PATTERNS as PATTERNS
from pnpdepth_cli.sensors.samplers import SamplePattern as SamplePattern
from pnpdepth_cli.sensors.samplers import sample_points as sample_points
