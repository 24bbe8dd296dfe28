"""Layers worth cutting a network at: by their shapes, and for the spacing of the points.

The paper's rule of thumb: the influential field of a point should reach the next points, so that
updates reach all pixels. Of such layers, the one with the least of the network behind it is the
cheapest. On real frames fields several gaps wide, and at least half the image, were better: a
network's error is smooth over surfaces, and later layers follow each point and its noise.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from itertools import dropwhile
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.influence import influential_field
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError, out_of_memory_is_a_device_error, wrap_user_errors
from pnpdepth_cli.models.frame_map import FrameMap

if TYPE_CHECKING:
    from pnpdepth_cli.models.network import Network

GAPS = 6.0
"""Gaps between points that a field should span."""
LEAST_FRACTION = 0.5
"""Fraction of the image's shorter side that a field should span in any case. Both are the best of
several for FastDepth on even frames of ICL-NUIM, 7-Scenes and KITTI, 100 points to LiDAR."""

_SIMILAR_ASPECT = 1.3  # a feature map's aspect ratio is at most this factor away from the image's


def default_layer(network: Network, size: tuple[int, int], point_count: int) -> str | None:
    """Returns the layer whose output z is updated if no option names one.

    It is the definition's own, if it states one. Else it is the last of its layers whose
    influential field in the depth map is wide enough for so many even points in an image of this
    size (rows, columns), because that costs least; or the one with the widest field. Fields are
    measured on a synthetic frame. None if the definition has no layers.
    """
    definition, frame = network.definition, FrameMap.fit(network.definition.size, *size)
    if definition.defaults.layer is not None or len(definition.layers) < 2 or not point_count:
        return definition.default_layer
    # No field is wider than the image, and of equally wide ones the last layer is taken.
    enough = min(wanted_field(frame.network, point_count), *frame.network)
    widths = dict[str, int]()
    with out_of_memory_is_a_device_error(network.device):
        arguments = network.synthetic_arguments(frame)
        for name in reversed(definition.layers):
            # A layer that the network cannot be cut at is left out.
            with suppress(ModelError), Split(network.module, name) as split, torch.no_grad():
                z = split.front(*arguments)
                widths[name] = min(influential_field(split, z, network.known_of, enough)[1])
                if widths[name] >= enough:
                    return name
    return max(widths, key=widths.__getitem__, default=definition.layers[0])


def wanted_field(size: tuple[int, int], point_count: int) -> float:
    """Returns how wide an influential field should be, in pixels, for so many even points."""
    spacing = math.sqrt(size[0] * size[1] / point_count)
    return max(GAPS * spacing, LEAST_FRACTION * min(size))


def suggest_layers(
    module: nn.Module, arguments: tuple[Tensor, ...], prediction_of: Callable[[object], Tensor]
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
    prediction, maps = _observe(module, arguments, prediction_of)
    if not prediction.requires_grad:
        raise ModelError(
            "no gradient comes back from the network's prediction; does a part of its forward run"
            " under torch.no_grad or inference_mode, detach, or go through numpy? take that out, or"
            " state layers behind it in a definition"
        )
    # Feature maps that the prediction depends on.
    useful = {n: m for n, m in maps.items() if m.shape[1] > 1 and _has_aspect_of(m, sides)}
    if not useful:
        return ()
    with torch.enable_grad(), wrap_user_errors("the gradient of the network"):
        gradients = torch.autograd.grad(prediction.sum(), [*useful.values()], allow_unused=True)
    areas = {
        name: useful[name].shape[2:].numel()
        for name, gradient in zip(useful, gradients, strict=True)
        if gradient is not None and bool(gradient.any())
    }
    # The last map before each finer one, from the first of the coarsest maps on.
    coarsest, last_of = min(areas.values(), default=0), dict[int, str]()
    for name, area in dropwhile(lambda named: named[1] > coarsest, areas.items()):
        if area >= max(last_of, default=0):
            last_of[area] = name
    finest = prediction.shape[2:].numel()
    return tuple(n for area, n in last_of.items() if area < finest or len(last_of) == 1)


def _has_aspect_of(output: Tensor, sides: tuple[int, ...]) -> bool:
    height, width = output.shape[2:4]
    ratio = (height / max(1, width)) / (sides[0] / sides[1])
    return min(height, width) > 1 and 1 / _SIMILAR_ASPECT < ratio < _SIMILAR_ASPECT


def _observe(
    module: nn.Module, arguments: tuple[Tensor, ...], prediction_of: Callable[[object], Tensor]
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
    return prediction, {name: output for name, output in maps.items() if ran[name] == 1}
