"""`pnpdepth export`: the options, and what is printed of exported results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.choices import EXPORTS, UNKNOWN
from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import progress_bar


@click.command("export", short_help="Write depth for COLMAP, Nerfstudio, 3DGS, ROS.")
@click.argument("results", type=options.FILE)
@click.option("--to", type=click.Choice(list(EXPORTS)), required=True, help="The program.")
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@click.option(
    "--unknown",
    type=click.Choice(UNKNOWN),
    default="keep",
    show_default=True,
    help="Of 3DGS, which reads no masks: pixels that are not valid keep a depth, or have zero.",
)
@options.overwrite
def command(results: Path, output: Path, **values: Any) -> None:
    """Write RESULTS, a folder of `batch` or `refine`, for a reconstruction program or a viewer.

    \b
    pnpdepth export out/ --to nerfstudio -o scene/
    pnpdepth export out/ --to colmap -o dense/               # the undistorted project
    pnpdepth export out/ --to gaussian-splatting -o dense/
    pnpdepth export out/ --to mcap -o bag/

    \b
    colmap              stereo/depth_maps, stereo/normal_maps, for `colmap stereo_fusion`
    nerfstudio          transforms.json (also for Instant-NGP), depths/ (16-bit PNG), images/,
                        start.ply
    gaussian-splatting  inverse_depths/ (its option -d), sparse/0/depth_params.json,
                        and images/ and a model in sparse/0/ unless they are there
    mcap                a bag of ROS 2, also for Foxglove and Rerun: image, camera_info, depth
                        (32FC1), sigma, points used, cloud, poses as /tf; needs the extra ros

    Camera and pose come from the records, so RESULTS are best those of a COLMAP project
    (`pnpdepth batch --layout colmap`). OUTPUT may be the project itself.
    """
    from pnpdepth_cli.cli.printing import print_notes
    from pnpdepth_cli.commands.export import export_results

    with progress_bar("export", "frame") as show:
        what, notes = export_results(results, output, show=show, **values)
    print_notes(notes)
    click.echo(f"wrote {what}: {output}")
