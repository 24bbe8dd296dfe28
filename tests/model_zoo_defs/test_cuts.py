"""Every network is cut where its paper's z is, and can be cut at every layer it lists."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.api import load_network
from pnpdepth_cli.core.refine_z import refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.models.definition import Fixed, ModelDefinition
from pnpdepth_cli.models.frame_map import FrameMap, synthetic_frame
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.models.registry import find_definition
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings

CUTS = {
    "adnn": ("solve", (1, 32, 8, 12)),
    "eigen-tiny": ("coarse.conv5", (1, 64, 6, 8)),
    "fcrn-tiny": ("layer1_BN", (1, 144, 2, 3)),
    "latefusion-tiny": ("decoder.s8", (1, 32, 8, 12)),
    "sfmlearner-tiny": ("iconv5", (1, 48, 8, 26)),
    "sparse2dense-tiny": ("bn2", (1, 64, 8, 10)),
    "sparse2dense-tiny-kitti": ("bn2", (1, 64, 8, 29)),
    "sparseconv": ("sparse_convs.0[0]", (1, 16, 64, 96)),
}


class Built(NamedTuple):
    """A network with random weights and statistics, and what it is given."""

    name: str
    network: Network
    arguments: tuple[Tensor, ...]
    points: SparsePoints

    @property
    def definition(self) -> ModelDefinition:
        return self.network.definition


@pytest.fixture(scope="module", params=CUTS)
def built(request: pytest.FixtureRequest) -> Built:
    torch.manual_seed(0)
    definition = find_definition(request.param)
    network = load_network(definition.build(), definition=definition)
    for kind, statistic in network.module.named_buffers():
        if kind.endswith("running_mean"):
            statistic.normal_(std=0.1)
        elif kind.endswith("running_var"):
            statistic.uniform_(0.5, 1.5)
    size = definition.size
    height, width = 64, 96
    if isinstance(size, Fixed) and request.param != "fcrn-tiny":
        height, width = size.height, size.width
    arguments = network.synthetic_arguments(FrameMap.fit(Fixed(height, width), height, width))
    _, points, _ = synthetic_frame((height, width))
    return Built(request.param, network, tuple(arguments), points)


def test_the_default_layer_and_alignment_are_those_of_the_paper(built: Built) -> None:
    assert built.definition.default_layer == CUTS[built.name][0]
    aligned = "auto" if built.name == "sfmlearner-tiny" else "none"
    assert built.definition.default_alignment == aligned


def test_every_layer_that_is_listed_can_be_cut_at_and_moves_the_depth(built: Built) -> None:
    network = built.network
    for layer in built.definition.layers:
        with torch.no_grad(), Split(network.module, layer) as split:
            z = split.front(*built.arguments)
            assert torch.equal(split.rear(z), network.module(*built.arguments))
            once = ClosedSettings(iterations=1)
            refinement = refine(
                split, built.arguments, built.points, once, depth_of=network.depth_of
            )
        assert not torch.equal(refinement.before, refinement.after)


def test_z_is_where_the_paper_has_it(built: Built) -> None:
    layer, shape = CUTS[built.name]
    with torch.no_grad(), Split(built.network.module, layer) as split:
        z = split.front(*built.arguments)
    assert z.shape == shape
    # no non-linearity behind a normalisation
    assert layer not in ("bn2", "layer1_BN") or float(z.min()) < 0
