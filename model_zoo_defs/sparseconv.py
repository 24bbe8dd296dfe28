"""Sparsity-invariant CNN (Uhrig et al., 3DV 2017): convolutions that count known pixels only.

Input: sparse depth in metres (0 = unknown), any size. Output: dense depth in metres. Five layers
(11, 7, 5, 3, 3; 16 channels) map features and a mask of known pixels; a last 1×1 convolution gives
depth. The paper's z is the features behind the first layer; the mask is not changed.

The network is that of the published checkpoint (yxgeee/DepthComplete, MIT): a layer divides by the
number of known values over all its input channels; the last convolution takes features and mask
(17 → 1). The paper divides by the number of known pixels, and its last convolution takes the
features only. Written from the published description. Only the weights of `-tiny` ship.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Settings

KERNELS = (11, 7, 5, 3, 3)
"""Pixels of the kernels' sides, layer by layer."""
CHANNELS = 16
MIN_COUNT = 1e-5
"""What is divided by where nothing is known."""


class SparseConv(nn.Module):
    """A convolution of known pixels only, divided by how many values it saw, plus a bias."""

    def __init__(self, channels: int, out: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, padding=kernel // 2, bias=False)
        self.bias = nn.Parameter(torch.zeros(out))
        # Untrained, every layer averages its known inputs with random weights.
        self.conv.weight.data.normal_(1, 1)

    def forward(self, x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Returns features (B, out, h, w), and where they are known (B, 1, h, w).

        That is where any pixel under the kernel is.

        Args:
            x: Features (B, channels, h, w).
            mask: (B, 1, h, w), 1 where they are known, else 0.
        """
        kernel = self.conv.kernel_size[0]
        known_pixels = F.avg_pool2d(mask, kernel, 1, kernel // 2, divisor_override=1)
        count = (known_pixels * x.shape[1]).clamp_min(MIN_COUNT)
        x = self.conv(x * mask) / count + self.bias.reshape(1, -1, 1, 1)
        return x, F.max_pool2d(mask, kernel, 1, kernel // 2)


class Block(nn.Module):
    """A sparse convolution and a ReLU on its features."""

    def __init__(self, channels: int, out: int, kernel: int) -> None:
        super().__init__()
        self.sparse_conv = SparseConv(channels, out, kernel)

    def forward(self, pair: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Returns features and mask, as `SparseConv` does, from features and mask in one tuple."""
        x, mask = self.sparse_conv(*pair)
        return F.relu(x), mask


class SparseConvNet(nn.Module):
    """Sparse depth (B, 1, H, W) in metres, 0 = unknown → depth (B, 1, H, W) in metres."""

    def __init__(self) -> None:
        super().__init__()
        blocks = []
        channels = 1
        for kernel in KERNELS:
            blocks.append(Block(channels, CHANNELS, kernel))
            channels = CHANNELS
        self.sparse_convs = nn.Sequential(*blocks)
        # Untrained, the mean of the features.
        self.mask_conv = nn.Conv2d(CHANNELS + 1, 1, 1)
        self.mask_conv.weight.data[:, :CHANNELS] = 1 / CHANNELS
        self.mask_conv.bias.data.zero_()  # type: ignore[union-attr]

    def forward(self, sparse: Tensor) -> Tensor:
        """Returns depth (B, 1, H, W) from sparse depth of this shape, 0 = unknown; metres."""
        x, mask = self.sparse_convs((sparse, (sparse > 0).to(sparse)))
        return self.mask_conv(torch.cat([x, mask], 1))  # type: ignore[no-any-return]


_PORT = ModelDefinition(
    name="sparseconv",
    summary="sparsity-invariant convolutions, the mask beside the features",
    paper="Uhrig et al., Sparsity Invariant CNNs, 3DV 2017",
    licence="published weights: MIT, not shipped",
    input_kind="sparse",
    size=Multiple(1),
    build=SparseConvNet,
    layers=tuple(f"sparse_convs.{index}[0]" for index in range(len(KERNELS))),
    defaults=Settings(),
)
_TINY = replace(
    _PORT,
    name="sparseconv-tiny",
    summary="sparseconv, trained on rendered scenes",
    licence="Apache-2.0",
    defaults=Settings(layer="sparse_convs.1[0]", lr="3%", update="adam"),
    checkpoint=Path(__file__).parent / "weights" / "sparseconv-tiny.safetensors",
)
definitions = {definition.name: definition for definition in (_PORT, _TINY)}
