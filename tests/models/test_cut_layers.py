"""Layers to cut at: suggested by shapes and gradients, chosen for the spacing of the points."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

import pytest
import torch
from torch import nn

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.cut_layers import default_layer, suggest_layers, wanted_field
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.settings import Settings

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


def test_a_field_spans_several_gaps_between_points_and_half_the_image() -> None:
    assert wanted_field((100, 400), 100) == 120
    assert wanted_field((100, 400), 10_000) == 50


@pytest.mark.parametrize(("points", "layer"), [(20, "0"), (1536, "2"), (0, "0")])
def test_few_points_want_a_deep_layer_unless_one_is_stated(points: int, layer: str) -> None:
    torch.manual_seed(0)
    # a layer at stride 16, and one at full size whose field is 17 pixels wide
    late = nn.ConvTranspose2d(4, 4, 16, stride=16), nn.Conv2d(4, 4, 3, padding=1)
    layers = nn.Conv2d(3, 4, 16, stride=16), *late, nn.Conv2d(4, 1, 9, padding=4)
    definition = ModelDefinition(
        name="net", input_kind="rgb", size=Multiple(16), build=lambda: nn.Sequential(*layers),
        complete=True, layers=("0", "2"),
    )  # fmt: skip
    network = load_network(definition, None)
    assert default_layer(network, (32, 48), points) == layer
    for stated in ({"layers": ("2",)}, {"defaults": Settings(layer="2")}):
        definition = replace(network.definition, **stated)
        assert default_layer(replace(network, definition=definition), (32, 48), points) == "2"
