"""`pnpdepth layers`: where a network can be cut, and what each cut costs and reaches."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from pnpdepth_cli.core.influence import influential_field
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.split.layer_name import LayerName
from pnpdepth_cli.errors import ModelError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.io.depth import read_sparse
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.made_up import made_up_frame
from pnpdepth_cli.models.network import Network, load_network, out_of_memory_is_a_device_error

DEFAULT_SIZE = (240, 320)


@dataclass(frozen=True, kw_only=True)
class LayerRow:
    """A layer one can cut at.

    shape: of z. stride: network pixels per element of z, None where z has no two spatial axes.
    cost_behind: share of the network's floating-point operations that every update repeats.
    seconds_behind: what one pass of the part behind takes here. parameters: of the layer itself.
    field_in_z, field_in_output: the influential field of one point, see `InfluentialField`.
    rank: 1 is what the paper's rule of thumb picks, where the spacing of points is known.
    problem: why it cannot be cut at, then all else but the name is None.
    """

    name: str
    shape: tuple[int, ...] | None = None
    stride: float | None = None
    cost_behind: float | None = None
    seconds_behind: float | None = None
    parameters: int | None = None
    field_in_z: tuple[int, int] | None = None
    field_in_output: tuple[int, int] | None = None
    rank: int | None = None
    problem: str | None = None


@dataclass(frozen=True, kw_only=True)
class LayerList:
    """The layers in order, and how far apart the user's points lie, in the network's pixels."""

    rows: list[LayerRow]
    spacing: float | None
    notes: tuple[str, ...]


def list_layers(
    model: str,
    checkpoint: Path | None,
    device: str,
    *,
    every: bool,
    size: tuple[int, int] | None = None,
    sparse: Path | None = None,
    on_layer: Callable[[int, int], None] = lambda done, of: None,
) -> LayerList:
    """The definition's layers, or every submodule, in order, measured on a made-up frame.

    size: (H, W) of the frame; default that of `sparse`, the network's own, or 240×320. With
    `sparse`, a sparse depth map, the layers are ranked by the paper's rule of thumb.
    """
    network = load_network(model, checkpoint, device)
    policy, count = network.definition.size, None
    own = (policy.height, policy.width) if isinstance(policy, Fixed) else DEFAULT_SIZE
    if sparse is not None:
        points = read_sparse(sparse, size=size or own).points
        size, count = size or points.size, len(points)
    names = list(network.definition.layers)
    if every:
        names = [name for name, _ in network.module.named_modules() if name]
    if not names:
        raise UsageError(
            f"the definition of {network.definition.name!r} lists no layers; --all lists every one"
        )
    rows = []
    with out_of_memory_is_a_device_error(network.device):
        rgb, synthetic_points = made_up_frame(size or own)
        prepared = prepare(network, Frame(rgb=rgb[0], points=synthetic_points))
        arguments = prepared.arguments
        with torch.no_grad(), FlopCounterMode(display=False) as whole:
            network.depth_of(network.module(*arguments))
        for done, name in enumerate(names, start=1):
            rows.append(_measure(network, name, arguments, prepared.map, whole.get_total_flops()))
            on_layer(done, len(names))
    height, width = prepared.map.network
    spacing = math.sqrt(height * width / count) if count else None
    return LayerList(
        rows=ranked(rows, spacing) if spacing else rows, spacing=spacing, notes=network.notes
    )


def ranked(rows: list[LayerRow], spacing: float) -> list[LayerRow]:
    """The rows with their ranks: fields as wide as the gap between points first, cheapest first.

    Where no field is as wide, the widest go first. Points spread evenly lie √(area / number) apart.
    """

    def place(row: LayerRow) -> tuple[bool, float]:
        assert row.field_in_output is not None
        field = min(row.field_in_output)
        wide = field >= spacing
        return (not wide, (row.cost_behind or 0.0) if wide else -float(field))

    order = sorted((row for row in rows if row.problem is None), key=place)
    ranks = {row.name: number for number, row in enumerate(order, start=1)}
    return [replace(row, rank=ranks.get(row.name)) for row in rows]


def _measure(
    network: Network, name: str, arguments: tuple[Tensor, ...], frame: FrameMap, whole: int
) -> LayerRow:
    try:
        with Split(network.module, name) as split, torch.no_grad():
            z = split.front(*arguments)
            split.rear(z)
            with FlopCounterMode(display=False) as behind:
                split.rear(z)
            start = time.perf_counter()
            split.rear(z)
            seconds = time.perf_counter() - start
            # As the network gives it: a depth of inverse zero does not move.
            field = influential_field(split, z, network.raw_of)
    except ModelError as error:
        return LayerRow(name=name, problem=str(error))
    return LayerRow(
        name=name,
        shape=tuple(z.shape),
        stride=frame.network[0] / z.shape[-2] if z.ndim == 4 else None,
        cost_behind=behind.get_total_flops() / whole if whole else None,
        seconds_behind=seconds,
        parameters=_parameters(network, name),
        field_in_z=field.in_z,
        field_in_output=field.in_output,
    )


def _parameters(network: Network, name: str) -> int:
    module = dict(network.module.named_modules())[LayerName.parse(name).module]
    return sum(parameter.numel() for parameter in module.parameters())
