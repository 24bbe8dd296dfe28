"""`pnpdepth simulate`."""

from __future__ import annotations

import json
from typing import Any

import click

from pnpdepth_cli.choices import SENSORS
from pnpdepth_cli.cli import options


@click.command(short_help="Simulate a LiDAR in a scene with dense depth.")
@click.argument("depth", type=options.FILE)
@click.option(
    "--sensor",
    required=True,
    metavar="NAME|FILE.toml",
    help=f"{', '.join(SENSORS)}, the paper's idealised paper-{SENSORS[0]} etc., or a TOML file.",
)
@click.option(
    "--calib",
    type=options.FILE,
    required=True,
    metavar="FILE|FOLDER",
    help="Intrinsics: a file with nine numbers or K, or a KITTI calibration.",
)
@options.camera
@click.option(
    "--offset",
    type=float,
    nargs=3,
    metavar="X Y Z",
    help="Position of the scanner right of, below and in front of the camera, metres.",
)
@click.option("--at-scanner", is_flag=True, help="Place the scanner as in the calibration.")
@click.option(
    "--seed", type=options.SEED, default=0, show_default=True, metavar="N", help="Random seed."
)
@click.option(
    "--rotation-noise",
    "rotation_noise_deg",
    type=float,
    default=0.0,
    metavar="DEG",
    help="Random rotation of the scanner about each axis, standard deviation.",
)
@click.option(
    "--angle-noise",
    "angle_noise_deg",
    type=float,
    metavar="DEG",
    help="Angular noise of each beam.  [default: the sensor's]",
)
@click.option(
    "--range-noise", type=float, metavar="M", help="Range noise.  [default: the sensor's]"
)
@click.option("--dropout", type=float, default=0.0, metavar="F", help="Fraction of lost beams.")
@options.max_range
@options.euclidean
@options.depth_scale
@options.channel
@options.max_pixels
@options.sparse_output
@options.output_scale
@options.overwrite
@options.as_json
def simulate(as_json: bool, **values: Any) -> None:
    """Simulate the sparse depth of a LiDAR in the scene of the dense DEPTH.

    \b
    pnpdepth simulate gt.exr --sensor hdl-64e --calib intrinsics.txt --seed 1 -o sparse.png
    pnpdepth simulate gt.png --sensor my_lidar.toml --calib calib.txt --at-scanner -o sparse.exr

    \b
    A sensor file:  elevations_deg = [10, 5, 0, -5, -10]
                    azimuth_step_deg = 0.2
                    max_range = 80
                    range_noise = 0.02
    """
    from pnpdepth_cli.cli.tables import print_sparse
    from pnpdepth_cli.pipeline.sparse.simulate import SimulateRequest, simulate_scan

    target = options.sparse_target(values)
    record = simulate_scan(SimulateRequest.from_fields(target=target, **values))
    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        print_sparse(record)
