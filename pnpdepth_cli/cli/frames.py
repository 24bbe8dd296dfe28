"""`pnpdepth frames`: the options, and what is printed of the frames of a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import say
from pnpdepth_cli.commands.requests.frames_request import FramesRequest


@click.command("frames", short_help="Write the frames of a ROS bag as files.")
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
def command(bag: Path, output: Path, **values: Any) -> None:
    """Write the images of a BAG and the scans nearest in time as files.

    \b
    pnpdepth frames drive.mcap -o drive/
    pnpdepth frames drive.bag -o drive/ --topic /front/image_raw --topic /velodyne
    pnpdepth batch drive/ -o refined/

    BAG is a file of ROS 1 (.bag) or ROS 2 (.mcap, .db3), or a folder that ROS 2 recorded. OUTPUT
    gets rgb/, sparse/ (PLY or EXR), calib.txt from camera_info and tf_static, and poses.txt from
    odometry.
    """
    from pnpdepth_cli.commands.frames import write_frames

    request = FramesRequest(bag=bag, output=output, **values)
    say(f"wrote {write_frames(request, say):,} frames to {output}")
