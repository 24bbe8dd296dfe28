"""sfmlearner: the published layout loads, the wiring is the published one, the bottleneck is z."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from model_zoo_defs.sfmlearner import definitions
from pnpdepth_cli.models.network import load_network
from tests.model_zoo_defs.cuts import built
from tests.model_zoo_defs.test_published import by_formula

# (kernel, channels in, channels out) of dispnet_model_best.pth.tar
DOWN = [(7, 3, 32), (5, 32, 64), (3, 64, 128), (3, 128, 256), (3, 256, 512), (3, 512, 512)]
DOWN += [(3, 512, 512)]
UP = {7: (512, 512), 6: (512, 512), 5: (512, 256), 4: (256, 128), 3: (128, 64), 2: (64, 32)}
UP |= {1: (32, 16)}
JOINED = {7: (1024, 512), 6: (1024, 512), 5: (512, 256), 4: (256, 128), 3: (129, 64), 2: (65, 32)}
JOINED |= {1: (17, 16)}


def test_the_input_range_is_minus_one_to_one() -> None:
    """The published weights were trained so, not with ImageNet's mean and deviation."""
    for name in ("sfmlearner", "sfmlearner-tiny"):
        normalisation = definitions[name].normalisation
        assert normalisation is not None
        for mean, std in zip(normalisation.mean, normalisation.std, strict=True):
            assert [(value - mean) / std for value in (0.0, 0.5, 1.0)] == [-1.0, 0.0, 1.0]


def test_disparity_is_inverse_depth_between_its_bounds_at_four_sizes() -> None:
    network = built(definitions["sfmlearner-tiny"])
    pyramid = network.module.pyramid(torch.randn(1, 3, 128, 416) * 50)
    assert [tuple(d.shape[-2:]) for d in pyramid] == [(128, 416), (64, 208), (32, 104), (16, 52)]
    for disparity in pyramid:
        assert float(disparity.min()) >= 0.01 - 1e-6
        assert float(disparity.max()) <= 10.01 + 1e-6
    assert float(network.depth_of(torch.full((1, 1, 2, 2), 0.01)).max()) == pytest.approx(100)


def test_the_published_file_loads_whole(tmp_path: Path) -> None:
    with torch.device("meta"):
        layout = definitions["sfmlearner"].build().state_dict()
    state = by_formula(layout)
    torch.save({"epoch": 200, "state_dict": state}, tmp_path / "dispnet_model_best.pth.tar")
    own = load_network("sfmlearner", tmp_path / "dispnet_model_best.pth.tar").module.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(own[name], tensor) for name, tensor in state.items())
