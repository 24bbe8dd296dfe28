"""Layers worth cutting a network at: by their shapes, and for the spacing of the points.

The paper's rule of thumb: the influential field of a point should reach the next points, so that
updates reach all pixels. Of such layers, the one with the least of the network behind it is the
cheapest. On real frames fields several gaps wide, and at least half the image, were better: a
network's error is smooth over surfaces, and later layers follow each point and its noise.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import dropwhile
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.autograd.graph import Node

from pnpdepth_cli.core.influence import Field, influential_fields
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError, out_of_memory_is_a_device_error, wrap_user_errors
from pnpdepth_cli.models.decisions import recalled_layers
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.shapes import by_shapes
from pnpdepth_cli.spent import spent_on

if TYPE_CHECKING:
    from pnpdepth_cli.models.network import Network

GAPS = 6.0
"""Gaps between points that a field should span."""
LEAST_FRACTION = 0.5
"""Fraction of the image's shorter side that a field should span in any case. Both are the best of
several for FastDepth on even frames of ICL-NUIM, 7-Scenes and KITTI, 100 points to LiDAR."""

_SIMILAR_ASPECT = 1.3  # a feature map's aspect ratio is at most this factor away from the image's

_WITHOUT_GRADIENT = ("Round", "Floor", "Ceil", "Trunc", "Sign")
"""How names of torch's derivatives begin that are 0 everywhere."""

_Arguments = tuple[Tensor, ...]


def default_layer(network: Network, size: tuple[int, int], point_count: int) -> str | None:
    """Returns the layer whose output z is updated if no option names one.

    It is the definition's own, if it states one. Else it is the last of its layers whose
    influential field in the depth map is wide enough for so many even points in an image of this
    size (rows, columns), because that costs least; or the one with the widest field. All fields
    follow from one pass. None if the definition has no layers.
    """
    definition, frame = network.definition, FrameMap.fit(network.definition.size, *size)
    if definition.defaults.layer is not None or len(definition.layers) < 2 or not point_count:
        return definition.default_layer
    enough = min(wanted_field(frame.network, point_count), *frame.network)

    def decide() -> list[str]:
        with out_of_memory_is_a_device_error(network.device):
            arguments = network.synthetic_arguments(frame)
            fields = fields_of(network, arguments, definition.layers)
            ordered = _by_preference(definition.layers, fields, enough)
            first = partial(_first_usable, ordered)
            return [by_shapes(network.module, arguments, first) or definition.layers[0]]

    question = f"layer of {definition.layers} for {enough:.6g} pixels of {frame.network}"
    with spent_on("layer"):
        return recalled_layers(network, question, decide)[0]


def _first_usable(layers: Sequence[str], module: nn.Module, arguments: _Arguments) -> str | None:
    """The first of the layers that the network can be cut at."""
    for layer in layers:
        with suppress(ModelError), Split(module, layer) as split, torch.no_grad():
            split.rear(split.front(*arguments))
            return layer
    return None


def fields_of(
    network: Network, arguments: tuple[Tensor, ...], layers: Sequence[str]
) -> dict[str, Field]:
    """Returns the influential fields of layers in a frame with these arguments of the network.

    See `influential_fields`.
    """

    def measured(module: nn.Module, arguments: _Arguments) -> dict[str, Field]:
        return influential_fields(module, arguments, layers, network.map_of)

    return by_shapes(network.module, arguments, measured)


def _by_preference(layers: Sequence[str], fields: Mapping[str, Field], enough: float) -> list[str]:
    """The layers whose field is wide enough, from the last one, then the others, widest first."""
    # No field is wider than the image. Of equally wide ones, that of the larger patch of z is
    # taken, and then the last.
    widths = {
        name: (min(field.in_output), field.stride * min(field.in_z or (0,)))
        for name in reversed(layers)
        if (field := fields.get(name)) is not None
    }
    wide = [name for name, (width, _) in widths.items() if width >= enough]
    others = [name for name in widths if name not in wide]
    return [*wide, *sorted(others, key=widths.__getitem__, reverse=True)]


