"""What a network is beside its code, so that it can be put back."""

from __future__ import annotations

import torch
from torch import nn

from pnpdepth_cli.core.watch import Remembered


class NetworkState:
    """Values, gradient flags and modes of a network as they are now.

    tensors: its parameters and buffers; a `Watch` that protects them saves what is changed.
    """

    def __init__(self, network: nn.Module) -> None:
        self.tensors = [Remembered(t) for t in (*network.parameters(), *network.buffers())]
        self._originals = [remembered.output for remembered in self.tensors]
        self._learning = [(p, p.requires_grad) for p in network.parameters()]
        # Frozen torch scripts have neither a mode nor buffers that can be set.
        modules = [m for m in network.modules() if not isinstance(m, torch.jit.ScriptModule)]
        self._buffers = [(m, dict(m._buffers)) for m in modules if m._buffers]
        self._modes = [(m, m.training) for m in network.modules() if hasattr(m, "training")]

    def freeze(self) -> None:
        """No parameter asks for a gradient."""
        for parameter, _ in self._learning:
            parameter.requires_grad_(False)

    def restore(self) -> None:
        """Parameters and buffers that the network changed have their old values."""
        for module, buffers in self._buffers:
            module._buffers.update(buffers)
        with torch.no_grad():
            for original, saved in zip(self._originals, self.tensors, strict=True):
                if saved.copied:
                    original.copy_(saved.output)

    def close(self) -> None:
        """All of it is as before."""
        self.restore()
        for parameter, requires_grad in self._learning:
            parameter.requires_grad_(requires_grad)
        for module, training in self._modes:
            module.training = training
