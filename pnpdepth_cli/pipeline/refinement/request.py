"""What the user asks of a refinement, and the settings that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.layouts.frame import Source
from pnpdepth_cli.io.layouts.protocols import WHOLE, Protocol
from pnpdepth_cli.models.definition import ModelDefinition, RefineDefaults
from pnpdepth_cli.pipeline.sparse.scans import ScanOptions
from pnpdepth_cli.sensors import SamplePattern

if TYPE_CHECKING:  # it imports torch, which `pnpdepth batch` can do without when all is done
    from pnpdepth_cli.core.refine import RefineSettings


@dataclass(frozen=True, kw_only=True)
class RefineRequest:
    """What the user asks for; None means the network's own default.

    sparse: None where `sample` says which pixels of the truth to take instead. depth_scale,
    sparse_scale, gt_scale: integer depth files hold metres × scale; the first holds for both.
    holdout: the share of the points kept from the network and the loss, and only scored.
    output_kind, normalise: what the network's numbers are and which rgb it wants, over what its
    definition says. propagate: how what is left at the points is spread, one of
    `completion.propagation.PROPAGATIONS`. auto, time_budget_s, baselines, uncertainty: see
    `pipeline.refinement.held_out`. scan: how to project `sparse` where it is a LiDAR scan.
    protocol: what is cut out of a frame first of all. tile: the longest side, in pixels, of what
    goes through the network at once; None: the whole frame.
    """

    image: Source | None
    sparse: Path | None
    gt: Source | None = None
    output: Path | None = None
    format: str = "png"
    overwrite: bool = False
    model: str = "compact"
    checkpoint: Path | None = None
    layer: str | None = None
    iterations: int | None = None
    lr: str | None = None
    loss: str | None = None
    update: str | None = None
    schedule: str | None = None
    spread: float | None = None
    parameters: str = "elements"
    anchor: float = 0.0
    line_search: bool = False
    keep_best: bool = False
    align: str | None = None
    align_every: bool = False
    output_kind: str | None = None
    normalise: str | None = None
    depth_scale: float | None = None
    sparse_scale: float | None = None
    gt_scale: float | None = None
    channel: str | None = None
    sparse_size_ok: bool = False
    scan: ScanOptions = field(default_factory=ScanOptions)
    sample: SamplePattern | None = None
    protocol: Protocol = WHOLE
    propagate: str | None = None
    auto: bool = False
    time_budget_s: float | None = None
    baselines: bool = False
    uncertainty: bool = False
    holdout: float = 0.0
    tile: int | None = None
    seed: int = 0
    precision: str = "fp32"
    device: str = "cpu"

    @property
    def needs_folds(self) -> bool:
        """Whether points are to be held out in turns, to choose, to compare or to calibrate."""
        return self.auto or self.baselines or self.uncertainty


def sample_pattern(kind: str, count: int | None, share: float | None) -> SamplePattern:
    """So many points, or this share of the known pixels, by one of the samplers' patterns."""
    return SamplePattern(kind=kind, count=count, share=share)


def count_or_share(text: str) -> tuple[int | None, float | None]:
    """(points, share) of `500` or `5%`; None for what it is not. UsageError for any other text."""
    try:
        if text.strip().endswith("%"):
            return None, float(text.strip()[:-1]) / 100
        return int(text), None
    except ValueError:
        raise UsageError(f"count {text!r} is neither a number such as 500 nor 5%") from None


def layer_name(definition: ModelDefinition, wanted: str | None) -> str:
    """The layer to cut at: a name as it stands, or a share 0…1 of the definition's own layers."""
    wanted = wanted if wanted is not None else definition.default_layer
    if wanted is None:
        raise UsageError(f"network {definition.name!r} has no default layer; name one with --layer")
    try:
        share = float(wanted)
    except ValueError:
        return wanted
    if not 0 <= share <= 1 or not definition.layers:
        raise UsageError(
            f"layer {wanted!r}: a number is a share between 0 and 1 of the layers that the"
            f" definition of {definition.name!r} lists ({len(definition.layers)} of them)"
        )
    return definition.layers[round(share * (len(definition.layers) - 1))]


def effective_settings(definition: ModelDefinition, request: RefineRequest) -> RefineSettings:
    """The request's settings, filled up with the network's defaults. UsageError if one is amiss."""
    from pnpdepth_cli.core.refine import RefineSettings

    defaults = definition.defaults
    iterations = defaults.iterations if request.iterations is None else request.iterations
    if iterations < 0:
        raise UsageError(f"iterations {iterations} is negative; 0 gives the plain prediction")
    update = request.update or defaults.update
    # How far to go depends on how: with another update the rest of a step is the paper's as well.
    steps = defaults if update == defaults.update else RefineDefaults()
    spread = steps.blur if request.spread is None else request.spread
    if not 0 <= spread < math.inf:
        raise UsageError(f"spread {spread} is no distance; give 0 or more spacings of the points")
    if not 0 <= request.anchor < math.inf:
        raise UsageError(f"anchor {request.anchor} is no weight; give 0 or more")
    return RefineSettings(
        iterations=iterations,
        lr=steps.lr if request.lr is None else request.lr,
        loss=request.loss or defaults.loss,
        update=update,
        schedule=request.schedule or steps.schedule,
        blur=spread,
        parameters=request.parameters,
        proximity=request.anchor,
        line_search=request.line_search,
        keep_best=request.keep_best,
        align=request.align or definition.default_alignment,
        align_every=request.align_every,
    )
