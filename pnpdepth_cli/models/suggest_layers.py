"""Suggests layers worth cutting at, for a network whose definition names none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.tensors import map_tensors
from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.errors import ModelError

_SIMILAR_ASPECT = 1.3
"""A feature map's aspect ratio is at most this factor away from the image's."""


@dataclass(frozen=True)
class _FeatureMap:
    """What a submodule returned, if that is one map (1, c, h, w) that has a gradient."""

    name: str
    output: Tensor

    @property
    def area(self) -> int:
        """Rows times columns."""
        return self.output[0, 0].numel()


@dataclass(frozen=True)
class _Run:
    """One pass of the network: its prediction, (1, 1, h, w), and the maps behind it.

    maps: of the submodules that ran once, in the order in which they ran. copies: of submodules'
    outputs, that gradients were made to reach.
    """

    maps: list[_FeatureMap]
    copies: list[Tensor]
    prediction: Tensor


def suggest_layers(
    module: nn.Module,
    arguments: tuple[Tensor, ...],
    prediction_of: Callable[[Any], Tensor],
) -> tuple[str, ...]:
    """Returns the bottleneck and, behind it, the last layer of each finer resolution.

    The bottleneck is the coarsest feature map; the paper cuts right behind it. Counted are layers
    that return one map (1, c, h, w) of the image's aspect ratio, that run once, and that the
    prediction depends on.

    Args:
        prediction_of: Returns the prediction (1, 1, h, w) from what the network returns.

    Returns:
        Names of submodules, from coarse to fine; empty if none qualifies.

    Raises:
        ModelError: The network raises, or no gradient comes back from its prediction to any layer.
    """
    image = next((a for a in arguments if a.ndim == 4), None)
    if image is None:
        return ()
    sides = image.shape[1:3] if image.shape[-1] <= 4 else image.shape[2:4]
    run = _observe(module, arguments, prediction_of)
    if not run.prediction.requires_grad:  # the front has no gradients, the layers behind it may
        run = _observe(module, arguments, prediction_of, reach_all=True)
        if not _reaches_features(run):
            raise ModelError(
                "no gradient comes back from the network's prediction to any of its layers; does"
                " its forward run under torch.no_grad or inference_mode, detach, or go through"
                " numpy? take that out"
            )
    useful = [m for m in run.maps if m.area > 1 and _has_aspect_of(m.output, sides)]
    gradients = _gradients(run.prediction, [m.output for m in useful])
    reached = [m for m, g in zip(useful, gradients, strict=True) if g is not None and bool(g.any())]
    chosen = _last_of_each_resolution([m for m in reached if m.output.shape[1] > 1])
    finest = run.prediction.shape[-2] * run.prediction.shape[-1]
    return tuple(m.name for m in chosen if m.area < finest or len(chosen) == 1)


def _gradients(prediction: Tensor, tensors: list[Tensor]) -> tuple[Tensor | None, ...]:
    """Of the prediction's sum; None for a tensor that it does not depend on."""
    if not tensors or not prediction.requires_grad:
        return (None,) * len(tensors)
    with torch.enable_grad(), wrap_user_errors("the gradient of the network"):
        return torch.autograd.grad(prediction.sum(), tensors, allow_unused=True, retain_graph=True)


def _last_of_each_resolution(maps: list[_FeatureMap]) -> list[_FeatureMap]:
    """From the first of the coarsest maps on, the last map before each finer one."""
    chosen: list[_FeatureMap] = []
    areas = [m.area for m in maps]
    first = areas.index(min(areas)) if areas else 0
    for m in maps[first:]:
        if chosen and chosen[-1].area == m.area:
            chosen[-1] = m
        elif not chosen or m.area > chosen[-1].area:
            chosen.append(m)
    return chosen


def _observe(
    module: nn.Module,
    arguments: tuple[Tensor, ...],
    prediction_of: Callable[[Any], Tensor],
    *,
    reach_all: bool = False,
) -> _Run:
    """Runs the network once and keeps the feature maps of its submodules.

    reach_all: outputs that gradients do not reach are replaced by copies that they do reach, as a
    cut there would.
    """
    maps: dict[str, _FeatureMap] = {}
    ran: set[str] = set()
    ran_twice: set[str] = set()
    copies: list[Tensor] = []

    def with_gradient(path: tuple[str, ...], tensor: Tensor) -> Tensor:
        if tensor.requires_grad or not tensor.is_floating_point():
            return tensor
        with torch.inference_mode(False), torch.enable_grad():
            copies.append(tensor.clone().detach().requires_grad_(True))
            return copies[-1].clone()  # in-place operations on the copy itself are forbidden

    def keep(name: str, output: Any) -> Any:
        output = map_tensors(output, with_gradient) if reach_all else output
        (ran_twice if name in ran else ran).add(name)
        if isinstance(output, Tensor) and output.ndim == 4 and output.requires_grad:
            maps[name] = _FeatureMap(name, output)
        return output

    hooks = [
        part.register_forward_hook(lambda m, inputs, output, name=name: keep(name, output))
        for name, part in module.named_modules()
        if name and not isinstance(part, torch.jit.ScriptModule)
    ]
    try:
        with torch.enable_grad(), wrap_user_errors("the network's forward"):
            inputs = tuple(
                a.detach().requires_grad_(a.is_floating_point()).clone() for a in arguments
            )
            prediction = prediction_of(module(*inputs))
    finally:
        for hook in hooks:
            hook.remove()
    once = [m for name, m in maps.items() if name not in ran_twice]
    return _Run(once, copies, prediction)


def _reaches_features(run: _Run) -> bool:
    """True if a gradient comes back to a copy that is more than the depth map itself."""
    depth = run.prediction.squeeze().shape
    features = [
        t for t in run.copies if t.ndim > 2 and t.shape[1] > 1 and t.squeeze().shape != depth
    ]
    return any(gradient is not None for gradient in _gradients(run.prediction, features))


def _has_aspect_of(output: Tensor, sides: tuple[int, ...]) -> bool:
    height, width = output.shape[2:4]
    if min(height, width) < 2:
        return False
    ratio = (height / width) / (sides[0] / sides[1])
    return 1 / _SIMILAR_ASPECT < ratio < _SIMILAR_ASPECT
