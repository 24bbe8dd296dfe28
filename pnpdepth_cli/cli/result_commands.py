"""`pnpdepth cloud` and `export`: results for other programs."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.choices import EXPORTS
from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import progress_bar
from pnpdepth_cli.commands.requests import CloudRequest


@click.command(short_help="Write depth as a coloured point cloud.")
@click.argument("depth", type=options.FILE)
@options.options_of_groups(CloudRequest)
@options.pose_kind
@options.depth_scale
@click.option("-o", "--output", type=options.FILE, required=True, help="PLY file.")
@options.overwrite
def cloud(**values: Any) -> None:
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


@click.command(short_help="Write depth for COLMAP, Nerfstudio or 3DGS.")
@click.argument("results", type=options.FILE)
@click.option("--to", type=click.Choice(list(EXPORTS)), required=True, help="The program.")
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@options.overwrite
def export(**values: Any) -> None:
    """Write RESULTS, a folder of `batch` or `refine`, for a reconstruction program.

    \b
    pnpdepth export out/ --to nerfstudio -o scene/
    pnpdepth export out/ --to colmap -o dense/               # the undistorted project
    pnpdepth export out/ --to gaussian-splatting -o dense/

    \b
    colmap              stereo/depth_maps, stereo/normal_maps, for `colmap stereo_fusion`
    nerfstudio          transforms.json (also for Instant-NGP), depths/ (16-bit PNG), images/,
                        start.ply
    gaussian-splatting  inverse_depths/ (its option -d), sparse/0/depth_params.json,
                        and images/ and a model in sparse/0/ unless they are there

    Camera and pose come from the records, so RESULTS are best those of a COLMAP project
    (`pnpdepth batch --layout colmap`). OUTPUT may be the project itself.
    """
    from pnpdepth_cli.cli.printing import print_notes
    from pnpdepth_cli.commands.exports import export_results

    with progress_bar("export", "frame") as show:
        what, notes = export_results(**values, show=show)
    print_notes(notes)
    click.echo(f"wrote {what}: {values['output']}")
