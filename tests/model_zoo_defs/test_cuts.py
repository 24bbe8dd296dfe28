"""Every network is cut where its paper's z is, and can be cut at every layer it lists."""

from __future__ import annotations

import pytest

from pnpdepth_cli.models.registry import find_definition
from tests.model_zoo_defs.cuts import assert_the_cut_changes_nothing_and_a_step_does, built

CUTS = {
    "adnn": ("solve", (1, 32, 8, 12)),
    "eigen-tiny": ("coarse.conv5", (1, 64, 6, 8)),
    "fcrn": ("layer1_BN", (1, 1024, 8, 10)),
    "latefusion-tiny": ("decoder.s8", (1, 32, 8, 12)),
    "sfmlearner": ("conv7", (1, 512, 1, 4)),
    "sparse2dense-tiny": ("bn2", (1, 64, 8, 10)),
    "sparse2dense-tiny-kitti": ("bn2", (1, 64, 8, 29)),
    "sparseconv": ("sparse_convs.0[0]", (1, 16, 64, 96)),
}


@pytest.mark.parametrize("name", CUTS)
def test_z_is_where_the_paper_has_it(name: str) -> None:
    network = built(find_definition(name))
    layer, shape = CUTS[name]
    assert network.definition.default_layer == layer
    assert network.definition.default_alignment == ("auto" if name == "sfmlearner" else "none")
    z = assert_the_cut_changes_nothing_and_a_step_does(network, layer)
    assert z.shape == shape
    if layer in ("bn2", "layer1_BN"):
        assert float(z.min()) < 0  # no non-linearity behind it


NARROW = (
    *("adnn", "eigen-tiny", "fcrn-tiny", "latefusion-tiny", "sfmlearner-tiny"),
    *("sparse2dense-tiny", "sparseconv", "sparseconv-nomask"),
)


@pytest.mark.parametrize(
    ("name", "layer"), [(name, layer) for name in NARROW for layer in find_definition(name).layers]
)
def test_every_layer_can_be_cut_at_and_a_step_there_changes_depth(name: str, layer: str) -> None:
    size = (64, 96) if name == "fcrn-tiny" else None
    assert_the_cut_changes_nothing_and_a_step_does(built(find_definition(name)), layer, size)
