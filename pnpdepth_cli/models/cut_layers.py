"""Layers worth cutting a network at, by the shapes of their outputs and where gradients reach."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import torch
from torch import Tensor, nn
from torch.autograd.graph import Node

from pnpdepth_cli.errors import ModelError, wrap_user_errors
from pnpdepth_cli.models.shapes import run_by_shapes

_SIMILAR_ASPECT = 1.3
"""A feature map's aspect ratio is at most this factor away from the image's."""

_MOST_IMAGE_CHANNELS = 4
"""A last axis of no more elements is that of the channels, as in (1, H, W, 3)."""

_WITHOUT_GRADIENT = ("Round", "Floor", "Ceil", "Trunc", "Sign")
"""How names of torch's derivatives begin that are 0 everywhere."""


def suggest_layers(
    module: nn.Module, arguments: tuple[Tensor, ...], prediction_of: Callable[[object], Tensor]
) -> tuple[str, ...]:
    """Returns the bottleneck and, behind it, the last layer of each finer resolution.

    The bottleneck is the coarsest feature map; the paper cuts right behind it. Counted are layers
    that return one map (1, c, h, w) of the image's aspect ratio, that run once, and that the
    prediction depends on.

    Args:
        module: The network.
        arguments: Its arguments for a frame, real or synthetic. The first one with four axes is the
            image, (1, c, H, W) or (1, H, W, c).
        prediction_of: Function from what the network returns to the prediction (1, 1, h, w).

    Returns:
        Names of submodules, from coarse to fine; empty if none qualifies, or there is no image. One
        as fine as the prediction is named only if there is no other.

    Raises:
        ModelError: The network raises, or no gradient comes back from its prediction.
    """
    image = next((argument for argument in arguments if argument.ndim == 4), None)
    if image is None:
        return ()
    is_channels_last = image.shape[-1] <= _MOST_IMAGE_CHANNELS
    image_height, image_width = image.shape[1:3] if is_channels_last else image.shape[2:4]
    # One pass, without values where the network allows that.
    run = partial(_run_and_keep_maps, prediction_of=prediction_of)
    prediction, maps = run_by_shapes(module, arguments, run)
    # The feature maps that the prediction depends on, by their pixels.
    operations = _operations_behind(prediction)
    areas = {
        name: feature_map.shape[2:].numel()
        for name, feature_map in maps.items()
        if feature_map.shape[1] > 1
        and _is_of_aspect(feature_map, image_height / image_width)
        and feature_map.grad_fn in operations
    }
    # From the bottleneck on, the last map of each area; coarser side branches do not count.
    coarsest = min(areas.values(), default=0)
    last_layers: dict[int, str] = {}
    for name, area in areas.items():
        is_from_bottleneck_on = bool(last_layers) or area == coarsest
        if is_from_bottleneck_on and area >= max(last_layers, default=0):
            last_layers[area] = name
    if len(last_layers) == 1:
        return tuple(last_layers.values())
    prediction_area = prediction.shape[2:].numel()
    return tuple(name for area, name in last_layers.items() if area < prediction_area)


def _operations_behind(prediction: Tensor) -> set[Node]:
    """Returns the operations of torch's graph that a gradient of the prediction comes back to."""
    seen = set[Node]()
    operations = [prediction.grad_fn]
    while operations:
        operation = operations.pop()
        if operation is None or operation in seen:
            continue
        seen.add(operation)
        if not operation.name().startswith(_WITHOUT_GRADIENT):
            operations += [earlier for earlier, _ in operation.next_functions]
    return seen


def _is_of_aspect(feature_map: Tensor, aspect: float) -> bool:
    """Whether height over width of a map (1, c, h, w), of 2×2 at least, is about this aspect."""
    height, width = feature_map.shape[2:4]
    if min(height, width) < 2:
        return False
    return 1 / _SIMILAR_ASPECT < (height / width) / aspect < _SIMILAR_ASPECT


def _run_and_keep_maps(
    module: nn.Module, arguments: tuple[Tensor, ...], prediction_of: Callable[[object], Tensor]
) -> tuple[Tensor, dict[str, Tensor]]:
    """Runs the network once, with gradients.

    Args:
        module: The network.
        arguments: Its arguments.
        prediction_of: Function from what the network returns to the prediction (1, 1, h, w).

    Returns:
        The prediction, and by name the outputs (n, c, h, w) of the submodules that ran exactly once
        and that gradients reach, in the order in which they finished.

    Raises:
        ModelError: The network raises, or no gradient comes back from its prediction.
    """
    maps: dict[str, Tensor] = {}
    run_counts: Counter[str] = Counter()

    def keep_map(name: str, _module: nn.Module, _inputs: object, output: object) -> None:
        """Counts a run of a submodule, and keeps its output if it could be cut there."""
        run_counts[name] += 1
        if isinstance(output, Tensor) and output.ndim == 4 and output.requires_grad:
            maps[name] = output

    with ExitStack() as hooks, torch.enable_grad(), wrap_user_errors("the network's forward"):
        for name, submodule in module.named_modules():
            # The network itself has no name, and TorchScript takes no such hooks.
            if name and not isinstance(submodule, torch.jit.ScriptModule):
                hooks.enter_context(submodule.register_forward_hook(partial(keep_map, name)))
        # Gradients reach the inputs, so all that is computed of them has an operation in the graph.
        inputs = tuple(
            argument.detach().requires_grad_(argument.is_floating_point()).clone()
            for argument in arguments
        )
        prediction = prediction_of(module(*inputs))
    if not prediction.requires_grad:
        raise ModelError(
            "no gradient comes back from the network's prediction; does a part of its forward run"
            " under torch.no_grad or inference_mode, detach, or go through numpy? take that out, or"
            " state layers behind it in a definition"
        )
    return prediction, {name: kept for name, kept in maps.items() if run_counts[name] == 1}
