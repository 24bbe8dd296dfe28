"""Batch normalisations that help a network learn and are gone from what it becomes.

Networks from before 2015 have none and learn many times slower without. Here they stand behind
layers while these learn and are multiplied into them at the end, so that what is exported is the
published network, no operation more (Ioffe and Szegedy, ICML 2015, section 3.1).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_weights, fuse_linear_bn_weights

SCAFFOLD = "scaffold"


def scaffolded(network: nn.Module, layers: Sequence[str]) -> nn.Module:
    """The network, each of these convolutions and linear layers normalised over the batch."""
    for name in layers:
        layer = network.get_submodule(name)
        assert isinstance(layer, nn.Conv2d | nn.Linear)
        norm: nn.Module
        if isinstance(layer, nn.Conv2d):
            norm = nn.BatchNorm2d(layer.out_channels)
        else:
            norm = nn.BatchNorm1d(layer.out_features)
        layer.add_module(SCAFFOLD, norm)
        layer.register_forward_hook(_through_scaffold)
    return network


def _through_scaffold(layer: nn.Module, _: tuple[Tensor, ...], output: Tensor) -> Tensor:
    """Returns a layer's output normalised by its scaffold; torch calls this hook."""
    normed: Tensor = layer.get_submodule(SCAFFOLD)(output)
    return normed


def without_scaffold(network: nn.Module) -> nn.Module:
    """A copy that does in evaluation what the scaffolded network does, without its scaffold."""
    plain = copy.deepcopy(network)
    for layer in plain.modules():
        norm = getattr(layer, SCAFFOLD, None)
        if norm is None:
            continue
        assert isinstance(layer, nn.Conv2d | nn.Linear)
        fuse = fuse_conv_bn_weights if isinstance(layer, nn.Conv2d) else fuse_linear_bn_weights
        layer.weight, layer.bias = fuse(
            layer.weight, layer.bias, norm.running_mean, norm.running_var,
            norm.eps, norm.weight, norm.bias,
        )  # fmt: skip
        delattr(layer, SCAFFOLD)
        layer._forward_hooks.clear()
    return plain
