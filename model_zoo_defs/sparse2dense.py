"""Sparse-to-dense (Ma & Karaman, ICRA 2018): a ResNet encoder on rgb and sparse depth, a decoder.

Input: rgb in 0…1 and sparse depth in metres (0 = unknown), concatenated to four channels. The
encoder goes down to 1/32, a 1×1 convolution with batch norm halves its channels (the paper's z: no
ReLU follows), four up-projections go up to 1/2, and a bilinear resize (corners aligned) gives depth
in metres at the size of the input; it may be negative.

The authors trained at 228×304 (NYU, ResNet-50) and 228×912 (KITTI, ResNet-18). They crop 228×912
from a frame without resizing it; so do `batch` and `eval` with KITTI folders, while `refine`
shrinks a whole frame until its columns fit, which costs metric scale. Written from the published
description of fangchangma/sparse-to-dense.pytorch; parameter names are the same, torchvision's for
the ResNet (He et al., CVPR 2016). That repository names no licence for its weights, so none ship.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Settings

BLOCKS = {18: (2, 2, 2, 2), 50: (3, 4, 6, 3)}
"""Number of blocks of each stage, by the layers of the ResNet."""
WIDTH = 64
"""Channels of the first stage, as published."""


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
        """Returns the block's output; it is added to a projection of x if their shapes differ."""
        added = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)) + added)


class Bottleneck(nn.Module):
    """1×1, 3×3, 1×1 convolutions plus the identity; the 3×3 one has the stride.

    (B, c, h, w) → (B, 4·width, h/stride, w/stride).
    """

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
        """Returns the block's output; it is added to a projection of x if their shapes differ."""
        added = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        x = F.relu(self.bn2(self.conv2(x)))
        return F.relu(self.bn3(self.conv3(x)) + added)


def shortcut(channels: int, out: int, stride: int) -> nn.Sequential | None:
    """Returns a projection of a block's input to its output's shape; None if they are the same.

    Args:
        channels: Channels of the input.
        out: Channels of the output.
        stride: Stride of the block.
    """
    if stride == 1 and channels == out:
        return None
    return nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out))


def stages(depth: int, width: int = WIDTH) -> tuple[list[nn.Sequential], int]:
    """Returns the four stages of a ResNet at 1/4, 1/8, 1/16, 1/32, and the last one's channels.

    Args:
        depth: Number of layers of the ResNet, 18 or 50.
        width: Channels of the first stage's input, and inside its blocks.
    """
    block_class = Bottleneck if depth >= 50 else BasicBlock
    channels = width
    built_stages = []
    for stage, count in enumerate(BLOCKS[depth]):
        inner = width * 2**stage
        blocks = []
        for number in range(count):
            # The first block of a stage halves the size, but for the first stage.
            stride = 2 if stage > 0 and number == 0 else 1
            blocks.append(block_class(channels, inner, stride))
            channels = inner * block_class.expansion
        built_stages.append(nn.Sequential(*blocks))
    return built_stages, channels


