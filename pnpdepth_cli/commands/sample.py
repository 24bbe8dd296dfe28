"""`pnpdepth sample`: points of a dense depth map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pnpdepth_cli.commands.shared.sparse_files import (
    Written,
    read_dense,
    sparse_outputs,
    write_sparse_files,
)
from pnpdepth_cli.dataset.arrays import record_of
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.sensors.simulation import sample_points


def sample_depth(
    depth: Path,
    output: Path,
    pattern: SamplePattern,
    *,
    image: Path | None = None,
    seed: int = 0,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> Written:
    """Writes points of a dense depth map; returns what was written.

    Args:
        depth: File of the dense depth.
        output: File of the sparse depth.
        pattern: Which pixels are sampled, and how many.
        image: Image of the same view, for the pattern "features".
        seed: Random seed of the pattern.
        depth_scale: Numbers of the dense depth per metre. None: as the file says.
        overwrite: Whether existing files are replaced.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    # The files that are read.
    files = sparse_outputs(output, (depth, image), overwrite)
    dense, notes = read_dense(depth, depth_scale)
    inputs = {"depth": record_of(depth)}
    rgb = None
    if image is not None:
        inputs["image"] = record_of(image, kind="image")
        rgb = read_rgb(image).values
    # The points; an image may have fewer corners than are asked for.
    points = sample_points(dense, pattern, seed, image=rgb)
    wanted = pattern.wanted(int(np.count_nonzero(dense)))
    if pattern.kind == "features" and len(points) < wanted:
        notes.append(f"warning: the image has {len(points):,} of the {wanted:,} points asked for")
    notes.append(f"sparse: {describe_range(points.depth, Reading(f'{pattern.kind}, seed {seed}'))}")
    drawn = {"kind": pattern.kind, "count": pattern.count, "fraction": pattern.fraction}
    settings = {"command": "sample", "pattern": drawn, "seed": seed}
    return write_sparse_files(files, points, settings, inputs, notes)
