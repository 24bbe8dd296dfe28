"""Every network is cut where its paper's z is, and can be cut at every layer it lists."""

from __future__ import annotations

import pytest
import torch

from pnpdepth_cli.api import load_network
from pnpdepth_cli.core.refine_z import refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.frame_map import FrameMap, synthetic_frame
from pnpdepth_cli.models.registry import find_definition
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


@pytest.mark.parametrize("name", CUTS)
def test_every_layer_can_be_cut_at_and_z_is_where_the_paper_has_it(name: str) -> None:
    torch.manual_seed(0)
    definition = find_definition(name)
    network = load_network(definition.build(), definition=definition)
    for kind, statistic in network.module.named_buffers():
        if kind.endswith("running_mean"):
            statistic.normal_(std=0.1)
        elif kind.endswith("running_var"):
            statistic.uniform_(0.5, 1.5)
    size = definition.size
    height, width = 64, 96
    if isinstance(size, Fixed) and name != "fcrn-tiny":
        height, width = size.height, size.width
    arguments = network.synthetic_arguments(FrameMap.fit(Fixed(height, width), height, width))
    _, points, _ = synthetic_frame((height, width))
    assert definition.default_layer == CUTS[name][0]
    aligned = "auto" if name == "sfmlearner-tiny" else "none"
    assert definition.default_alignment == aligned
    for layer in definition.layers:
        with torch.no_grad(), Split(network.module, layer) as split:
            z = split.front(*arguments)
            assert torch.equal(split.rear(z), network.module(*arguments))
            once = ClosedSettings(iterations=1)
            refinement = refine(split, arguments, points, once, depth_of=network.depth_of)
        assert not torch.equal(refinement.before, refinement.after)
        if layer == CUTS[name][0]:
            assert z.shape == CUTS[name][1]
            # no non-linearity behind a normalisation
            assert layer not in ("bn2", "layer1_BN") or float(z.min()) < 0
