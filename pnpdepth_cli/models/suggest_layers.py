"""Layers worth cutting at, for a network whose definition names none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.structure import map_tensors
from pnpdepth_cli.core.split.user_code import wrap_user_errors
from pnpdepth_cli.errors import ModelError

_SQUARE_ENOUGH = 1.3


@dataclass(frozen=True)
class _Seen:
    name: str
    area: int
    output: Tensor


@dataclass(frozen=True)
class _Run:
    """seen: single maps of submodules, in order. copies: where gradients were let in afresh."""

    seen: list[_Seen]
    copies: list[Tensor]
    prediction: Tensor


def outline(
    module: nn.Module, arguments: tuple[Tensor, ...], read: Callable[[Any], Tensor]
) -> tuple[str, ...]:
    """From the bottleneck on, the last layer of each resolution, coarse to fine; () if none.

    The bottleneck is the coarsest feature map; the paper cuts where it has just been made. Only
    layers that give one map (1, c, h, w) of the picture's proportions, that run once, and that the
    prediction depends on are counted. read: the prediction of what the network returns. ModelError
    if no gradient comes back from it, wherever the network were cut.
    """
    picture = next((a for a in arguments if a.ndim == 4), None)
    if picture is None:
        return ()
    sides = picture.shape[1:3] if picture.shape[-1] <= 4 else picture.shape[2:4]
    run = _observed(module, arguments, read)
    if not run.prediction.requires_grad:  # a front without gradients leaves the layers behind it
        run = _observed(module, arguments, read, afresh=True)
        if not _reaches_features(run):
            raise ModelError(
                "no gradient comes back from the network's prediction to any of its layers; does"
                " its forward run under torch.no_grad or inference_mode, detach, or go through"
                " numpy? take that out"
            )
    prediction = run.prediction
    useful = [s for s in run.seen if s.area > 1 and _same_proportions(s.output, sides)]
    if not useful:
        return ()
    with wrap_user_errors("the gradient of the network"):
        gradients = torch.autograd.grad(
            prediction.sum(), [s.output for s in useful], allow_unused=True
        )
    last = prediction.shape[-2] * prediction.shape[-1]
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


def _observed(
    module: nn.Module,
    arguments: tuple[Tensor, ...],
    read: Callable[[Any], Tensor],
    *,
    afresh: bool = False,
) -> _Run:
    """The network's run with these arguments.

    afresh: gradients reach what a submodule gave even where they would not, as if cut there.
    """
    seen: dict[str, _Seen] = {}
    ran: set[str] = set()
    twice: set[str] = set()
    copies: list[Tensor] = []

    def let_in(path: tuple[str, ...], tensor: Tensor) -> Tensor:
        if tensor.requires_grad or not tensor.is_floating_point():
            return tensor
        with torch.inference_mode(False), torch.enable_grad():
            copies.append(tensor.clone().detach().requires_grad_(True))
            return copies[-1].clone()  # in-place operations on the copy itself are forbidden

    def note(name: str, output: Any) -> Any:
        output = map_tensors(output, let_in) if afresh else output
        (twice if name in ran else ran).add(name)
        if isinstance(output, Tensor) and output.ndim == 4 and output.requires_grad:
            seen[name] = _Seen(name, output.shape[2] * output.shape[3], output)
        return output

    hooks = [
        part.register_forward_hook(lambda m, given, output, name=name: note(name, output))
        for name, part in module.named_modules()
        if name and not isinstance(part, torch.jit.ScriptModule)
    ]
    try:
        with torch.enable_grad(), wrap_user_errors("the network's forward"):
            given = tuple(
                a.detach().requires_grad_(a.is_floating_point()).clone() for a in arguments
            )
            prediction = read(module(*given))
    finally:
        for hook in hooks:
            hook.remove()
    once = [s for name, s in seen.items() if name not in twice]
    return _Run(once, copies, prediction)


def _reaches_features(run: _Run) -> bool:
    """Whether a gradient comes back to a copy that is more than the depth map itself."""
    depth = run.prediction.squeeze().shape
    features = [
        t for t in run.copies if t.ndim > 2 and t.shape[1] > 1 and t.squeeze().shape != depth
    ]
    if not features or not run.prediction.requires_grad:
        return False
    with wrap_user_errors("the gradient of the network"):
        gradients = torch.autograd.grad(
            run.prediction.sum(), features, allow_unused=True, retain_graph=True
        )
    return any(gradient is not None for gradient in gradients)


def _same_proportions(output: Tensor, sides: tuple[int, ...]) -> bool:
    height, width = output.shape[2:4]
    if min(height, width) < 2:
        return False
    ratio = (height / width) / (sides[0] / sides[1])
    return 1 / _SQUARE_ENOUGH < ratio < _SQUARE_ENOUGH
