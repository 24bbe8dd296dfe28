"""Every network is cut where its paper's z is, and can be cut at every layer it lists."""

from __future__ import annotations

import pytest

from pnpdepth_cli.models.registry import find_definition
from tests.model_zoo_defs.cuts import assert_the_cut_changes_nothing_and_a_step_does, built

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
    network = built(find_definition(name))
    assert network.definition.default_layer == CUTS[name][0]
    aligned = "auto" if name == "sfmlearner-tiny" else "none"
    assert network.definition.default_alignment == aligned
    size = (64, 96) if name == "fcrn-tiny" else None
    for layer in network.definition.layers:
        z = assert_the_cut_changes_nothing_and_a_step_does(network, layer, size)
        if layer == CUTS[name][0]:
            assert z.shape == CUTS[name][1]
            # no non-linearity behind a normalisation
            assert layer not in ("bn2", "layer1_BN") or float(z.min()) < 0
