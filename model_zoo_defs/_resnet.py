"""The stages of a ResNet, with torchvision's parameter names (He et al., CVPR 2016).

Own code from the paper and the names; no weights ship.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

BLOCKS = {18: (2, 2, 2, 2), 50: (3, 4, 6, 3)}
WIDTH = 64  # channels of the first stage, as published


class BasicBlock(nn.Module):
    """Two 3×3 convolutions plus the identity; (B, c, h, w) → (B, width, h/stride, w/stride)."""

    expansion = 1

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = shortcut(channels, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        before = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)) + before)


class Bottleneck(nn.Module):
    """1×1, 3×3 (with the stride), 1×1 convolutions plus the identity; 4·width output channels."""

    expansion = 4

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = shortcut(channels, 4 * width, stride)

    def forward(self, x: Tensor) -> Tensor:
        before = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        x = F.relu(self.bn2(self.conv2(x)))
        return F.relu(self.bn3(self.conv3(x)) + before)


def shortcut(channels: int, out: int, stride: int) -> nn.Sequential | None:
    """Returns a projection of a block's input to its output's shape; None if they are the same."""
    if stride == 1 and channels == out:
        return None
    return nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out))


def stages(depth: int, width: int = WIDTH) -> tuple[list[nn.Sequential], int]:
    """Returns the four stages of a ResNet at 1/4, 1/8, 1/16, 1/32, and the last one's channels.

    Args:
        depth: Number of layers of the ResNet, 18 or 50.
        width: Input channels of the first stage.
    """
    block = Bottleneck if depth >= 50 else BasicBlock
    channels, built = width, []
    for index, count in enumerate(BLOCKS[depth]):
        inner = width * 2**index
        blocks = []
        for number in range(count):
            blocks.append(block(channels, inner, 2 if index and not number else 1))
            channels = inner * block.expansion
        built.append(nn.Sequential(*blocks))
    return built, channels
