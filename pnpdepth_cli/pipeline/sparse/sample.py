"""`pnpdepth sample`: sparse depth out of dense depth, by a pattern and with a seed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.io.depth import describe_range, implausible, read_depth
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.pipeline.sparse.outputs import SparseTarget, write_sparse_outputs
from pnpdepth_cli.sensors import SampleNoise, SamplePattern, sample_points


@dataclass(frozen=True, kw_only=True)
class SampleRequest:
    """What to sample; the fields of the pattern and of the noise are explained there.

    depth_scale: integer depth files hold metres × scale.
    """

    depth: Path
    target: SparseTarget
    pattern: str = "uniform"
    count: int | None = None
    share: float | None = None
    region: tuple[int, int, int, int] | None = None
    noise: dict[str, float] = field(default_factory=dict)
    seed: int = 0
    image: Path | None = None
    depth_scale: float | None = None
    channel: str | None = None


def sample_depth(request: SampleRequest) -> dict[str, Any]:
    """Points of the depth map are on disk; what was done is returned.

    Raises the errors of `pnpdepth_cli.errors`; then nothing is written.
    """
    request.target.check((request.depth, request.image))
    pattern = SamplePattern(
        kind=request.pattern, count=request.count, share=request.share, region=request.region
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
    said = describe_range(
        dense.values, dense.source, assumed_scale=dense.assumed_scale, noun="pixels"
    )
    doubt = implausible(dense.values, dense.scale)
    wanted = pattern.wanted(int(np.count_nonzero(dense.values)))
    made, lost = len(points.depth), sum(points.dropped.values())
    few = request.pattern in ("features", "edges") and made + lost < wanted
    return write_sparse_outputs(
        request.target,
        points,
        command="sample",
        settings={"pattern": asdict(pattern), "noise": asdict(noise), "seed": request.seed},
        inputs=inputs,
        notes=[
            f"depth: {said}",
            *([f"warning: {doubt}"] if doubt else []),
            *([f"warning: the image has {made + lost:,} of the {wanted:,} points asked for"] * few),
            f"sparse: {describe_range(points.depth, f'{request.pattern}, seed {request.seed}')}",
        ],
        rgb=rgb,
    )
