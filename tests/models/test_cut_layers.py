"""Layers to cut at, suggested by shapes and gradients."""

from __future__ import annotations

from collections import OrderedDict

import pytest
import torch
from torch import nn

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.cut_layers import suggest_layers

IMAGE = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(0))


def net() -> nn.Sequential:
    """A front to 1/4 of the image's size, then two layers to 1/2."""
    torch.manual_seed(0)
    layers = {
        # 16 channels at 1/4 of the size are as many numbers as the prediction has.
        "front": nn.Conv2d(3, 16, 3, stride=4, padding=1),
        "squash": nn.Sigmoid(),
        "middle": nn.Conv2d(16, 4, 3, padding=1),
        "relu": nn.ReLU(inplace=True),
        "up": nn.ConvTranspose2d(4, 4, 4, stride=2, padding=1),
        "head": nn.ConvTranspose2d(4, 1, 4, stride=2, padding=1),
    }
    return nn.Sequential(OrderedDict(layers)).requires_grad_(False)  # as networks are loaded


def layers_of(network: nn.Module) -> tuple[str, ...]:
    return suggest_layers(network, (IMAGE,), lambda output: output)


def test_the_last_layer_of_each_resolution_that_runs_once_is_listed() -> None:
    network = net()
    assert layers_of(network) == ("relu", "up")
    network.relu = network.squash = nn.ReLU(inplace=True)
    assert layers_of(network) == ("middle", "up")


def test_a_front_without_gradient_is_reported() -> None:
    network = net()
    network[0].forward = torch.no_grad()(network[0].forward)  # type: ignore[method-assign]
    with pytest.raises(ModelError):
        layers_of(network)
