"""`pnpdepth simulate`: the options, and what is printed of a simulated scan."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.choices import SENSORS
from pnpdepth_cli.cli import options


@click.command("simulate", short_help="Simulate a LiDAR in a scene with dense depth.")
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
def command(**values: Any) -> None:
    """Simulate the sparse depth of a LiDAR in the scene of the dense DEPTH.

    \b
    pnpdepth simulate gt.exr --sensor hdl-64e --calib intrinsics.txt --seed 1 -o sparse.png
    pnpdepth simulate gt.png --sensor vlp-16 --calib calib.txt -o sparse.exr
    pnpdepth simulate gt.png --beams 40 --vertical-fov 15 -25 --calib calib.txt -o sparse.exr
    """
    from pnpdepth_cli.cli.printing import print_sparse
    from pnpdepth_cli.commands.simulate import simulate_scan

    print_sparse(simulate_scan(**values))
