"""`sfmlearner`, a disparity network trained on video alone (Zhou et al., CVPR 2017): DispNetS.

An encoder of seven strided steps and a decoder of seven steps with skips; the last three also take
the coarser disparity. Output: 10 · sigmoid + 0.01, inverse depth up to one factor per image, which
the alignment with the points fits.

Layers, names and sizes are those of ClementPinard/SfmLearner-Pytorch, whose
`dispnet_model_best.pth.tar` ({"epoch", "state_dict"}) loads. The paper's z is the bottleneck,
512×1×4; the skips stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Normalisation, Settings

# Disparity is between FLOOR and GAIN + FLOOR, as published.
GAIN = 10.0
FLOOR = 0.01
# Levels are counted from 1: conv1 … conv7 halve the size, upconv7 … upconv1 double it.
LEVELS = range(1, 8)
DOWN = (1, 2, 4, 8, 16, 16, 16)
"""Channels of conv1 … conv7, in units of `width`."""
DOWN_KERNELS = (7, 5, 3, 3, 3, 3, 3)
"""Pixels of the kernels of conv1 … conv7."""
UP = (1, 2, 4, 8, 16, 32, 32)
"""Channels of upconv1 … upconv7, in units of half a `width`."""
PREDICTED = (1, 2, 3, 4)
"""Levels that predict a disparity; 1 is full size."""


def down(channels: int, out: int, kernel: int) -> nn.Sequential:
    """Returns a convolution at stride 2 and another: (B, channels, h, w) → (B, out, h/2, w/2)."""
    padding = (kernel - 1) // 2
    return nn.Sequential(
        nn.Conv2d(channels, out, kernel, stride=2, padding=padding),
        nn.ReLU(inplace=True),
        nn.Conv2d(out, out, kernel, padding=padding),
        nn.ReLU(inplace=True),
    )


def up(channels: int, out: int) -> nn.Sequential:
    """Returns a transposed convolution: (B, channels, h, w) → (B, out, 2h, 2w)."""
    return nn.Sequential(
        nn.ConvTranspose2d(channels, out, 3, stride=2, padding=1, output_padding=1),
        nn.ReLU(inplace=True),
    )


def joined(channels: int, out: int) -> nn.Sequential:
    """Returns a convolution of concatenated features, `channels` in all: the size stays."""
    return nn.Sequential(nn.Conv2d(channels, out, 3, padding=1), nn.ReLU(inplace=True))


def disparity(channels: int) -> nn.Sequential:
    """Returns the layers that predict the disparity of one level, in 0…1."""
    return nn.Sequential(nn.Conv2d(channels, 1, 3, padding=1), nn.Sigmoid())


def cropped(x: Tensor, like: Tensor) -> Tensor:
    """Returns the upper left part of x of the size of `like`."""
    return x[..., : like.shape[-2], : like.shape[-1]]


class DispNet(nn.Module):
    """Disparity (B, 1, H, W) from rgb (B, 3, H, W) in -1…1.

    Args:
        width: Channels of the first convolution, 32 as published; all others follow from it.
    """

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        # Channels by level.
        encoded = dict(zip(LEVELS, [width * units for units in DOWN], strict=True))
        decoded = dict(zip(LEVELS, [width * units // 2 for units in UP], strict=True))
        kernels = dict(zip(LEVELS, DOWN_KERNELS, strict=True))
        # Down, from the image.
        channels = 3
        for level in LEVELS:
            self.add_module(f"conv{level}", down(channels, encoded[level], kernels[level]))
            channels = encoded[level]
        # Up, with the encoder's features of the level, and the disparity of the coarser one.
        for level in reversed(LEVELS):
            out = decoded[level]
            skip = encoded[level - 1] if level > 1 else 0
            coarse_disparity = 1 if level < max(PREDICTED) else 0
            self.add_module(f"upconv{level}", up(channels, out))
            self.add_module(f"iconv{level}", joined(out + skip + coarse_disparity, out))
            if level in PREDICTED:
                self.add_module(f"predict_disp{level}", disparity(out))
            channels = out
        # The authors' initial weights.
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.xavier_uniform_(layer.weight)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)

    def forward(self, rgb: Tensor) -> Tensor:
        """Returns disparity (B, 1, H, W) from the image (B, 3, H, W) in -1…1."""
        return self.pyramid(rgb)[0]

    def pyramid(self, rgb: Tensor) -> list[Tensor]:
        """Returns disparities at full, 1/2, 1/4 and 1/8 size; the training loss is on all four."""
        # Down; the image counts as the features of full size.
        features = [rgb]
        for level in LEVELS:
            features.append(self.get_submodule(f"conv{level}")(features[-1]))
        x = features.pop()
        # Up.
        disparities: list[Tensor] = []
        for level in reversed(LEVELS):
            skip = features.pop()
            x = cropped(self.get_submodule(f"upconv{level}")(x), skip)
            # At full size the image gives the size only.
            joint = [x, skip] if level > 1 else [x]
            if disparities:
                enlarged = F.interpolate(disparities[-1], scale_factor=2.0, mode="bilinear")
                joint.append(cropped(enlarged, skip))
            x = self.get_submodule(f"iconv{level}")(torch.cat(joint, dim=1))
            if level in PREDICTED:
                disparities.append(GAIN * self.get_submodule(f"predict_disp{level}")(x) + FLOOR)
        return disparities[::-1]


def read_published(state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Returns the state dict as it is.

    Raises:
        ValueError: It is that of the pose network, which is published beside it.
    """
    if "pose_pred.weight" in state:
        raise ValueError("this is the pose network; the other file, dispnet_…, gives disparity")
    return state


LAYERS = ("conv7", "iconv7", "iconv6", "iconv5", "iconv4", "iconv3", "iconv2")
TINY = Path(__file__).parent / "weights" / "sfmlearner-tiny.safetensors"

_KITTI = ModelDefinition(
    name="sfmlearner",
    summary="DispNet of SfMLearner, disparity up to scale, street scenes",
    paper="Zhou et al., Unsupervised Learning of Depth and Ego-Motion from Video, CVPR 2017",
    licence="published weights: MIT, not shipped",
    input_kind="rgb",
    size=Fixed(128, 416),
    normalisation=Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5)),
    output_kind="inverse",
    output_scale="scale",
    layers=LAYERS,
    defaults=Settings(),
    build=DispNet,
    read_checkpoint=read_published,
)
_TINY = replace(
    _KITTI,
    name="sfmlearner-tiny",
    summary="the same at 6/32 of the width, trained on rendered streets only",
    licence="Apache-2.0",
    defaults=Settings(layer="iconv5", lr="10%", iterations=20),
    build=lambda: DispNet(width=6),
    checkpoint=TINY,
    read_checkpoint=None,
)
definitions = {definition.name: definition for definition in (_KITTI, _TINY)}
