"""Reference refinement: a hook replaces the output of the layer, and the whole network runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.choices import LOSSES, UPDATES
from pnpdepth_cli.core.split.cut_point import LayerName
from pnpdepth_cli.core.split.tensors import map_tensors, tensors_in
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings


@contextmanager
def untouched(network: nn.Module) -> Iterator[None]:
    """Inside, the network is in eval mode and frozen; what its forward does to it is undone."""
    modes = [(m, m.training) for m in network.modules() if hasattr(m, "training")]
    buffers = [(m, name, b, b.clone()) for m in network.modules() for name, b in m._buffers.items()]
    learning = [(p, p.requires_grad) for p in network.parameters()]
    network.eval().requires_grad_(False)
    try:
        yield
    finally:
        for module, name, buffer, value in buffers:
            with torch.no_grad():
                buffer.copy_(value)
            if not isinstance(module, torch.jit.ScriptModule):
                module._buffers[name] = buffer
        for module, mode in modes:
            module.training = mode
        for parameter, requires_grad in learning:
            parameter.requires_grad_(requires_grad)


def plain(network: nn.Module, x: Tensor) -> Any:
    """What the network gives in eval mode, without a gradient."""
    with torch.no_grad(), untouched(network):
        return network(x.clone())


def naive_refine(
    network: nn.Module,
    layer: str,
    x: Tensor,
    points: SparsePoints,
    settings: ClosedSettings,
    depth_of: Callable[[Any], Tensor],
) -> tuple[Tensor, list[float]]:
    """(depth of z_K, L(z_0) … L(z_K))."""
    name, settings = LayerName.parse(layer), settings
    loss_of, update = LOSSES[settings.loss], UPDATES[settings.update]()
    z: Tensor | None = None

    @contextmanager
    def replaced() -> Iterator[Tensor]:
        calls = 0

        def replace(module: nn.Module, inputs: Any, output: Any) -> Any:
            nonlocal z, calls
            calls += 1
            recomputed = torch._C._current_graph_task_id() != -1
            if calls != (name.call or 1) and not (recomputed and name.call is None):
                return None
            paths = [path for path, t in tensors_in(output) if t.is_floating_point()]
            path = name.key or paths[0]
            if z is None:
                z = next(t for p, t in tensors_in(output) if p == path).detach().clone()
            return map_tensors(output, lambda p, t: z.clone() if p == path else t)

        cut = dict(network.named_modules(remove_duplicate=False))[name.module]
        hook = cut.register_forward_hook(replace, prepend=True)
        try:
            with untouched(network):
                yield depth_of(network(x.clone()))
        finally:
            hook.remove()

    with torch.no_grad(), replaced():
        pass
    assert z is not None
    losses = []
    for _ in range(settings.iterations):
        z = z.detach().requires_grad_(True)
        with torch.enable_grad(), replaced() as depth:
            loss = loss_of(points.sample(depth), points.depth)
            loss.backward()
        losses.append(float(loss.detach()))
        assert z.grad is not None
        z = z.detach() - float(settings.lr) * update(z.grad)
    with torch.no_grad(), replaced() as depth:
        losses.append(float(loss_of(points.sample(depth), points.depth)))
    return depth, losses
