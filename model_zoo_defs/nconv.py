"""Normalised convolutions for depth completion (Eldesokey, Felsberg & Khan, BMVC 2018; PAMI 2019).

Depth and its confidence go through together: a layer divides the weighted sum of depth × confidence
by that of the confidence, so that unknown pixels weigh nothing. 481 parameters, KITTI, sparse depth
only. No weights come with it; the published checkpoints are read.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import ModelDefinition, Multiple, RefineDefaults

_TINY = 1e-20  # as published: the sum of the confidences is 0 far from any point


class NormalisedConv(nn.Module):
    """(depth, confidence) → (depth, confidence), both (1, c, h, w)."""

    def __init__(self, channels: int, out: int, kernel: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(out, channels, kernel, kernel))
        self.bias = nn.Parameter(torch.zeros(out))

    def positive_weight(self) -> Tensor:
        """The weights of the sums, none negative."""
        return self.weight

    def forward(self, depth: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
        weight = self.positive_weight()
        padding = weight.shape[-1] // 2
        total = F.conv2d(confidence, weight, padding=padding)
        depth = F.conv2d(depth * confidence, weight, padding=padding) / (total + _TINY)
        share = total / weight.sum(dim=(1, 2, 3)).reshape(1, -1, 1, 1)
        return depth + self.bias.reshape(1, -1, 1, 1), share


class NormalisedUNet(nn.Module):
    """Three full-size layers, the same two at half, quarter and eighth size, and back up."""

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
        depth, confidence = self.nconv1(depth, confidence)
        depth, confidence = self.nconv2(depth, confidence)
        full = self.nconv3(depth, confidence)
        half = self.nconv3(*self.nconv2(*halved(*full)))
        quarter = self.nconv2(*halved(*half))
        eighth = self.nconv2(*halved(*quarter))
        quarter = self.nconv4(*beside(quarter, eighth))
        half = self.nconv5(*beside(half, quarter))
        full = self.nconv6(*beside(half, full))  # the other way round, as published
        depth, confidence = self.nconv7(*full)
        return depth, confidence


def halved(depth: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
    """Each 2×2 block's most confident element; its confidence counts a quarter, as its area."""
    kept, places = F.max_pool2d(confidence, 2, return_indices=True)
    picked = depth.flatten(2).gather(2, places.flatten(2)).reshape(kept.shape)
    return picked, kept / 4


def beside(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Both pairs of maps as channels side by side, the coarser enlarged to the finer's size."""
    size = max(first[0].shape[-2:], second[0].shape[-2:])
    depth, confidence = (
        torch.cat([F.interpolate(a, size), F.interpolate(b, size)], dim=1)
        for a, b in zip(first, second, strict=True)
    )
    return depth, confidence


class NConv(NormalisedUNet):
    """Sparse depth (1, 1, H, W) in metres, 0 = unknown → depth (1, 1, H, W)."""

    def forward(self, sparse: Tensor) -> Tensor:  # type: ignore[override]
        return super().forward(sparse, (sparse > 0).to(sparse))[0]


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
        defaults=RefineDefaults(),
    ),
}
