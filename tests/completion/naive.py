"""Reference refinement: a hook replaces the output of the layer, and the whole network runs."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.choices import LOSSES, UPDATES
from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.tensors import map_tensors, tensors_in
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings


def frozen_copy(network: nn.Module) -> nn.Module:
    with torch.no_grad():
        return copy.deepcopy(network).eval().requires_grad_(False)


def plain(network: nn.Module, x: Tensor) -> Any:
    """What the network gives in eval mode, without a gradient."""
    with torch.no_grad():
        return frozen_copy(network)(x.clone())


def naive_refine(
    network: nn.Module, layer: str, x: Tensor, points: SparsePoints, settings: ClosedSettings
) -> tuple[Tensor, list[float]]:
    """(depth of z_K, L(z_0) … L(z_K))."""
    cut = CutPoint.find(network, layer)
    loss_of = LOSSES[settings.loss]
    update = UPDATES[settings.update]()
    z: Tensor | None = None

    def depth_with_z() -> Tensor:
        """The depth of the whole network; the first time with its own z, which is kept."""
        calls = 0

        def replace(module: nn.Module, inputs: Any, output: Any) -> Any:
            nonlocal z, calls
            calls += 1
            recomputed = torch._C._current_graph_task_id() != -1
            if calls != (cut.call or 1) and not (recomputed and cut.call is None):
                return None
            paths = [path for path, t in tensors_in(output) if t.is_floating_point()]
            path = cut.key or paths[0]
            if z is None:
                z = next(t for p, t in tensors_in(output) if p == path).detach().clone()
            return map_tensors(output, lambda p, t: z.clone() if p == path else t)

        whole = frozen_copy(network)
        layers = dict(whole.named_modules(remove_duplicate=False))
        layers[cut.name].register_forward_hook(replace, prepend=True)
        return whole(x.clone())

    with torch.no_grad():
        depth_with_z()
    losses = []
    for _ in range(settings.iterations):
        z = z.detach().requires_grad_(True)
        with torch.enable_grad():
            loss = loss_of(points.sample(depth_with_z()), points.depth)
            loss.backward()
        losses.append(float(loss.detach()))
        z = z.detach() - float(settings.lr) * update(z.grad)
    with torch.no_grad():
        depth = depth_with_z()
    return depth, [*losses, float(loss_of(points.sample(depth), points.depth))]
