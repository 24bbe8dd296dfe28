"""The state of a network apart from its code, saved and restored."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.saved import SavedTensors


def _own(tensors: Mapping[str, Tensor | None]) -> list[Tensor]:
    return [tensor for tensor in tensors.values() if tensor is not None]


class NetworkState:
    """Values, gradient flags and modes of a network at the time this object is created.

    Attributes:
        tensors: Its parameters and buffers; a `Watch` that protects them saves those that change.
    """

    def __init__(self, network: nn.Module) -> None:
        modules = list(network.modules())  # going through a deep network takes a while: once
        # Frozen torch scripts have neither a mode nor buffers that can be set.
        plain = [m for m in modules if not isinstance(m, torch.jit.ScriptModule)]
        parameters = list(dict.fromkeys(p for m in modules for p in _own(m._parameters)))
        buffers = dict.fromkeys(b for m in modules for b in _own(m._buffers))
        self.tensors = [SavedTensors(t) for t in (*parameters, *buffers)]
        self._originals = [saved.value for saved in self.tensors]
        self._learning = [(p, p.requires_grad) for p in parameters]
        self._buffers = [(m, dict(m._buffers)) for m in plain if m._buffers]
        self._modes = [(m, m.training) for m in modules if hasattr(m, "training")]

    def freeze(self) -> None:
        """Switches off the gradients of all parameters."""
        for parameter, _ in self._learning:
            parameter.requires_grad_(False)

    def restore(self) -> None:
        """Restores the values of parameters and buffers that the network has changed."""
        for module, buffers in self._buffers:
            module._buffers.update(buffers)
        with torch.no_grad():
            for original, saved in zip(self._originals, self.tensors, strict=True):
                if saved.copied:
                    original.copy_(saved.value)

    def close(self) -> None:
        """Restores everything."""
        self.restore()
        for parameter, requires_grad in self._learning:
            parameter.requires_grad_(requires_grad)
        for module, training in self._modes:
            module.training = training
