"""latefusion: NASNet's own size, depth that is always depth."""

from __future__ import annotations

import pytest
import torch

from model_zoo_defs.latefusion import Encoder, definitions
from tests.model_zoo_defs.test_cuts import built


def test_an_encoder_has_as_many_values_as_nasnet_mobile() -> None:
    """Keras counts 4,232,978 without the classifier; the stem has a bias here, no batch norm."""
    with torch.device("meta"):
        encoder = Encoder(3, 44, 4)
    counted = sum(p.numel() for p in encoder.parameters())
    assert counted == 4_232_978 - 2 * 32 + 32
    assert encoder.channels[-1] == 1056


@pytest.mark.parametrize("fraction", [0.0, 0.01, 1.0])
def test_depth_is_between_0_and_200_m_whatever_the_points(fraction: float) -> None:
    network = built(definitions["latefusion-tiny"]).module
    for scale in (1.0, 1e3):
        sparse = scale * 80 * (torch.rand(1, 1, 32, 64) < fraction)
        with torch.no_grad():
            depth = network(scale * torch.randn(1, 3, 32, 64), sparse)
        assert depth.shape == (1, 1, 32, 64)
        assert 0 <= float(depth.min()) <= float(depth.max()) <= 200.01
