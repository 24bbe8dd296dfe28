"""Self-supervised sparse-to-dense (Ma, Cavalheiro & Karaman, ICRA 2019): a U-Net of ResNet-34.

Input: rgb in 0…255 and sparse depth in metres (0 = unknown), each with a first layer of its own.
Four ResNet stages and one more convolution go down to 1/16, transposed convolutions with skips go
back up. Output: depth in metres, at least 0.9 (the least a Velodyne measures). The authors used the
lowest 352×1216 pixels of KITTI frames; any size in multiples of 16 works.

Written from the published description of fangchangma/self-supervised-depth-completion (MIT);
parameter names are the same. No weights ship.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._resnet import stages
from pnpdepth_cli.models.definition import (
    ModelDefinition,
    Multiple,
    Normalisation,
    Settings,
)

NEAREST = 0.9  # metres
UNIT = 100.0  # metres that an output of 1 stands for
BYTE = 1 / 255
SLOPE = 0.2


def down(channels: int, out: int, stride: int = 1) -> nn.Sequential:
    """Returns 3×3 convolution, batch norm, leaky ReLU."""
    convolution = nn.Conv2d(channels, out, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(out), nn.LeakyReLU(SLOPE))


def up(channels: int, out: int, stride: int = 2) -> nn.Sequential:
    """Returns 3×3 transposed convolution, batch norm, leaky ReLU."""
    convolution = nn.ConvTranspose2d(channels, out, 3, stride, 1, stride - 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(out), nn.LeakyReLU(SLOPE))


class SelfSupervisedSparseToDense(nn.Module):
    """Depth (B, 1, H, W) in metres from rgb (B, 3, H, W) in 0…255 and sparse (B, 1, H, W)."""

    def __init__(self, depth: int = 34) -> None:
        super().__init__()
        self.conv1_d, self.conv1_img = down(1, 16), down(3, 48)
        (self.conv2, self.conv3, self.conv4, self.conv5), channels = stages(depth)
        self.conv6 = down(channels, 512, 2)
        self.convt5, self.convt4 = up(512, 256), up(768, 128)
        self.convt3, self.convt2 = up(384, 64), up(192, 64)
        self.convt1 = up(128, 64, 1)
        self.convtf = nn.Sequential(nn.Conv2d(128, 1, 1))

    def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
        x = torch.cat([self.conv1_d(sparse), self.conv1_img(rgb)], dim=1)
        skips = [x]
        for stage in (self.conv2, self.conv3, self.conv4, self.conv5):
            skips.append(stage(skips[-1]))
        x = self.conv6(skips[-1])
        for layer in (self.convt5, self.convt4, self.convt3, self.convt2, self.convt1):
            x = torch.cat([layer(x), skips.pop()], dim=1)
        return F.relu(UNIT * self.convtf(x) - NEAREST) + NEAREST


definition = ModelDefinition(
    name="sparse2dense-selfsup",
    summary="the self-supervised U-Net of ResNet-34, KITTI",
    paper="Ma et al., Self-supervised Sparse-to-Dense, ICRA 2019",
    licence="published weights: MIT, not shipped",
    input_kind="rgb+sparse",
    size=Multiple(16),
    normalisation=Normalisation(std=(BYTE, BYTE, BYTE)),
    build=SelfSupervisedSparseToDense,
    layers=("conv6", "convt5", "convt4", "convt3", "convt2"),
    defaults=Settings(),
)
