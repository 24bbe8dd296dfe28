"""Image features: EfficientNet-Lite0."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# (channels in, out, kernel, stride, expansion, blocks) of the stages at 1/2 .. 1/32:
# EfficientNet-Lite0 without its last block and its classifier.
STAGES = {
    "s2": ((32, 16, 3, 1, 1, 1),),
    "s4": ((16, 24, 3, 2, 6, 2),),
    "s8": ((24, 40, 5, 2, 6, 2),),
    "s16": ((40, 80, 3, 2, 6, 3), (80, 112, 5, 1, 6, 3)),
    "s32": ((112, 192, 5, 2, 6, 4),),
}
ENCODER_CHANNELS = {"s2": 16, "s4": 24, "s8": 40, "s16": 112, "s32": 192}
# The pretrained features have a standard deviation of about 10.
FEATURE_SCALE = 0.1


class SamePaddedConv(nn.Conv2d):
    """A convolution padded as TensorFlow's SAME does for even sizes: the odd pixel at the end."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int = 1, groups: int = 1):
        super().__init__(channels, out, kernel, stride, padding=(kernel - 1) // 2, groups=groups)

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, out, h / stride, w / stride) from (B, channels, h, w)."""
        # A kernel with a first row and column of zeros is padded alike at both ends, without a copy
        # of x.
        weight = self.weight if self.stride == (1, 1) else F.pad(self.weight, (1, 0, 1, 0))
        return cast(Tensor, self._conv_forward(x, weight, self.bias))


class InvertedBottleneck(nn.Module):
    """An MBConv block of EfficientNet-Lite, its batch normalisation folded into the weights."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        hidden = channels * expansion
        self.expand = nn.Conv2d(channels, hidden, 1) if expansion != 1 else None
        self.depthwise = SamePaddedConv(hidden, hidden, kernel, stride, groups=hidden)
        self.project = nn.Conv2d(hidden, out, 1)
        self.adds_input = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, out, h / stride, w / stride) from (B, channels, h, w)."""
        y = x if self.expand is None else F.relu6(self.expand(x), inplace=True)
        y = cast(Tensor, self.project(F.relu6(self.depthwise(y), inplace=True)))
        return x + y if self.adds_input else y


class Encoder(nn.Module):
    """Image features at 1/2, 1/4, 1/8, 1/16 and 1/32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = SamePaddedConv(3, 32, 3, 2)
        self.stages = nn.ModuleDict(
            {level: nn.Sequential(*self._blocks(rows)) for level, rows in STAGES.items()}
        )

    @staticmethod
    def _blocks(rows: tuple[tuple[int, int, int, int, int, int], ...]) -> list[nn.Module]:
        """Returns the blocks of a level from its rows in `STAGES`; a row's first has the stride."""
        blocks: list[nn.Module] = []
        for channels, out, kernel, stride, expansion, count in rows:
            blocks.append(InvertedBottleneck(channels, out, kernel, stride, expansion))
            blocks += [InvertedBottleneck(out, out, kernel, 1, expansion) for _ in range(count - 1)]
        return blocks

    def forward(self, rgb: Tensor) -> dict[str, Tensor]:
        """Returns features (B, ENCODER_CHANNELS[level], h, w) by level, from rgb (B, 3, H, W)."""
        # Channels last is the faster layout for these convolutions, and slower for the decoder's.
        x = F.relu6(self.stem(rgb.contiguous(memory_format=torch.channels_last)), inplace=True)
        features = {}
        for level, stage in self.stages.items():
            x = stage(x)
            features[level] = (x * FEATURE_SCALE).contiguous()
        return features
