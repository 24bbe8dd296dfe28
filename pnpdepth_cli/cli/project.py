"""`pnpdepth project`: the options, and what is printed of a projected scan."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.dataset.frame_files import ScanOptions


@click.command("project", short_help="Project a LiDAR scan into a camera image.")
@click.argument("scan", type=options.FILE)
@options.options_of_groups(ScanOptions)
@click.option(
    "--image",
    type=options.FILE,
    required=True,
    help="Camera image: gives the size, and is drawn on.",
)
@options.sparse_files
def command(**values: Any) -> None:
    """Project a LiDAR SCAN (KITTI's BIN, NPY, PCD or PLY) to a sparse depth map.

    \b
    pnpdepth project 000001.bin --calib 000001.txt --image 000001.png -o sparse.png
    pnpdepth project 0000000005.bin --calib 2011_09_26/ --camera 3 -o sparse.exr

    Points behind the camera, outside the image, behind another point in their pixel, or occluded by
    the foreground are dropped and counted. Beside the output, NAME_overlay.png is the image with
    the points, and a JSON file records the settings.
    """
    from pnpdepth_cli.cli.printing import print_sparse
    from pnpdepth_cli.commands.project import project_scan

    scan_options = ScanOptions(**options.take_options(ScanOptions, values))
    print_sparse(project_scan(options=scan_options, **values))
