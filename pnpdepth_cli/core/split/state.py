"""What a network is beside its code, so that it can be put back."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.watch import Remembered


def _own(tensors: Mapping[str, Tensor | None]) -> list[Tensor]:
    return [tensor for tensor in tensors.values() if tensor is not None]


class NetworkState:
    """Values, gradient flags and modes of a network as they are now.

    tensors: its parameters and buffers; a `Watch` that protects them saves what is changed.
    """

    def __init__(self, network: nn.Module) -> None:
        modules = list(network.modules())  # going through a deep network takes a while: once
        # Frozen torch scripts have neither a mode nor buffers that can be set.
        plain = [m for m in modules if not isinstance(m, torch.jit.ScriptModule)]
        parameters = list(dict.fromkeys(p for m in modules for p in _own(m._parameters)))
        buffers = dict.fromkeys(b for m in modules for b in _own(m._buffers))
        self.tensors = [Remembered(t) for t in (*parameters, *buffers)]
        self._originals = [remembered.output for remembered in self.tensors]
        self._learning = [(p, p.requires_grad) for p in parameters]
        self._buffers = [(m, dict(m._buffers)) for m in plain if m._buffers]
        self._modes = [(m, m.training) for m in modules if hasattr(m, "training")]

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
