"""Normalised convolutions whose input confidence is learned (Eldesokey et al., CVPR 2020).

A small U-Net predicts the confidence of each sparse point; the normalised convolutions of `nconv`
complete the depth. This is the published `ncnn_conf` variant, 335,792 weights, trained on KITTI or
NYU, sparse depth only. Published checkpoints load; no weights ship.
"""

from __future__ import annotations

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


class TwoConvolutions(nn.Module):
    """3×3 convolution, batch norm, ReLU, twice."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            nn.Conv2d(channels, out, 3, padding=1),
            nn.BatchNorm2d(out),
            nn.ReLU(inplace=True),
            nn.Conv2d(out, out, 3, padding=1),
            nn.BatchNorm2d(out),
            nn.ReLU(inplace=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)  # type: ignore[no-any-return]


class Inward(nn.Module):
    """The first two convolutions."""

    def __init__(self, out: int) -> None:
        super().__init__()
        self.conv = TwoConvolutions(1, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)  # type: ignore[no-any-return]


class Down(nn.Module):
    """Half the size, two convolutions."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.mpconv = nn.Sequential(nn.MaxPool2d(2), TwoConvolutions(channels, out))

    def forward(self, x: Tensor) -> Tensor:
        return self.mpconv(x)  # type: ignore[no-any-return]


class Up(nn.Module):
    """Twice the size, concatenated with the skip of that size, two convolutions."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.conv = TwoConvolutions(channels, out)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        coarse = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=True)
        return self.conv(torch.cat([fine, coarse], dim=1))  # type: ignore[no-any-return]


class Outward(nn.Module):
    """A 1×1 convolution to one channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)  # type: ignore[no-any-return]


class ConfidenceUNet(nn.Module):
    """Sparse depth (1, 1, h, w) → confidence of each pixel in 0…1."""

    def __init__(self) -> None:
        super().__init__()
        self.inc = Inward(32)
        self.down1 = Down(32, 32)
        self.down2 = Down(32, 64)
        self.down3 = Down(64, 64)
        self.up2 = Up(128, 64)
        self.up3 = Up(96, 32)
        self.up4 = Up(64, 32)
        self.outc = Outward(32)

    def forward(self, sparse: Tensor) -> Tensor:
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
        depth: Tensor = self.nconv(sparse, self.conf_estimator(sparse))[0]
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
    ),
}
