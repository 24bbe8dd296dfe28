"""sfmlearner: disparity within its bounds."""

from __future__ import annotations

import pytest
import torch

from model_zoo_defs.sfmlearner import definitions
from tests.model_zoo_defs.cuts import built


def test_disparity_is_inverse_depth_between_its_bounds_at_four_sizes() -> None:
    network = built(definitions["sfmlearner-tiny"])
    pyramid = network.module.pyramid(torch.randn(1, 3, 128, 416) * 50)
    assert [tuple(d.shape[-2:]) for d in pyramid] == [(128, 416), (64, 208), (32, 104), (16, 52)]
    for disparity in pyramid:
        assert float(disparity.min()) >= 0.01 - 1e-6
        assert float(disparity.max()) <= 10.01 + 1e-6
    assert float(network.depth_of(torch.full((1, 1, 2, 2), 0.01)).max()) == pytest.approx(100)
