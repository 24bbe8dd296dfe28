"""nconv, pncnn, sparseconv and latefusion: equations, published errors, sizes and ranges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from benchmarks.frames import kitti_dc
from model_zoo_defs.latefusion import Encoder
from model_zoo_defs.nconv import NConv
from model_zoo_defs.pncnn import Pncnn
from model_zoo_defs.sparseconv import SparseConv
from pnpdepth_cli.measures import score
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import load_network


@pytest.mark.parametrize(("network", "fraction"), [(NConv, 0.3), (Pncnn, 1.0)])
def test_a_constant_depth_stays_in_a_network(network: type[nn.Module], fraction: float) -> None:
    known = torch.rand(1, 1, 32, 48, generator=torch.Generator().manual_seed(0)) < fraction
    with torch.no_grad():
        depth = network().eval()(7.0 * known)
    assert torch.allclose(depth, torch.full((1, 1, 32, 48), 7.0), atol=1e-3)


@pytest.mark.parametrize(
    ("name", "weights", "mae", "rmse"),
    [
        ("pncnn", "pncnn/kitti_model_best.pth.tar", 0.204, 0.688),
        ("nconv", "nconv/CNN_ep0003.pth.tar", 0.29, 1.10),
    ],
)
def test_published_weights_give_about_the_published_errors_on_kitti(
    shared_data: Path, name: str, weights: str, mae: float, rmse: float
) -> None:
    network = load_network(name, shared_data / "weights" / weights)
    frame = next(iter(kitti_dc(shared_data)))
    points = frame.points(None).tensors()
    fit = FrameMap.fit(network.definition.size, *frame.gt.shape)
    with torch.no_grad():
        output = network.module(*network.arguments_of(None, fit.points_to_network(points)))
    scores = score(fit.depth_to_image(network.depth_of(output)), torch.from_numpy(frame.gt))
    assert scores["mae"] == pytest.approx(mae, rel=0.1)
    assert scores["rmse"] == pytest.approx(rmse, rel=0.1)


def looped(x: Tensor, mask: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A sparse convolution pixel by pixel: (c, h, w), (h, w) → (n, h, w)."""
    (out, channels, kernel, _), (height, width) = weight.shape, mask.shape
    result = torch.zeros(out, height, width)
    reach = kernel // 2
    for i, j in np.ndindex(height, width):
        total = torch.zeros(out)
        count = 0
        for di, dj in np.ndindex(kernel, kernel):
            a, b = i + di - reach, j + dj - reach
            if 0 <= a < height and 0 <= b < width and mask[a, b]:
                total += weight[:, :, di, dj] @ x[:, a, b]
                count += channels
        result[:, i, j] = total / max(count, 1) + bias
    return result


@pytest.mark.parametrize("kernel", [3, 5])
def test_a_sparse_layer_is_the_sum_over_known_pixels_over_their_number(kernel: int) -> None:
    torch.manual_seed(0)
    layer = SparseConv(3, 4, kernel).requires_grad_(False)
    layer.bias.normal_()
    x = torch.randn(1, 3, 9, 11)
    mask = (torch.rand(1, 1, 9, 11) < 0.05).float()
    features, grown = layer(x, mask)
    expected = looped(x[0], mask[0, 0], layer.conv.weight, layer.bias)
    torch.testing.assert_close(features[0], expected)
    assert torch.equal(grown, nn.functional.max_pool2d(mask, kernel, 1, kernel // 2))
    assert 0 < float(grown.mean()) < 1


def test_an_encoder_of_latefusion_has_as_many_values_as_nasnet_mobile() -> None:
    """Keras counts 4,232,978 without the classifier; the stem has a bias here, no batch norm."""
    with torch.device("meta"):
        encoder = Encoder(3, 44, 4)
    assert sum(p.numel() for p in encoder.parameters()) == 4_232_978 - 2 * 32 + 32
    assert encoder.channels[-1] == 1056
