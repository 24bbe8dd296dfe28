"""`pnpdepth project`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.pipeline.sparse.scan_options import ScanOptions


@click.command(short_help="Project a LiDAR scan into a camera image.")
@click.argument("scan", type=options.FILE)
@options.scan
@click.option("--image", type=options.FILE, help="Camera image: gives the size, and is drawn on.")
@click.option("--size", metavar="HxW", help="Size of the image, instead of --image.")
@options.sparse_output
@options.output_scale
@click.option("--overlay", type=options.FILE, help="Also write a PNG of the points on the image.")
@options.overwrite
@options.as_json
def project(scan: Path, image: Path | None, size: str | None, as_json: bool, **values: Any) -> None:
    """Project a LiDAR SCAN (KITTI's BIN, NPY, PCD or PLY) to a sparse depth map.

    \b
    pnpdepth project 000001.bin --calib 000001.txt --image 000001.png -o sparse.png
    pnpdepth project 0000000005.bin --calib 2011_09_26/ --camera 3 -o sparse.exr

    Points behind the camera, outside the image, behind another point in their pixel, or occluded by
    the foreground are dropped and counted. A JSON file beside the output records the settings.
    """
    from pnpdepth_cli.cli.tables import print_sparse
    from pnpdepth_cli.pipeline.sparse.project import ProjectRequest, project_scan

    target = options.sparse_target(values)
    record = project_scan(
        ProjectRequest(
            scan=scan,
            options=ScanOptions(**values),
            target=target,
            image=image,
            size=options.height_and_width(size) if size else None,
        )
    )
    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        print_sparse(record)
