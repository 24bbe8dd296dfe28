"""What a forward does to a network's own tensors is undone."""

from __future__ import annotations

import torch
from torch import nn

from pnpdepth_cli.core.split import Split
from tests.completion.naive import plain
from tests.core.networks import Updating, build, image


def test_buffers_start_from_the_same_values_in_every_pass() -> None:
    network, x = build("updating"), image()
    whole = plain(network, x)
    average = network.get_buffer("average")
    with Split(network, "cut") as split, torch.no_grad():
        z = split.front(x)
        for _ in range(4):
            assert torch.equal(split.rear(z), whole)
    assert float(network.get_buffer("passes")) == 0
    assert network.get_buffer("average") is average
    assert not average.any()


def test_batch_norms_in_training_mode_keep_their_statistics() -> None:
    network, x = build("resnet").train(), image()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with Split(network, "layer2") as split, torch.no_grad():
        split.rear(split.front(x))
    assert network.training
    after = network.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


def test_a_parameter_that_the_forward_overwrites_is_put_back() -> None:
    class Clamping(Updating):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            with torch.no_grad():
                self.head.weight.clamp_(min=0)
            return super().forward(x)

    torch.manual_seed(0)
    network = Clamping()
    before = network.head.weight.detach().clone()
    with Split(network, "cut") as split, torch.no_grad():
        z = split.front(image())
        assert torch.equal(split.rear(z), split.rear(z))
        assert not torch.equal(network.head.weight, before)
    assert torch.equal(network.head.weight, before)


def test_modes_and_flags_come_back_one_by_one() -> None:
    network = nn.Sequential(nn.Linear(3, 3), nn.Dropout(), nn.Linear(3, 1))
    network[1].eval()
    network[2].bias.requires_grad_(False)
    with Split(network, "0"):
        assert not any(module.training for module in network.modules())
    assert [module.training for module in network.modules()] == [True, True, False, True]
    assert [p.requires_grad for p in network.parameters()] == [True, True, True, False]
