"""What every network of the zoo must stand: a cut that changes nothing, a step that does."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.refine import refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.models.definition import Fixed, ModelDefinition
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings


def built(definition: ModelDefinition) -> Network:
    """The network with random weights and random statistics of its normalisations."""
    torch.manual_seed(0)
    module = definition.build().eval().requires_grad_(False)
    for layer in module.modules():
        if isinstance(layer, nn.BatchNorm2d):
            assert layer.running_mean is not None
            assert layer.running_var is not None
            layer.running_mean.normal_(std=0.1)
            layer.running_var.uniform_(0.5, 1.5)
    return Network(
        definition=definition, module=module, device=torch.device("cpu"), checkpoint=None
    )


def size_of(network: Network) -> tuple[int, int]:
    """The image size of the test: the network's fixed size, or a small valid one."""
    size = network.definition.size
    if isinstance(size, Fixed):
        return size.height, size.width
    return -(-64 // size.of) * size.of, -(-96 // size.of) * size.of


def frame_for(network: Network, size: tuple[int, int] | None = None) -> tuple[Tensor, ...]:
    """Arguments of the network for a synthetic image, of `size_of` by default."""
    height, width = size or size_of(network)
    return network.synthetic_arguments(FrameMap.fit(Fixed(height, width), height, width))


POINTS = SparsePoints(
    xy=torch.tensor([[12.0, 9.0], [42.0, 9.0], [24.0, 18.0], [48.0, 27.0]]),
    depth=torch.tensor([1.0, 2.0, 3.0, 4.0]),
    size=(30, 60),
)


def assert_the_cut_changes_nothing_and_a_step_does(
    network: Network, layer: str, size: tuple[int, int] | None = None
) -> Tensor:
    """rear(front(x)) is f(x) to the bit, one update at the paper's setting is not; returns z."""
    arguments = frame_for(network, size)
    with torch.no_grad(), Split(network.module, layer) as split:
        z = split.front(*arguments)
        assert torch.equal(split.rear(z), network.module(*arguments))
        once = ClosedSettings(iterations=1)
        refinement = refine(split, arguments, POINTS, once, depth_of=network.depth_of)
    assert not torch.equal(refinement.before, refinement.after)
    return z
