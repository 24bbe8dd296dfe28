"""`pnpdepth layers`: where a network can be cut, and what each cut costs and reaches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.commands.refinement.request import NetworkChoice
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.io.sparse_files import read_sparse
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.frame import synthetic_frame
from pnpdepth_cli.models.network import load_network, out_of_memory_is_a_device_error
from pnpdepth_cli.models.rank_layers import (
    MeasuredLayer,
    measure_layers,
    point_spacing,
    rank_layers,
    wanted_field,
)
from pnpdepth_cli.sensors import occluded_in_map

DEFAULT_SIZE = (240, 320)
"""Rows and columns of the synthetic frame where neither a size nor sparse depth is given."""


@dataclass(frozen=True, kw_only=True)
class LayerList:
    """The layers of a network, in the order of the definition, or of the network's submodules.

    spacing: pixels of the network's frame between sparse points; None without sparse depth.
    """

    rows: list[MeasuredLayer]
    spacing: float | None
    notes: tuple[str, ...]


def list_layers(
    choice: NetworkChoice,
    *,
    every: bool,
    size: tuple[int, int] | None = None,
    sparse: Path | None = None,
    on_layer: Callable[[int, int], None] = lambda done, of: None,
) -> LayerList:
    """Returns the layers that a network can be cut at, measured on a synthetic frame.

    Args:
        choice: The network, its weights and device.
        every: Whether all submodules are listed, not only the layers of the definition.
        size: Rows and columns of the frame; None takes those of `sparse`, or the network's own, or
            `DEFAULT_SIZE`.
        sparse: A sparse depth map; the layers are ranked for the spacing of its points.
        on_layer: Called after each layer with the number of layers done and of all.

    Raises:
        UsageError: The definition lists no layers.
        ModelError, CheckpointError, DeviceError, InputError: As in loading and reading.
    """
    network = load_network(choice.model, choice.checkpoint, choice.device)
    policy, count = network.definition.size, None
    own = (policy.height, policy.width) if isinstance(policy, Fixed) else DEFAULT_SIZE
    if sparse is not None:
        points = read_sparse(sparse, size=size or own).points
        hidden = occluded_in_map(points)  # refine drops them
        count = len(points) if hidden is None else int((~hidden).sum())
        size = size or points.size
    names = list(network.definition.layers)
    if every:
        names = [name for name, _ in network.module.named_modules() if name]
    if not names:
        raise UsageError(
            f"the definition of {network.definition.name!r} lists no layers; --all lists every one"
        )
    with out_of_memory_is_a_device_error(network.device):
        rgb, synthetic_points = synthetic_frame(size or own)
        prepared = prepare(network, Frame(rgb=rgb[0], points=synthetic_points))
        rows = measure_layers(network, names, prepared.arguments, prepared.map.network, on_layer)
    spacing, notes = None, network.notes
    if count:
        spacing = point_spacing(prepared.map.network, count)
        rows = rank_layers(rows, wanted_field(prepared.map.network, spacing))
        if network.definition.defaults.layer is not None:
            notes = (
                *notes,
                f"layers: {network.definition.name!r} is cut at {network.definition.defaults.layer}"
                " by default, as its definition says",
            )
    return LayerList(rows=rows, spacing=spacing, notes=notes)
