"""Suggested layers, chosen by their shapes and gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.suggest_layers import suggest_layers

IMAGE = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(0))


class Net(nn.Module):
    """A front to 1/4 of the image's size, then two layers to 1/2, `between` amid them."""

    def __init__(self, between: Callable[[Any], Any] = lambda run: run()) -> None:
        super().__init__()
        torch.manual_seed(0)
        # 16 channels at 1/4 of the size are as many numbers as the prediction has.
        self.front = nn.Conv2d(3, 16, 3, stride=4, padding=1)
        self.middle = nn.Conv2d(16, 4, 3, padding=1)
        self.relu = nn.ReLU(inplace=True)
        self.squash = nn.Sigmoid()
        self.up = nn.ConvTranspose2d(4, 4, 4, stride=2, padding=1)
        self.head = nn.ConvTranspose2d(4, 1, 4, stride=2, padding=1)
        self.between = between
        self.requires_grad_(False)  # as networks are loaded

    def forward(self, rgb: Tensor) -> Tensor:
        z: Tensor = self.between(lambda: self.front(rgb))
        return self.head(self.up(self.relu(self.middle(self.squash(z)))))


def without(mode: Any) -> Callable[[Any], Any]:
    def run(part: Callable[[], Any]) -> Any:
        with mode():
            return part()

    return run


CUTS = {
    "no_grad": without(torch.no_grad),
    "inference_mode": without(torch.inference_mode),
    "detach": lambda run: run().detach(),
    "numpy": lambda run: torch.from_numpy(run().detach().numpy()),
}


def layers_of(network: nn.Module) -> tuple[str, ...]:
    return suggest_layers(network, (IMAGE,), lambda output: output)


def test_the_last_layer_of_each_resolution_from_the_bottleneck_on_is_listed() -> None:
    assert layers_of(Net()) == ("relu", "up")


@pytest.mark.parametrize("how", CUTS)
def test_a_front_that_gives_no_gradient_leaves_itself_and_the_layers_behind_it(how: str) -> None:
    network = Net(CUTS[how])
    assert layers_of(network) == ("relu", "up")
    assert not any(part._forward_hooks for part in network.modules())


@pytest.mark.parametrize("how", CUTS)
def test_a_forward_without_any_gradient_is_reported(how: str) -> None:
    class Whole(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = Net()

        def forward(self, rgb: Tensor) -> Any:
            return CUTS[how](lambda: self.net(rgb))

    with pytest.raises(ModelError):
        layers_of(Whole())
    network = Net()  # which ends in a layer itself
    network.forward = torch.no_grad()(network.forward)  # type: ignore[method-assign]
    with pytest.raises(ModelError):
        layers_of(network)


def test_a_layer_that_runs_twice_is_not_listed() -> None:
    network = Net(CUTS["detach"])
    network.relu = network.squash = nn.ReLU(inplace=True)
    assert layers_of(network) == ("middle", "up")


def test_what_gives_no_maps_has_no_layers_and_is_no_fault() -> None:
    assert layers_of(nn.Identity()) == ()
