"""`pnpdepth sample`: sparse depth sampled from dense depth by a pattern, with a seed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.io.depth import describe_range, implausible, read_depth
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.pipeline.sparse.outputs import Provenance, SparseTarget, write_sparse_outputs
from pnpdepth_cli.sensors import SampleNoise, SamplePattern, sample_points


@dataclass(frozen=True, kw_only=True)
class SampleRequest:
    """What to sample, and where to."""

    depth: Path
    """The dense depth."""

    target: SparseTarget
    """Files to write."""

    pattern: str = "uniform"
    """One of `choices.PATTERNS`."""

    count: int | None = None
    """Number of points; None with a fraction."""

    fraction: float | None = None
    """Fraction of the known pixels; None with a count."""

    region: tuple[int, int, int, int] | None = None
    """x, y, width and height in pixels, for the pattern `region`."""

    noise: dict[str, float] = field(default_factory=dict)
    """Fields of `SampleNoise`."""

    seed: int = 0
    """Of the pattern and the noise."""

    image: Path | None = None
    """The image, for the patterns that need one and for an overlay."""

    depth_scale: float | None = None
    """Codes per metre of an integer depth file; None for the file's own."""

    channel: str | None = None
    """The EXR channel or NPZ array with the depth."""


def sample_depth(request: SampleRequest) -> dict[str, Any]:
    """Writes points of the depth map, and returns the record.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    request.target.check((request.depth, request.image))
    pattern = SamplePattern(
        kind=request.pattern, count=request.count, fraction=request.fraction, region=request.region
    )
    noise = SampleNoise(**request.noise)
    dense = read_depth(request.depth, scale=request.depth_scale, channel=request.channel)
    rgb = None if request.image is None else read_rgb(request.image).values
    points = sample_points(dense.values, pattern, request.seed, image=rgb, noise=noise)
    inputs = {
        name: {"path": str(path), "sha256": sha256_of(path)}
        for name, path in (("depth", request.depth), ("image", request.image))
        if path is not None
    }
    depth_range = describe_range(
        dense.values, dense.source, assumed_scale=dense.assumed_scale, noun="pixels"
    )
    unlikely = implausible(dense.values, dense.scale)
    wanted = pattern.wanted(int(np.count_nonzero(dense.values)))
    sampled = len(points.depth) + sum(points.dropped.values())
    few = request.pattern in ("features", "edges") and sampled < wanted
    source = f"{request.pattern}, seed {request.seed}"
    return write_sparse_outputs(
        request.target,
        points,
        Provenance(
            command="sample",
            settings={"pattern": asdict(pattern), "noise": asdict(noise), "seed": request.seed},
            inputs=inputs,
            notes=[
                f"depth: {depth_range}",
                *([f"warning: {unlikely}"] if unlikely else []),
                *([f"warning: the image has {sampled:,} of the {wanted:,} points asked for"] * few),
                f"sparse: {describe_range(points.depth, source)}",
            ],
        ),
        rgb=rgb,
    )
