"""Two full-size networks with random weights, each also cut by hand at the paper's kind of layer.

`front` and `rear` are what an author would write for this one layer: the limit for a cut that
works on any network at any layer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.registry import find_definition


class ResidualBlock(nn.Module):
    """ResNet's basic block (He et al. 2016)."""

    def __init__(self, channels: int, out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, out, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(out)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(out, out, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(out)
        self.downsample: nn.Module | None = None
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out)
            )

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn2(self.conv2(self.relu(self.bn1(self.conv1(x)))))
        y += x if self.downsample is None else self.downsample(x)
        return self.relu(y)


class ResNetEncoderDecoder(nn.Module):
    """ResNet-18, 1×1 bottleneck, four transposed convolutions: the shape of Ma & Karaman 2018."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(4, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        widths = (64, 64, 128, 256, 512)
        for index in range(1, 5):
            stride = 1 if index == 1 else 2
            block = nn.Sequential(
                ResidualBlock(widths[index - 1], widths[index], stride),
                ResidualBlock(widths[index], widths[index], 1),
            )
            self.add_module(f"layer{index}", block)
        self.conv2 = nn.Conv2d(512, 256, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(256)
        ups: list[nn.Module] = []
        for c in (256, 128, 64, 32):
            ups += [
                nn.ConvTranspose2d(c, c // 2, 3, 2, 1, output_padding=1, bias=False),
                nn.BatchNorm2d(c // 2),
                nn.ReLU(inplace=True),
            ]
        self.decoder = nn.Sequential(*ups)
        self.conv3 = nn.Conv2d(16, 1, 3, padding=1, bias=False)

    def front(self, x: Tensor) -> Any:
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        for index in range(1, 5):
            x = getattr(self, f"layer{index}")(x)
        return self.bn2(self.conv2(x)), ()

    def rear(self, z: Tensor, kept: Any) -> Tensor:
        y = self.conv3(self.decoder(z))
        return F.interpolate(y, (228, 304), mode="bilinear", align_corners=True)

    def forward(self, x: Tensor) -> Tensor:
        return self.rear(*self.front(x))


class TransformerBlock(nn.Module):
    """A pre-norm ViT block, 384 wide with 6 heads (ViT-S)."""

    def __init__(self) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(384), nn.LayerNorm(384)
        self.qkv, self.proj = nn.Linear(384, 1152), nn.Linear(384, 384)
        self.mlp = nn.Sequential(nn.Linear(384, 1536), nn.GELU(), nn.Linear(1536, 384))

    def forward(self, x: Tensor) -> Tensor:
        batch, tokens, _ = x.shape
        qkv = self.qkv(self.norm1(x)).reshape(batch, tokens, 3, 6, 64).permute(2, 0, 3, 1, 4)
        y = F.scaled_dot_product_attention(*qkv).transpose(1, 2).reshape(batch, tokens, 384)
        x = x + self.proj(y)
        return x + self.mlp(self.norm2(x))


class ResidualConvUnit(nn.Module):
    """Two 3×3 convolutions with a skip, as in DPT's fusion blocks (Ranftl et al. 2021)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(64, 64, 3, padding=1) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Fusion(nn.Module):
    """DPT's fusion: add the skip, refine, enlarge, project."""

    def __init__(self) -> None:
        super().__init__()
        self.skip, self.unit = ResidualConvUnit(), ResidualConvUnit()
        self.project = nn.Conv2d(64, 64, 1)

    def forward(self, x: Tensor, skip: Tensor | None, size: tuple[int, int]) -> Tensor:
        x = self.unit(x if skip is None else x + self.skip(skip))
        return self.project(F.interpolate(x, size, mode="bilinear", align_corners=True))


class ViTDepth(nn.Module):
    """ViT-S/14 with a DPT head of 64 channels: the shape of Depth Anything V2 small."""

    def __init__(self) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, 384, 14, 14)
        self.positions = nn.Parameter(torch.randn(1, 28 * 37, 384) * 0.02)
        self.blocks = nn.ModuleList(TransformerBlock() for _ in range(12))
        widths = (48, 96, 192, 384)
        self.reassemble = nn.ModuleList(nn.Conv2d(384, width, 1) for width in widths)
        self.resize = nn.ModuleList(
            [
                nn.ConvTranspose2d(48, 48, 4, 4),
                nn.ConvTranspose2d(96, 96, 2, 2),
                nn.Identity(),
                nn.Conv2d(384, 384, 3, 2, 1),
            ]
        )
        self.narrow = nn.ModuleList(
            nn.Conv2d(width, 64, 3, padding=1, bias=False) for width in widths
        )
        self.fusions = nn.ModuleList(Fusion() for _ in range(4))
        self.head1 = nn.Conv2d(64, 32, 3, padding=1)
        self.head2 = nn.Sequential(
            nn.Conv2d(32, 32, 3, padding=1), nn.ReLU(True), nn.Conv2d(32, 1, 1), nn.ReLU(True)
        )

    def front(self, x: Tensor) -> Any:
        tokens = self.patches(x).flatten(2).transpose(1, 2) + self.positions
        maps = []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in (2, 5, 8, 11):
                level = len(maps)
                grid = tokens.transpose(1, 2).reshape(1, 384, 28, 37)
                maps.append(self.narrow[level](self.resize[level](self.reassemble[level](grid))))
        return self.fusions[0](maps[3], None, (28, 37)), maps[:3]

    def rear(self, z: Tensor, kept: Any) -> Tensor:
        y = self.fusions[1](z, kept[2], (56, 74))
        y = self.fusions[2](y, kept[1], (112, 148))
        y = self.fusions[3](y, kept[0], (224, 296))
        y = F.interpolate(self.head1(y), (392, 518), mode="bilinear", align_corners=True)
        return self.head2(y) + 1

    def forward(self, x: Tensor) -> Tensor:
        return self.rear(*self.front(x))


@dataclass(frozen=True)
class Case:
    """A network, the layer its `front` ends with, and the channels and size of its inputs.

    build None: the zoo's network of that name. front(network, *inputs) gives z and what `rear`
    needs beside it, rear(network, z, kept) what the network gives. Inputs are in 0..1; one of one
    channel is sparse depth.
    """

    name: str
    layer: str
    channels: tuple[int, ...]
    size: tuple[int, int]
    front: Callable[..., Any] = lambda network, *inputs: network.front(*inputs)
    rear: Callable[..., Tensor] = lambda network, z, kept: network.rear(z, kept)
    build: Callable[[], nn.Module] | None = None

    def network(self) -> nn.Module:
        """It, with random weights, in eval mode."""
        build = self.build or find_definition(self.name).build
        return build().eval().requires_grad_(False)


CASES = (
    Case("ResNet-18 encoder–decoder", "bn2", (4,), (228, 304), build=ResNetEncoderDecoder),
    Case("ViT-S + DPT head", "fusions.0", (3,), (392, 518), build=ViTDepth),
)
