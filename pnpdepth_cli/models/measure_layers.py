"""Measures the layers a network can be cut at, and finds the one for the spacing of the points.

The paper's rule of thumb: the influential field of a point should reach the next points, so that
updates reach all pixels. Of such layers, the one with the least of the network behind it is the
cheapest. On real frames fields several gaps wide, and at least half the image, were better: a
network's error is smooth over surfaces, and later layers follow each point and its noise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from pnpdepth_cli.core.influence import influential_field
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.split.cut_point import LayerName
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error

GAPS = 6.0
"""Gaps between points that a field should span."""
LEAST_FRACTION = 0.5
"""Fraction of the image's shorter side that a field should span in any case. Both are the best of
several for FastDepth on even frames of ICL-NUIM, 7-Scenes and KITTI, 100 points to LiDAR."""


@dataclass(frozen=True, kw_only=True)
class MeasuredLayer:
    """A layer and what a cut there costs and reaches; all but the name is None with a problem.

    stride: network pixels per element of z; None if z has no two spatial axes. cost_behind:
    fraction of the network's floating-point operations behind the cut, which every update repeats;
    seconds_behind: time of one pass of that part. parameters: weights of the layer itself. Fields:
    rows and columns that one point influences, see `InfluentialField`.
    """

    name: str
    shape: tuple[int, ...] | None = None
    stride: float | None = None
    cost_behind: float | None = None
    seconds_behind: float | None = None
    parameters: int | None = None
    field_in_z: tuple[int, int] | None = None
    field_in_output: tuple[int, int] | None = None
    problem: str | None = None


def best_layer(
    network: Network, arguments: tuple[Tensor, ...], size: tuple[int, int], point_count: int
) -> str | None:
    """Returns the layer of the definition to cut at for so many points in a frame.

    It is the last one whose influential field in the depth map is wide enough, because that costs
    least. If none is wide enough, it is the one with the widest field.

    Args:
        network: Network whose definition's layers are measured.
        arguments: The network's arguments for the frame, real or synthetic.
        size: Rows and columns of the network's input.
        point_count: Sparse points in the frame, taken to be spread evenly.

    Returns:
        None if there are no points, or no layer that the network can be cut at.
    """
    if not point_count:
        return None
    # No field is wider than the image, and of equally wide ones the last layer is taken.
    enough = min(wanted_field(size, point_spacing(size, point_count)), *size)
    layers, widths = list(network.definition.layers), dict[str, int]()
    # The more of the network lies behind a layer, the wider is its field: bisection finds the last
    # layer that reaches far enough, which is the one of least cost.
    first, end = 0, len(layers)
    while first < end:
        middle = (first + end) // 2
        layer = _measure(network, layers[middle], arguments, size, enough=enough)
        if layer.field_in_output is None:
            del layers[middle]
            end -= 1
            continue
        widths[layer.name] = min(layer.field_in_output)
        if widths[layer.name] >= enough:
            first = middle + 1
        else:
            end = middle
    last_first = [name for name in reversed(layers) if name in widths]
    wide = [name for name in last_first if widths[name] >= enough]
    return wide[0] if wide else max(last_first, key=widths.__getitem__, default=None)


def default_layer(network: Network, size: tuple[int, int], point_count: int) -> str | None:
    """Returns the layer whose output z is updated if no option names one.

    It is the definition's, else the best one for so many points in an image of this size (rows,
    columns), measured on a synthetic frame. None if the definition has no layers.
    """
    definition = network.definition
    if definition.defaults.layer is not None or len(definition.layers) < 2:
        return definition.default_layer
    frame = FrameMap.fit(definition.size, *size)
    with out_of_memory_is_a_device_error(network.device):
        arguments = network.synthetic_arguments(frame)
        return best_layer(network, arguments, frame.network, point_count) or definition.layers[0]


def point_spacing(size: tuple[int, int], point_count: int) -> float:
    """Returns the distance, in pixels, between evenly spread points: √(area / number)."""
    return math.sqrt(size[0] * size[1] / point_count)


def wanted_field(size: tuple[int, int], spacing: float) -> float:
    """Returns how wide an influential field should be, in pixels, for a spacing of the points."""
    return max(GAPS * spacing, LEAST_FRACTION * min(size))


def measure_layers(
    network: Network,
    names: Sequence[str],
    arguments: tuple[Tensor, ...],
    size: tuple[int, int],
    on_layer: Callable[[int, int], None] = lambda done, of: None,
) -> list[MeasuredLayer]:
    """Returns the layers, each measured by a cut there.

    Args:
        names: The layers, in the order of the result.
        arguments: The network's arguments for one frame, real or synthetic.
        size: Rows and columns of the network's input.
        on_layer: Callback after each layer with the number of layers done and of all.
    """
    measured = []
    with torch.no_grad(), FlopCounterMode(display=False) as whole:
        network.depth_of(network.module(*arguments))
    for done, name in enumerate(names, start=1):
        measured.append(
            _measure(network, name, arguments, size, whole_flops=whole.get_total_flops())
        )
        on_layer(done, len(names))
    return measured


def _measure(
    network: Network,
    name: str,
    arguments: tuple[Tensor, ...],
    size: tuple[int, int],
    *,
    whole_flops: int | None = None,
    enough: float | None = None,
) -> MeasuredLayer:
    """The layer; its cost only if the operations of the whole network are given."""
    try:
        with Split(network.module, name) as split, torch.no_grad():
            z = split.front(*arguments)
            cost, seconds = None, None
            if whole_flops is not None:
                split.rear(z)  # the first pass learns the cut
                with FlopCounterMode(display=False) as behind:
                    split.rear(z)
                start = time.perf_counter()
                split.rear(z)
                seconds = time.perf_counter() - start
                cost = behind.get_total_flops() / whole_flops if whole_flops else None
            # On the raw output: where inverse depth is clamped, depth does not change.
            field = influential_field(
                split, z, lambda output: network.raw_of(output).nan_to_num(), enough
            )
    except ModelError as error:
        return MeasuredLayer(name=name, problem=str(error))
    module = dict(network.module.named_modules())[LayerName.parse(name).module]
    return MeasuredLayer(
        name=name,
        shape=tuple(z.shape),
        stride=size[0] / z.shape[-2] if z.ndim == 4 else None,
        cost_behind=cost,
        seconds_behind=seconds,
        parameters=sum(parameter.numel() for parameter in module.parameters()),
        field_in_z=field.in_z,
        field_in_output=field.in_output,
    )
