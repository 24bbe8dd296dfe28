"""Normalised convolutions for depth completion (Eldesokey, Felsberg & Khan, BMVC 2018; PAMI 2019).

Every layer maps depth and its confidence: the weighted sum of depth × confidence is divided by the
weighted sum of confidence, so that unknown pixels have no weight. 481 parameters, trained on KITTI,
sparse depth only. Published checkpoints load; no weights ship.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Settings

_TINY = 1e-20
"""Added to the sum of the confidences, which is 0 far from any point; as published."""


class NormalisedConv(nn.Module):
    """A convolution of depth that weighs each pixel by its confidence, plus a bias."""

    def __init__(self, channels: int, out: int, kernel: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(out, channels, kernel, kernel))
        self.bias = nn.Parameter(torch.zeros(out))

    def positive_weight(self) -> Tensor:
        """Returns the weights of the sums, none of them negative."""
        return self.weight

    def forward(self, depth: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
        """Returns depth and confidence (1, out, h, w) from both as (1, channels, h, w).

        The new confidence is the weighted mean of the old one.
        """
        weight = self.positive_weight()
        padding = weight.shape[-1] // 2
        total = F.conv2d(confidence, weight, padding=padding)
        depth = F.conv2d(depth * confidence, weight, padding=padding) / (total + _TINY)
        confidence = total / weight.sum(dim=(1, 2, 3)).reshape(1, -1, 1, 1)
        return depth + self.bias.reshape(1, -1, 1, 1), confidence


class NormalisedUNet(nn.Module):
    """U-Net at full, 1/2, 1/4 and 1/8 size; the encoder levels use the same weights.

    Args:
        layer: Class of the convolutions.
        channels: Channels inside the network.
    """

    def __init__(self, layer: type[NormalisedConv] = NormalisedConv, channels: int = 2) -> None:
        super().__init__()
        self.nconv1 = layer(1, channels, 5)
        self.nconv2 = layer(channels, channels, 5)
        self.nconv3 = layer(channels, channels, 5)
        self.nconv4 = layer(2 * channels, channels, 3)
        self.nconv5 = layer(2 * channels, channels, 3)
        self.nconv6 = layer(2 * channels, channels, 3)
        self.nconv7 = layer(channels, 1, 1)

    def forward(self, depth: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
        """Returns dense depth and its confidence from sparse depth and its confidence.

        All are (1, 1, H, W). Each level below is a pair of depth and confidence.
        """
        # Down.
        depth, confidence = self.nconv1(depth, confidence)
        depth, confidence = self.nconv2(depth, confidence)
        full = self.nconv3(depth, confidence)
        half = self.nconv3(*self.nconv2(*halved(*full)))
        quarter = self.nconv2(*halved(*half))
        eighth = self.nconv2(*halved(*quarter))
        # Up, with the features of each level.
        quarter = self.nconv4(*beside(quarter, eighth))
        half = self.nconv5(*beside(half, quarter))
        full = self.nconv6(*beside(half, full))  # in the other order, as published
        depth, confidence = self.nconv7(*full)
        return depth, confidence


def halved(depth: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the most confident depth of each 2×2 block, and a quarter of its confidence.

    From (1, c, h, w) to (1, c, h/2, w/2), both; each channel chooses for itself.
    """
    largest, index = F.max_pool2d(confidence, 2, return_indices=True)
    chosen = depth.flatten(2).gather(2, index.flatten(2)).reshape(largest.shape)
    return chosen, largest / 4


def beside(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Returns depth and confidence of two levels concatenated along channels, in this order.

    The pixels of the coarser level are repeated to the size of the finer one.

    Args:
        first: Depth and confidence (1, c, h, w) of one level.
        second: Depth and confidence of the other.
    """
    size = max(first[0].shape[-2:], second[0].shape[-2:])
    depth = torch.cat([F.interpolate(first[0], size), F.interpolate(second[0], size)], dim=1)
    confidence = torch.cat([F.interpolate(first[1], size), F.interpolate(second[1], size)], dim=1)
    return depth, confidence


class NConv(NormalisedUNet):
    """Sparse depth (1, 1, H, W) in metres, 0 = unknown → depth (1, 1, H, W)."""

    def forward(self, sparse: Tensor) -> Tensor:  # type: ignore[override]
        """Returns depth (1, 1, H, W) from sparse depth, of confidence 1 where it is known."""
        depth, _confidence = super().forward(sparse, (sparse > 0).to(sparse))
        return depth


definitions = {
    "nconv": ModelDefinition(
        name="nconv",
        summary="normalised convolutions, 481 parameters, outdoor depth completion",
        paper="Eldesokey et al., Confidence Propagation through CNNs, PAMI 2019",
        licence="published weights: GPL-3.0, not shipped",
        input_kind="sparse",
        size=Multiple(8),
        build=NConv,
        layers=("nconv1[0]", "nconv2#1[0]", "nconv6[0]"),
        defaults=Settings(),
    )
}
