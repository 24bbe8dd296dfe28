"""`pnpdepth project`, `sample`, `simulate` and `frames`: the commands that make sparse depth."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.choices import PATTERNS, SENSORS
from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.sparse.options import BagOptions, ScanOptions

_NOISE = {
    "metres": "noise",
    "relative": "relative_noise",
    "outliers": "outliers",
    "jitter_px": "jitter",
}
"""Options by the kind of noise that they set."""


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
    from pnpdepth_cli.pipeline.sparse.make import project_scan

    target = options.sparse_target(values)
    height_and_width = options.height_and_width(size) if size else None
    record = project_scan(
        scan,
        ScanOptions(**options.taken(ScanOptions, values)),
        target,
        image=image,
        size=height_and_width,
    )
    _print(record, as_json=as_json)


@click.command(short_help="Sample sparse depth from dense depth.")
@click.argument("depth", type=options.FILE)
@click.option("--pattern", type=click.Choice(PATTERNS), default="uniform", show_default=True)
@click.option(
    "--count", metavar="N|P%", help="Number of points (of lines for `lines`), or % of known pixels."
)
@click.option("--region", metavar="X,Y,W,H", help="Rectangle of the pattern `region`.")
@click.option("--image", type=options.FILE, help="Image for `features` and `edges`.")
@click.option(
    "--seed", type=options.SEED, default=0, show_default=True, metavar="N", help="Random seed."
)
@click.option("--noise", type=float, default=0.0, metavar="M", help="Gaussian noise, metres.")
@click.option(
    "--relative-noise",
    type=float,
    default=0.0,
    metavar="F",
    help="Gaussian noise, as a fraction of the depth.",
)
@click.option(
    "--outliers", type=float, default=0.0, metavar="F", help="Fraction of points of random depth."
)
@click.option(
    "--jitter",
    type=float,
    default=0.0,
    metavar="PX",
    help="Gaussian noise of the pixel coordinates.",
)
@options.depth_scale
@options.channel
@options.sparse_output
@options.output_scale
@click.option("--overlay", type=options.FILE, help="Also write a PNG of the points on --image.")
@options.overwrite
@options.as_json
def sample(
    pattern: str, count: str | None, region: str | None, as_json: bool, **values: Any
) -> None:
    """Sample sparse depth from the dense DEPTH.

    \b
    pnpdepth sample gt.png --pattern uniform --count 500 --seed 1 -o sparse.png
    pnpdepth sample gt.png --pattern lines --count 16 -o sparse.exr
    pnpdepth sample gt.png --pattern features --count 300 --image rgb.png -o sparse.png

    \b
    uniform    N random known pixels
    bernoulli  each known pixel with the same probability; N is the expected number
    grid       square grid with N nodes on a full map
    lines      all known pixels of N evenly spaced rows
    features   the N strongest ORB corners, as in structure from motion
    edges      N random pixels on image edges
    region     all known pixels of a rectangle, or N random ones

    The settings, with the seed, are stored in the file (PNG, CSV) and in a JSON file beside it.
    """
    from pnpdepth_cli.pipeline.sparse.make import (
        SampleNoise,
        SamplePattern,
        SampleRequest,
        sample_depth,
    )

    points, fraction = options.count_or_fraction(count)
    target = options.sparse_target(values)
    noise = SampleNoise(**{key: values.pop(name) for key, name in _NOISE.items()})
    chosen = SamplePattern(
        kind=pattern, count=points, fraction=fraction, region=_region(region) if region else None
    )
    record = sample_depth(SampleRequest(target=target, pattern=chosen, noise=noise, **values))
    _print(record, as_json=as_json)


def _region(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, width, height = (int(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"region {text!r} is not of the form X,Y,WIDTH,HEIGHT") from None
    return left, top, width, height


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
    from pnpdepth_cli.pipeline.sparse.make import (
        SimulateRequest,
        SimulationSettings,
        simulate_scan,
    )

    target = options.sparse_target(values)
    names = [each.name for each in fields(SimulationSettings) if each.name in values]
    settings = SimulationSettings(**{name: values.pop(name) for name in names})
    record = simulate_scan(SimulateRequest(target=target, settings=settings, **values))
    _print(record, as_json=as_json)


@click.command(short_help="Write the frames of a ROS bag as files.")
@click.argument("bag", type=options.FILE)
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@options.options_of_groups(BagOptions)
@click.option(
    "--calib",
    type=options.FILE,
    metavar="FILE|FOLDER",
    help="Calibration of the camera, instead of camera_info.",
)
@options.camera
@click.option("--limit", type=click.IntRange(1), metavar="N", help="Only the first N frames.")
@options.overwrite
@options.as_json
def frames(bag: Path, output: Path, as_json: bool, **values: Any) -> None:
    """Write the images of a BAG and the scans nearest in time as files.

    \b
    pnpdepth frames drive.mcap -o drive/
    pnpdepth frames drive.bag -o drive/ --bag image-topic=/front/image_raw
    pnpdepth batch drive/ -o refined/

    BAG is a file of ROS 1 (.bag) or ROS 2 (.mcap, .db3), or a folder that ROS 2 recorded. OUTPUT
    gets rgb/, sparse/ (PLY), calib.txt from camera_info and tf_static, and poses.txt from odometry.
    """
    from pnpdepth_cli.pipeline.sparse.frames import FramesRequest, write_frames

    bag_options = BagOptions(**options.taken(BagOptions, values))
    request = FramesRequest(bag=bag, output=output, options=bag_options, **values)
    record = write_frames(request, lambda text: click.echo(printable(text), err=True))
    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        click.echo(printable(f"wrote {record['frames']:,} frames to {output}"), err=True)


def _print(record: Mapping[str, Any], *, as_json: bool) -> None:
    from pnpdepth_cli.cli.tables import print_sparse

    if as_json:
        click.echo(json.dumps(record, indent=2))
    else:
        print_sparse(record)