class Unpooled(nn.Conv2d):
    """A 5×5 convolution of the input with zeros between its pixels: (B, c, h, w) → 2h × 2w.

    Pixel (i, j) moves to (2i, 2j), the others are 0. Computed as the equal transposed convolution,
    which does not multiply those zeros.
    """

    def __init__(self, channels: int, out: int) -> None:
        super().__init__(channels, out, 5, padding=2, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, out, 2h, 2w) from (B, channels, h, w)."""
        flipped = self.weight.flip(2, 3).transpose(0, 1)
        return F.conv_transpose2d(x, flipped, stride=2, padding=2, output_padding=1)


class UpProjection(nn.Module):
    """(B, channels, h, w) → (B, channels / 2, 2h, 2w) (Laina et al.).

    A branch of two convolutions plus one of one, both on the unpooled input.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        out = channels // 2
        self.upper_branch = nn.Sequential(
            OrderedDict(
                conv1=Unpooled(channels, out),
                batchnorm1=nn.BatchNorm2d(out),
                relu=nn.ReLU(),
                conv2=nn.Conv2d(out, out, 3, padding=1, bias=False),
                batchnorm2=nn.BatchNorm2d(out),
            )
        )
        self.bottom_branch = nn.Sequential(
            OrderedDict(conv=Unpooled(channels, out), batchnorm=nn.BatchNorm2d(out))
        )

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, channels / 2, 2h, 2w) from (B, channels, h, w)."""
        return F.relu(self.upper_branch(x) + self.bottom_branch(x))


class SparseToDense(nn.Module):
    """Depth (B, 1, H, W) in metres from rgb (B, 3, H, W) and sparse depth (B, 1, H, W).

    Args:
        depth: Layers of the ResNet encoder, 18 or 50.
        width: Channels of the first stage, 64 as published.
    """

    def __init__(self, depth: int = 50, width: int = WIDTH) -> None:
        super().__init__()
        # ResNet on image and sparse depth, down to 1/32.
        self.conv1 = nn.Conv2d(4, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU()
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        (self.layer1, self.layer2, self.layer3, self.layer4), channels = stages(depth, width)
        # Half the channels, and half of those with each up-projection.
        self.conv2 = nn.Conv2d(channels, channels // 2, 1, bias=False)
        channels //= 2
        self.bn2 = nn.BatchNorm2d(channels)
        up_projections = OrderedDict[str, nn.Module]()
        for number in range(1, 5):
            up_projections[f"layer{number}"] = UpProjection(channels)
            channels //= 2
        self.decoder = nn.Sequential(up_projections)
        self.conv3 = nn.Conv2d(channels, 1, 3, padding=1, bias=False)

    def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
        """Returns depth (B, 1, H, W) from image (B, 3, H, W) and sparse depth; in metres."""
        x = torch.cat([rgb, sparse], dim=1)
        size = x.shape[-2:]
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        x = self.conv3(self.decoder(self.bn2(self.conv2(x))))
        return F.interpolate(x, size, mode="bilinear", align_corners=True)


# Sizes that the authors trained at.
NYU = Fixed(228, 304)
KITTI = Fixed(228, 912, "crop")

_NYU = ModelDefinition(
    name="sparse2dense",
    summary="ResNet-50 with up-projections, metres, NYU size",
    paper="Ma & Karaman, Sparse-to-Dense, ICRA 2018",
    licence="published weights: no licence named, not shipped",
    input_kind="rgb+sparse",
    size=NYU,
    build=SparseToDense,
    layers=("bn2", "decoder.layer1", "decoder.layer2", "decoder.layer3"),
    defaults=Settings(),
)
_KITTI = replace(
    _NYU,
    name="sparse2dense-kitti",
    summary="ResNet-18 with up-projections, metres, KITTI size",
    size=KITTI,
    build=partial(SparseToDense, 18),
)


def tiny(name: str, scenes: str, size: Fixed) -> ModelDefinition:
    """Returns the definition of a small edition that ships.

    Args:
        name: Name of the network, and of its file of weights.
        scenes: Scenes that it was trained on, for the summary.
        size: Image size that it takes.
    """
    return replace(
        _NYU,
        name=name,
        summary=f"ResNet-18 at a quarter of its width, trained on rendered {scenes}",
        licence="Apache-2.0",
        size=size,
        build=partial(SparseToDense, 18, 16),
        defaults=Settings(layer="bn2", lr="3%"),  # for 500 points
        checkpoint=Path(__file__).parent / "weights" / f"{name}.safetensors",
    )


definitions = {
    definition.name: definition
    for definition in (
        _NYU,
        _KITTI,
        tiny("sparse2dense-tiny", "rooms", NYU),
        tiny("sparse2dense-tiny-kitti", "streets", KITTI),
    )
}
