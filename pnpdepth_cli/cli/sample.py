"""`pnpdepth project`, `sample`, `simulate` and `frames`: the commands that make sparse depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.choices import SENSORS
from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import say
from pnpdepth_cli.commands.refinement.refine_request import parse_sample
from pnpdepth_cli.commands.requests import FramesRequest
from pnpdepth_cli.dataset.frame_files import ScanOptions


@click.command(short_help="Project a LiDAR scan into a camera image.")
@click.argument("scan", type=options.FILE)
@options.options_of_groups(ScanOptions)
@click.option(
    "--image",
    type=options.FILE,
    required=True,
    help="Camera image: gives the size, and is drawn on.",
)
@options.sparse_files
def project(**values: Any) -> None:
    """Project a LiDAR SCAN (KITTI's BIN, NPY, PCD or PLY) to a sparse depth map.

    \b
    pnpdepth project 000001.bin --calib 000001.txt --image 000001.png -o sparse.png
    pnpdepth project 0000000005.bin --calib 2011_09_26/ --camera 3 -o sparse.exr

    Points behind the camera, outside the image, behind another point in their pixel, or occluded by
    the foreground are dropped and counted. Beside the output, NAME_overlay.png is the image with
    the points, and a JSON file records the settings.
    """
    from pnpdepth_cli.cli.printing import print_sparse
    from pnpdepth_cli.commands.make_sparse import project_scan

    scan_options = ScanOptions(**options.take_options(ScanOptions, values))
    print_sparse(project_scan(options=scan_options, **values))


@click.command(short_help="Sample sparse depth from dense depth.")
@click.argument("depth", type=options.FILE)
@click.option(
    "--count",
    "pattern",
    type=parse_sample,
    required=True,
    metavar="[PATTERN:]N|P%",
    help="Number of points (of lines for `lines`), or % of known pixels.",
)
@click.option("--image", type=options.FILE, help="Image for `features`.")
@options.seed
@options.sparse_files
def sample(**values: Any) -> None:
    """Sample sparse depth from the dense DEPTH.

    \b
    pnpdepth sample gt.png --count 500 --seed 1 -o sparse.png
    pnpdepth sample gt.png --count features:300 --image rgb.png -o sparse.png

    \b
    uniform    N random known pixels; the default pattern
    shuffle    the first N known pixels as numpy's legacy generator shuffles them
    grid       square grid with N nodes on a full map
    lines      all known pixels of N evenly spaced rows
    features   the N strongest ORB corners, as in structure from motion

    A JSON file beside the output records the settings.
    """
    from pnpdepth_cli.cli.printing import print_sparse
    from pnpdepth_cli.commands.make_sparse import sample_depth

    print_sparse(sample_depth(**values))


@click.command(short_help="Simulate a LiDAR in a scene with dense depth.")
@click.argument("depth", type=options.FILE)
@click.option(
    "--sensor", type=click.Choice(SENSORS), help="LiDAR by its data sheet, or as the paper has it."
)
@click.option(
    "--beams",
    type=click.IntRange(1, 4096),
    metavar="N",
    help="Beams of another LiDAR, evenly spaced, without noise.",
)
@click.option(
    "--vertical-fov",
    type=(float, float),
    metavar="TOP BOTTOM",
    help="Elevations of its uppermost and lowest beam, degrees.",
)
@click.option(
    "--calib",
    type=options.FILE,
    required=True,
    metavar="FILE|FOLDER",
    help="Intrinsics: a file with nine numbers or K, or a KITTI calibration.",
)
@options.seed
@options.sparse_files
def simulate(**values: Any) -> None:
    """Simulate the sparse depth of a LiDAR in the scene of the dense DEPTH.

    \b
    pnpdepth simulate gt.exr --sensor hdl-64e --calib intrinsics.txt --seed 1 -o sparse.png
    pnpdepth simulate gt.png --sensor vlp-16 --calib calib.txt -o sparse.exr
    pnpdepth simulate gt.png --beams 40 --vertical-fov 15 -25 --calib calib.txt -o sparse.exr
    """
    from pnpdepth_cli.cli.printing import print_sparse
    from pnpdepth_cli.commands.make_sparse import simulate_scan

    print_sparse(simulate_scan(**values))


@click.command(short_help="Write the frames of a ROS bag as files.")
@click.argument("bag", type=options.FILE)
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="TOPIC",
    help="Topic of the images, of the points (PointCloud2 or depth images), or of the poses; may be"
    " given for each.  [default: the only one]",
)
@options.options_of_groups(FramesRequest)
@options.overwrite
def frames(bag: Path, output: Path, **values: Any) -> None:
    """Write the images of a BAG and the scans nearest in time as files.

    \b
    pnpdepth frames drive.mcap -o drive/
    pnpdepth frames drive.bag -o drive/ --topic /front/image_raw --topic /velodyne
    pnpdepth batch drive/ -o refined/

    BAG is a file of ROS 1 (.bag) or ROS 2 (.mcap, .db3), or a folder that ROS 2 recorded. OUTPUT
    gets rgb/, sparse/ (PLY or EXR), calib.txt from camera_info and tf_static, and poses.txt from
    odometry.
    """
    from pnpdepth_cli.commands.bag_frames import write_frames

    request = FramesRequest(bag=bag, output=output, **values)
    say(f"wrote {write_frames(request, say):,} frames to {output}")
