"""Layers worth cutting at, for a network whose definition names none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.foreign import blaming
from pnpdepth_cli.core.structure import tensors_in

_SQUARE_ENOUGH = 1.3


@dataclass(frozen=True)
class _Seen:
    name: str
    area: int
    output: Tensor


def outline(module: nn.Module, arguments: tuple[Tensor, ...]) -> tuple[str, ...]:
    """From the bottleneck on, the last layer of each resolution, coarse to fine; () if none.

    The bottleneck is the coarsest feature map; the paper cuts where it has just been made. Only
    layers that give one map (1, c, h, w) of the picture's proportions, that run once, and that the
    prediction depends on are counted.
    """
    picture = next((a for a in arguments if a.ndim == 4), None)
    if picture is None:
        return ()
    sides = picture.shape[1:3] if picture.shape[-1] <= 4 else picture.shape[2:4]
    seen, output = _observed(module, arguments)
    useful = [s for s in seen if s.area > 1 and _same_proportions(s.output, sides)]
    finals = [t for _, t in tensors_in(output) if t.requires_grad]
    if not useful or not finals:
        return ()
    with blaming("the gradient of the network"):
        whole = torch.stack([t.float().sum() for t in finals]).sum()
        gradients = torch.autograd.grad(whole, [s.output for s in useful], allow_unused=True)
    last = max(t.shape[-2] * t.shape[-1] for t in finals)
    reached = [
        s
        for s, gradient in zip(useful, gradients, strict=True)
        if gradient is not None and bool((gradient != 0).any()) and s.output.shape[1] > 1
    ]
    if not reached:
        return ()
    chosen: list[_Seen] = []
    coarsest = min(s.area for s in reached)
    for s in reached[[s.area for s in reached].index(coarsest) :]:
        if chosen and chosen[-1].area == s.area:
            chosen[-1] = s
        elif not chosen or s.area > chosen[-1].area:
            chosen.append(s)
    return tuple(s.name for s in chosen if s.area < last or len(chosen) == 1)


def _observed(module: nn.Module, arguments: tuple[Tensor, ...]) -> tuple[list[_Seen], Any]:
    """What single maps the submodules gave, in order, and what the network did."""
    seen: dict[str, _Seen] = {}
    twice: set[str] = set()

    def note(name: str, output: Any) -> None:
        if name in seen:
            twice.add(name)
        if isinstance(output, Tensor) and output.ndim == 4 and output.requires_grad:
            seen[name] = _Seen(name, output.shape[2] * output.shape[3], output)

    hooks = [
        part.register_forward_hook(lambda m, given, output, name=name: note(name, output))
        for name, part in module.named_modules()
        if name and not isinstance(part, torch.jit.ScriptModule)
    ]
    try:
        with torch.enable_grad(), blaming("the network's forward"):
            given = tuple(
                a.detach().requires_grad_(a.is_floating_point()).clone() for a in arguments
            )
            output = module(*given)
    finally:
        for hook in hooks:
            hook.remove()
    return [s for name, s in seen.items() if name not in twice], output


def _same_proportions(output: Tensor, sides: tuple[int, ...]) -> bool:
    height, width = output.shape[2:4]
    if min(height, width) < 2:
        return False
    ratio = (height / width) / (sides[0] / sides[1])
    return 1 / _SQUARE_ENOUGH < ratio < _SQUARE_ENOUGH
