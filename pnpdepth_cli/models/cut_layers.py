"""Layers worth cutting a network at, by the shapes of their outputs and where gradients reach."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from itertools import dropwhile
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.autograd.graph import Node

from pnpdepth_cli.errors import ModelError, wrap_user_errors
from pnpdepth_cli.models.shapes import run_by_shapes

if TYPE_CHECKING:
    pass

_SIMILAR_ASPECT = 1.3  # a feature map's aspect ratio is at most this factor away from the image's

_WITHOUT_GRADIENT = ("Round", "Floor", "Ceil", "Trunc", "Sign")
"""How names of torch's derivatives begin that are 0 everywhere."""

_Arguments = tuple[Tensor, ...]


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
    prediction, maps = run_by_shapes(module, arguments, observe)
    # Feature maps that the prediction depends on.
    behind = _nodes_of(prediction)
    areas = {
        name: output.shape[2:].numel()
        for name, output in maps.items()
        if output.shape[1] > 1 and _has_aspect_of(output, sides) and output.grad_fn in behind
    }
    # The last map before each finer one, from the first of the coarsest maps on.
    coarsest = min(areas.values(), default=0)
    last_of = dict[int, str]()
    for name, area in dropwhile(lambda named: named[1] > coarsest, areas.items()):
        if area >= max(last_of, default=0):
            last_of[area] = name
    finest = prediction.shape[2:].numel()
    return tuple(n for area, n in last_of.items() if area < finest or len(last_of) == 1)


def _nodes_of(prediction: Tensor) -> set[Node]:
    """The operations of torch's graph that a gradient of the prediction comes back through."""
    seen = set[Node]()
    nodes = [prediction.grad_fn]
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
        for name, submodule in module.named_modules():
            if name and not isinstance(submodule, torch.jit.ScriptModule):
                hooks.enter_context(submodule.register_forward_hook(partial(keep, name)))
        inputs = tuple(a.detach().requires_grad_(a.is_floating_point()).clone() for a in arguments)
        prediction = prediction_of(module(*inputs))
    if not prediction.requires_grad:
        raise ModelError(
            "no gradient comes back from the network's prediction; does a part of its forward run"
            " under torch.no_grad or inference_mode, detach, or go through numpy? take that out, or"
            " state layers behind it in a definition"
        )
    return prediction, {name: output for name, output in maps.items() if ran[name] == 1}
