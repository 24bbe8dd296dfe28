"""Normalised convolutions whose input confidence is learned (Eldesokey et al., CVPR 2020).

A small U-Net predicts the confidence of each sparse point; the normalised convolutions of `nconv`
complete the depth. This is the published `ncnn_conf` variant, 335,792 weights, trained on KITTI or
NYU, sparse depth only. Published checkpoints load; no weights ship.
"""

from __future__ import annotations

from collections import OrderedDict

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs.nconv import NormalisedConv, NormalisedUNet
from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Settings


class SoftplusNormalisedConv(NormalisedConv):
    """A normalised convolution that keeps its weights positive by a softplus."""

    def __init__(self, channels: int, out: int, kernel: int) -> None:
        super().__init__(channels, out, kernel)
        self.weight_p = self.weight
        del self.weight

    def positive_weight(self) -> Tensor:
        """Returns the weights of the sums, none of them negative."""
        return F.softplus(self.weight_p, beta=10)


def named(**layers: nn.Module) -> nn.Sequential:
    """Returns layers in a row with these names, which the published weights have."""
    return nn.Sequential(OrderedDict(layers))


def two_convolutions(channels: int, out: int) -> nn.Sequential:
    """Returns 3×3 convolution, batch norm, ReLU, twice: `channels` → `out` channels.

    They are within a layer `conv`, as in the published weights.
    """
    layers: list[nn.Module] = []
    for count in (channels, out):
        layers += [nn.Conv2d(count, out, 3, padding=1), nn.BatchNorm2d(out), nn.ReLU(inplace=True)]
    return named(conv=nn.Sequential(*layers))


def down(channels: int, out: int) -> nn.Sequential:
    """Returns a halving of the size and two convolutions: `channels` → `out` channels."""
    return named(mpconv=nn.Sequential(nn.MaxPool2d(2), two_convolutions(channels, out)))


class Up(nn.Module):
    """Twice the size, concatenated with the skip of that size, two convolutions."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.conv = two_convolutions(channels, out)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Returns (B, out, 2h, 2w) from coarse (B, c, h, w) and fine (B, d, 2h, 2w) features."""
        coarse = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=True)
        return self.conv(torch.cat([fine, coarse], dim=1))  # type: ignore[no-any-return]


class ConfidenceUNet(nn.Module):
    """Sparse depth (1, 1, h, w) → confidence of each pixel in 0…1."""

    def __init__(self) -> None:
        super().__init__()
        self.inc = named(conv=two_convolutions(1, 32))
        self.down1 = down(32, 32)
        self.down2 = down(32, 64)
        self.down3 = down(64, 64)
        self.up2 = Up(128, 64)
        self.up3 = Up(96, 32)
        self.up4 = Up(64, 32)
        self.outc = named(conv=nn.Conv2d(32, 1, 1))

    def forward(self, sparse: Tensor) -> Tensor:
        """Returns the confidence (1, 1, h, w)."""
        full = self.inc(sparse)
        half = self.down1(full)
        quarter = self.down2(half)
        x = self.down3(quarter)
        x = self.up4(self.up3(self.up2(x, quarter), half), full)
        return torch.sigmoid(self.outc(x))


class Pncnn(nn.Module):
    """Sparse depth (1, 1, H, W) in metres, 0 = unknown → depth (1, 1, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        self.conf_estimator = ConfidenceUNet()
        self.nconv = NormalisedUNet(SoftplusNormalisedConv)

    def forward(self, sparse: Tensor) -> Tensor:
        """Returns dense depth (1, 1, H, W) from sparse depth of this shape, 0 = unknown; metres."""
        depth: Tensor
        depth, _confidence = self.nconv(sparse, self.conf_estimator(sparse))
        return depth


definitions = {
    "pncnn": ModelDefinition(
        name="pncnn",
        summary="normalised convolutions with learned input confidence, depth completion",
        paper="Eldesokey et al., Uncertainty-Aware CNNs for Depth Completion, CVPR 2020",
        licence="published weights: GPL-3.0, not shipped",
        input_kind="sparse",
        size=Multiple(8),
        build=Pncnn,
        layers=("conf_estimator.down3", "conf_estimator.up4", "conf_estimator"),
        defaults=Settings(),
    )
}