def wanted_field(size: tuple[int, int], point_count: int) -> float:
    """Returns how wide an influential field should be, in pixels, for so many even points."""
    spacing = math.sqrt(size[0] * size[1] / point_count)
    return max(GAPS * spacing, LEAST_FRACTION * min(size))


def suggest_layers(
    module: nn.Module, arguments: _Arguments, prediction_of: Callable[[object], Tensor]
) -> tuple[str, ...]:
    """Returns the bottleneck and, behind it, the last layer of each finer resolution.

    The bottleneck is the coarsest feature map; the paper cuts right behind it. Counted are layers
    that return one map (1, c, h, w) of the image's aspect ratio, that run once, and that the
    prediction depends on.

    Args:
        module: The network.
        arguments: Its arguments for a frame, real or synthetic.
        prediction_of: Returns the prediction (1, 1, h, w) from what the network returns.

    Returns:
        Names of submodules, from coarse to fine; empty if none qualifies.

    Raises:
        ModelError: The network raises, or no gradient comes back from its prediction.
    """
    image = next((a for a in arguments if a.ndim == 4), None)
    if image is None:
        return ()
    sides = image.shape[1:3] if image.shape[-1] <= 4 else image.shape[2:4]
    observe = partial(_observe, prediction_of=prediction_of)
    prediction, maps = by_shapes(module, arguments, observe)
    # Feature maps that the prediction depends on.
    behind = _nodes_of(prediction)
    areas = {
        name: output.shape[2:].numel()
        for name, output in maps.items()
        if output.shape[1] > 1 and _has_aspect_of(output, sides) and output.grad_fn in behind
    }
    # The last map before each finer one, from the first of the coarsest maps on.
    coarsest, last_of = min(areas.values(), default=0), dict[int, str]()
    for name, area in dropwhile(lambda named: named[1] > coarsest, areas.items()):
        if area >= max(last_of, default=0):
            last_of[area] = name
    finest = prediction.shape[2:].numel()
    return tuple(n for area, n in last_of.items() if area < finest or len(last_of) == 1)


def _nodes_of(prediction: Tensor) -> set[Node]:
    """The operations of torch's graph that a gradient of the prediction comes back through."""
    seen, nodes = set[Node](), [prediction.grad_fn]
    while nodes:
        node = nodes.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if not node.name().startswith(_WITHOUT_GRADIENT):
            nodes += [before for before, _ in node.next_functions]
    return seen


def _has_aspect_of(output: Tensor, sides: tuple[int, ...]) -> bool:
    height, width = output.shape[2:4]
    ratio = (height / max(1, width)) / (sides[0] / sides[1])
    return min(height, width) > 1 and 1 / _SIMILAR_ASPECT < ratio < _SIMILAR_ASPECT


def _observe(
    module: nn.Module, arguments: _Arguments, prediction_of: Callable[[object], Tensor]
) -> tuple[Tensor, dict[str, Tensor]]:
    """One pass: the prediction, and by name the maps of submodules that ran once, in that order."""
    maps: dict[str, Tensor] = {}
    ran: Counter[str] = Counter()

    def keep(name: str, _part: nn.Module, _inputs: object, output: object) -> None:
        ran[name] += 1
        if isinstance(output, Tensor) and output.ndim == 4 and output.requires_grad:
            maps[name] = output

    with ExitStack() as hooks, torch.enable_grad(), wrap_user_errors("the network's forward"):
        for name, part in module.named_modules():
            if name and not isinstance(part, torch.jit.ScriptModule):
                hooks.enter_context(part.register_forward_hook(partial(keep, name)))
        inputs = tuple(a.detach().requires_grad_(a.is_floating_point()).clone() for a in arguments)
        prediction = prediction_of(module(*inputs))
    if not prediction.requires_grad:
        raise ModelError(
            "no gradient comes back from the network's prediction; does a part of its forward run"
            " under torch.no_grad or inference_mode, detach, or go through numpy? take that out, or"
            " state layers behind it in a definition"
        )
    return prediction, {name: output for name, output in maps.items() if ran[name] == 1}
