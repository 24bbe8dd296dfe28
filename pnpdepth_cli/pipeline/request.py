"""What the user asks of a refinement, and the settings that follow from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.pipeline.scans import ScanOptions


@dataclass(frozen=True, kw_only=True)
class RefineRequest:
    """What the user asks for; None means the network's own default.

    depth_scale, gt_scale: integer depth files hold metres × scale. holdout: the share of the
    points kept from the network and the loss, and only scored. output_kind, normalise: what the
    network's numbers are and which rgb it wants, over what its definition says. scan: how to
    project `sparse` where it is a LiDAR scan.
    """

    image: Path | None
    sparse: Path
    gt: Path | None = None
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
    align: str | None = None
    align_every: bool = False
    output_kind: str | None = None
    normalise: str | None = None
    depth_scale: float | None = None
    gt_scale: float | None = None
    channel: str | None = None
    sparse_size_ok: bool = False
    scan: ScanOptions = field(default_factory=ScanOptions)
    holdout: float = 0.0
    seed: int = 0
    device: str = "cpu"


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
    defaults = definition.defaults
    iterations = defaults.iterations if request.iterations is None else request.iterations
    if iterations < 0:
        raise UsageError(f"iterations {iterations} is negative; 0 gives the plain prediction")
    return RefineSettings(
        iterations=iterations,
        lr=defaults.lr if request.lr is None else request.lr,
        loss=request.loss or defaults.loss,
        update=request.update or defaults.update,
        align=request.align or definition.default_alignment,
        align_every=request.align_every,
    )
