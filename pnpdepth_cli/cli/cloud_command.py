"""`pnpdepth cloud`."""

from __future__ import annotations

import math
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.progress import progress_bar


@click.command(short_help="Write depth as a coloured point cloud.")
@click.argument("depth", type=options.FILE)
@click.option("--image", type=options.FILE, help="Image with the colours.  [default: the record's]")
@click.option(
    "--calib",
    type=options.FILE,
    metavar="FILE|FOLDER",
    help="Calibration of the camera: a file with K, or a KITTI file or raw folder.  [default: the"
    " record's, else EXIF]",
)
@click.option(
    "--fov", "fov_deg", type=float, metavar="DEG", help="Horizontal field of view, without --calib."
)
@click.option(
    "--poses",
    type=options.FILE,
    help="Camera poses of a folder's files: TUM rows are joined by time, KITTI rows by"
    " order, transforms.json by name.  [default: the records']",
)
@options.pose_kind
@options.depth_scale
@click.option("--max-depth", type=float, default=math.inf, metavar="M", help="Drop farther pixels.")
@click.option(
    "--max-sigma",
    type=float,
    metavar="F",
    help="Drop pixels whose standard deviation is above this fraction of their depth.",
)
@click.option(
    "--min-views",
    type=click.IntRange(1),
    default=1,
    metavar="N",
    show_default=True,
    help="Keep pixels on which N views agree; their depth is the mean.",
)
@click.option("--voxel", type=float, metavar="M", help="Merge the points in cubes of this side.")
@click.option("-o", "--output", type=options.FILE, required=True, help="PLY file.")
@options.overwrite
def cloud(**values: Any) -> None:
    """Write DEPTH, a depth file or the results of a batch, as a coloured point cloud.

    \b
    pnpdepth cloud out/img_depth.png -o img.ply
    pnpdepth cloud out/ --calib calib.txt --poses poses.txt --min-views 2 -o drive.ply
    pnpdepth cloud depth.exr --image img.png --fov 60 -o img.ply

    The cloud is in the camera's coordinates (x right, y down, z forward), with poses in the
    world's. Pixels that NAME_valid.png beside NAME_depth excludes are left out.
    """
    from pnpdepth_cli.commands.cloud import CloudRequest, write_depth_cloud

    with progress_bar("cloud", "frame") as show:
        record = write_depth_cloud(CloudRequest(**values), show)
    for note in record["notes"]:
        click.echo(note, err=True)
    colours = "coloured" if record["coloured"] else "without colours (no image is known)"
    click.echo(f"wrote {record['points']:,} points, {colours}: {record['output']}")
