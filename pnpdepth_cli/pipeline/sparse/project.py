"""`pnpdepth project`: a LiDAR scan as sparse depth of a camera's image."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.io.record import plain, sha256_of
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.pipeline.sparse.outputs import Provenance, SparseTarget, write_sparse_outputs
from pnpdepth_cli.pipeline.sparse.scan_options import ScanOptions
from pnpdepth_cli.pipeline.sparse.scans import read_scan_points


@dataclass(frozen=True, kw_only=True)
class ProjectRequest:
    """What to project, and where to."""

    scan: Path
    """The scan's file."""

    options: ScanOptions
    """Calibration and limits."""

    target: SparseTarget
    """Files to write."""

    image: Path | None = None
    """The camera's image, which gives the size and the ground of an overlay."""

    size: tuple[int, int] | None = None
    """(H, W) of the image, where there is no file of it."""


def project_scan(request: ProjectRequest) -> dict[str, Any]:
    """Writes the scan's points that the camera sees, and returns the record.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    target, image = request.target, request.image
    target.check((request.scan, image, request.options.calib, request.options.extrinsics))
    if target.overlay is not None and image is None:
        raise UsageError("an overlay needs the image; give --image")
    rgb = None
    size = request.size
    inputs: dict[str, Any] = {}
    if image is not None:
        rgb = read_rgb(image).values
        if size not in (None, rgb.shape[:2]):
            raise SizeError(f"{image} is {rgb.shape[1]}×{rgb.shape[0]}, not of the size given")
        size = (rgb.shape[0], rgb.shape[1])
        inputs["image"] = {"path": str(image), "sha256": sha256_of(image)}
    scan = read_scan_points(request.scan, request.options, size, image)
    settings = plain(asdict(request.options))
    if request.options.point_fields is None:
        del settings["point_fields"]
    return write_sparse_outputs(
        target,
        scan.points,
        Provenance(
            command="project",
            settings=settings,
            inputs=inputs | {"scan": scan.record},
            notes=scan.notes,
        ),
        rgb=rgb,
    )
