"""`pnpdepth project`: the points of a LiDAR scan that a camera image sees."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from pnpdepth_cli.commands.shared.sparse_files import Written, sparse_outputs, write_sparse_files
from pnpdepth_cli.dataset.arrays import record_of
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.io.file_bytes import plain
from pnpdepth_cli.io.rgb import read_rgb


def project_scan(
    scan: Path,
    image: Path,
    output: Path,
    options: ScanOptions,
    *,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> Written:
    """Writes the scan's points that the camera of the image sees; returns what was written.

    Args:
        scan: The scan, in the scanner's coordinates.
        image: The image, which is drawn on.
        output: File of the sparse depth.
        options: The calibration of the two.
        depth_scale: Numbers of the scan per metre. None: nothing is stated.
        overwrite: Whether existing files are replaced.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    files = sparse_outputs(
        output, (scan, image, options.calib, options.extrinsics), overwrite, drawn=True
    )
    rgb = read_rgb(image).values
    size = (rgb.shape[0], rgb.shape[1])
    projected = read_scan_points(scan, options, size, image, scale=depth_scale)
    records = {"image": record_of(image, kind="image"), "scan": projected.record}
    settings = {"command": "project", **plain(asdict(options))}
    return write_sparse_files(
        files, projected.points, settings, records, [*projected.notes], rgb=rgb
    )
