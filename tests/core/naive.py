"""Refinement the slow and obvious way: a hook replaces the layer's output, the rest runs in full."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.losses import LOSSES
from pnpdepth_cli.core.points import SparsePoints
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import LayerName
from pnpdepth_cli.core.structure import map_tensors, tensors_in
from pnpdepth_cli.core.updates import UPDATES


def plain(network: nn.Module, x: Tensor) -> Any:
    """What the network gives in eval mode, without a gradient; the network stays as it is."""
    network = copy.deepcopy(network).eval()
    with torch.no_grad():
        return network(x.clone())


def naive_refine(
    network: nn.Module,
    layer: str,
    x: Tensor,
    points: SparsePoints,
    settings: RefineSettings,
    depth_of: Callable[[Any], Tensor],
) -> tuple[Tensor, list[float]]:
    """(depth of z_K, L(z_0) … L(z_K))."""
    name = LayerName.parse(layer)
    loss_of, update = LOSSES[settings.loss], UPDATES[settings.update]()
    z: Tensor | None = None

    def run() -> Tensor:
        nonlocal z
        fresh = copy.deepcopy(network).eval().requires_grad_(False)
        cut = fresh.get_submodule(name.module)
        calls = 0

        def replace(module: nn.Module, inputs: Any, output: Any) -> Any:
            nonlocal z, calls
            calls += 1
            backward = torch._C._current_graph_task_id() != -1
            if calls != (name.call or 1) and not backward:
                return None
            paths = [path for path, t in tensors_in(output) if t.is_floating_point()]
            path = name.key or paths[0]
            if z is None:
                z = next(t for p, t in tensors_in(output) if p == path).detach().clone()
            return map_tensors(output, lambda p, t: z.clone() if p == path else t)

        cut.register_forward_hook(replace)
        return depth_of(fresh(x.clone()))

    with torch.no_grad():
        run()
    assert z is not None
    losses = []
    for _ in range(settings.iterations):
        z = z.detach().requires_grad_(True)
        with torch.enable_grad():
            loss = loss_of(points.sample(run()), points.depth)
        gradient = torch.autograd.grad(loss, z)[0]
        losses.append(float(loss.detach()))
        z = z.detach() - float(settings.lr) * update(gradient)
    with torch.no_grad():
        depth = run()
        losses.append(float(loss_of(points.sample(depth), points.depth)))
    return depth, losses
