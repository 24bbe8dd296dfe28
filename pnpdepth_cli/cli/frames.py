"""`pnpdepth frames`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.pipeline.sparse.bag_options import BagOptions


@click.command(short_help="Write the frames of a ROS bag as files.")
@click.argument("bag", type=options.FILE)
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@options.options_of_groups(BagOptions)
@click.option("--limit", type=click.IntRange(1), metavar="N", help="Only the first N frames.")
@options.overwrite
@options.as_json
def frames(bag: Path, output: Path, limit: int | None, as_json: bool, **values: Any) -> None:
    """Write the images of a BAG and the scans nearest in time as files.

    \b
    pnpdepth frames drive.mcap -o drive/
    pnpdepth frames drive.bag -o drive/ --image-topic /front/image_raw --points-topic /velodyne
    pnpdepth batch drive/ -o refined/

    BAG is a file of ROS 1 (.bag) or ROS 2 (.mcap, .db3), or a folder that ROS 2 recorded. OUTPUT
    gets rgb/, sparse/ (PLY), calib.txt from camera_info and tf_static, and poses.txt from odometry.
    """
    from pnpdepth_cli.pipeline.sparse.frames import FramesRequest, write_frames

    bag_options = BagOptions(**options.taken(BagOptions, values))
    request = FramesRequest(
        bag=bag, output=output, options=bag_options, limit=limit, overwrite=values["overwrite"]
    )
    record = write_frames(request, lambda text: click.echo(printable(text), err=True))
    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        click.echo(printable(f"wrote {record['frames']:,} frames to {output}"), err=True)
