"""`pnpdepth cloud`: the options, and what is printed of a cloud."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import progress_bar
from pnpdepth_cli.commands.requests.cloud_request import CloudRequest


@click.command("cloud", short_help="Write depth as a coloured point cloud.")
@click.argument("depth", type=options.FILE)
@options.options_of_groups(CloudRequest)
@options.pose_kind
@options.depth_scale
@click.option("-o", "--output", type=options.FILE, required=True, help="PLY file.")
@options.overwrite
def command(**values: Any) -> None:
    """Write DEPTH, a depth file or the results of a batch, as a coloured point cloud.

    \b
    pnpdepth cloud out/img_depth.png -o img.ply
    pnpdepth cloud out/ --calib calib.txt --poses poses.txt --min-views 2 -o drive.ply
    pnpdepth cloud depth.exr --image img.png --calib k.txt -o img.ply

    The cloud is in the camera's coordinates (x right, y down, z forward), with poses in the
    world's. Pixels that NAME_valid.png beside NAME_depth excludes are left out.
    """
    from pnpdepth_cli.cli.printing import print_notes
    from pnpdepth_cli.commands.cloud import write_depth_cloud

    with progress_bar("cloud", "frame") as show:
        what, notes = write_depth_cloud(CloudRequest(**values), show)
    print_notes(notes)
    click.echo(f"wrote {what}: {values['output']}")
