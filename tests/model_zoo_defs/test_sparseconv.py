"""sparseconv: the sparse convolution against a loop."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from model_zoo_defs.sparseconv import SparseConv


def looped(x: Tensor, mask: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A sparse convolution pixel by pixel: (c, h, w), (h, w) → (n, h, w)."""
    (out, channels, kernel, _), (height, width) = weight.shape, mask.shape
    result, reach = torch.zeros(out, height, width), kernel // 2
    for i in range(height):
        for j in range(width):
            total, count = torch.zeros(out), 0
            for di in range(-reach, reach + 1):
                for dj in range(-reach, reach + 1):
                    a, b = i + di, j + dj
                    if 0 <= a < height and 0 <= b < width and mask[a, b]:
                        total += weight[:, :, di + reach, dj + reach] @ x[:, a, b]
                        count += channels
            result[:, i, j] = total / max(count, 1) + bias
    return result


@pytest.mark.parametrize("kernel", [3, 5])
def test_a_layer_is_the_sum_over_known_pixels_over_their_number(kernel: int) -> None:
    torch.manual_seed(0)
    layer = SparseConv(3, 4, kernel).requires_grad_(False)
    layer.bias.normal_()
    x, mask = torch.randn(1, 3, 9, 11), (torch.rand(1, 1, 9, 11) < 0.05).float()
    features, grown = layer(x, mask)
    expected = looped(x[0], mask[0, 0], layer.conv.weight, layer.bias)
    torch.testing.assert_close(features[0], expected)
    assert torch.equal(grown, torch.nn.functional.max_pool2d(mask, kernel, 1, kernel // 2))
    assert 0 < float(grown.mean()) < 1
