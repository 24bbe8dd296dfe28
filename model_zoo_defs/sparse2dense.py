"""Sparse-to-dense (Ma & Karaman, ICRA 2018): a ResNet encoder on rgb and sparse depth, a decoder.

Input: rgb in 0…1 and sparse depth in metres (0 = unknown), concatenated to four channels. The
encoder goes down to 1/32, a 1×1 convolution with batch norm halves its channels (the paper's z: no
ReLU follows), four decoder layers go up to 1/2, and a bilinear resize (corners aligned) gives depth
in metres at the size of the input; it may be negative.

The authors trained at 228×304 (NYU) and 228×912 (KITTI), with each of four decoders. They crop
228×912 from a frame without resizing it; so do `batch` and `eval` with KITTI folders, while
`refine` shrinks a whole frame until its columns fit, which costs metric scale. Written from the
published description of fangchangma/sparse-to-dense.pytorch; parameter names are the same. That
repository names no licence for its weights, so none ship.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import partial
from pathlib import Path
from typing import Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs import _sparse2dense_selfsup
from model_zoo_defs._resnet import WIDTH, stages
from pnpdepth_cli.models.definition import (
    Fixed,
    InputKind,
    ModelDefinition,
    Settings,
)

Decoder = Literal["deconv2", "deconv3", "upconv", "upproj"]
DECODERS: tuple[Decoder, ...] = ("deconv2", "deconv3", "upconv", "upproj")
CHANNELS: dict[InputKind, int] = {"rgb": 3, "sparse": 1, "rgb+sparse": 4}


class Unpooled(nn.Conv2d):
    """A 5×5 convolution of the input with zeros between its pixels: (B, c, h, w) → 2h × 2w.

    Pixel (i, j) moves to (2i, 2j), the others are 0. Computed as the equal transposed convolution,
    which does not multiply those zeros.
    """

    def __init__(self, channels: int, out: int) -> None:
        super().__init__(channels, out, 5, padding=2, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        flipped = self.weight.flip(2, 3).transpose(0, 1)
        return F.conv_transpose2d(x, flipped, stride=2, padding=2, output_padding=1)


class UpProjection(nn.Module):
    """A branch of two convolutions plus one of one, both on the unpooled input (Laina et al.)."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
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
        return F.relu(self.upper_branch(x) + self.bottom_branch(x))


def decoder_layer(kind: Decoder, channels: int) -> nn.Module:
    """Returns one layer of the decoder: (B, channels, h, w) → (B, channels/2, 2h, 2w)."""
    out = channels // 2
    if kind == "upproj":
        return UpProjection(channels, out)
    if kind == "upconv":
        name, enlarge = "conv", cast(nn.Module, Unpooled(channels, out))
    else:
        kernel, more = (3, 1) if kind == "deconv3" else (2, 0)
        name, enlarge = kind, nn.ConvTranspose2d(channels, out, kernel, 2, more, more, bias=False)
    return nn.Sequential(
        OrderedDict({name: enlarge, "batchnorm": nn.BatchNorm2d(out), "relu": nn.ReLU()})
    )


class SparseToDense(nn.Module):
    """Depth (B, 1, H, W) in metres from rgb (B, 3, H, W), sparse depth (B, 1, H, W), or both.

    Args:
        depth: Layers of the ResNet encoder, 18 or 50.
        decoder: The kind of its decoder layers.
        input_kind: What its forward takes, in this order.
        width: Channels of the first stage, 64 as published.
    """

    def __init__(
        self,
        depth: int = 50,
        decoder: Decoder = "upproj",
        input_kind: InputKind = "rgb+sparse",
        width: int = WIDTH,
    ) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(CHANNELS[input_kind], width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.relu, self.maxpool = nn.ReLU(), nn.MaxPool2d(3, 2, 1)
        (self.layer1, self.layer2, self.layer3, self.layer4), channels = stages(depth, width)
        channels //= 2
        self.conv2 = nn.Conv2d(2 * channels, channels, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.decoder = nn.Sequential(
            OrderedDict(
                (f"layer{index + 1}", decoder_layer(decoder, channels >> index))
                for index in range(4)
            )
        )
        self.conv3 = nn.Conv2d(channels >> 4, 1, 3, padding=1, bias=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        x = torch.cat(inputs, dim=1)
        size = x.shape[-2:]
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        x = self.conv3(self.decoder(self.bn2(self.conv2(x))))
        return F.interpolate(x, size, mode="bilinear", align_corners=True)


SIZES = {"": Fixed(228, 304), "-kitti": Fixed(228, 912, "crop")}
TUNED = Settings(layer="bn2", lr="3%")  # of `-tiny`, for 500 points
SCENES = {"": "rendered rooms", "-kitti": "rendered streets"}
MODALITIES: dict[str, InputKind] = {"": "rgb+sparse", "-rgb": "rgb", "-d": "sparse"}
LAYERS = ("bn2", "decoder.layer1", "decoder.layer2", "decoder.layer3")
TINY = partial(SparseToDense, 18, "upproj", width=16)


def published(depth: int, decoder: Decoder, modality: str, scene: str) -> ModelDefinition:
    """Returns the definition of one published variant."""
    return ModelDefinition(
        name=f"sparse2dense-r{depth}-{decoder}{modality}{scene}",
        summary=f"ResNet-{depth} with the {decoder} decoder, {'KITTI' if scene else 'NYU'} size",
        paper="Ma & Karaman, Sparse-to-Dense, ICRA 2018",
        licence="published weights: no licence named, not shipped",
        input_kind=MODALITIES[modality],
        size=SIZES[scene],
        build=partial(SparseToDense, depth, decoder, MODALITIES[modality]),
        layers=LAYERS,
        defaults=Settings(),
    )


def tiny(scene: str) -> ModelDefinition:
    """Returns the definition of the small edition that ships, for one image size."""
    return ModelDefinition(
        name=f"sparse2dense-tiny{scene}",
        summary=f"sparse2dense-r18-upproj at a quarter of its width, trained on {SCENES[scene]}",
        paper="Ma & Karaman, Sparse-to-Dense, ICRA 2018",
        licence="Apache-2.0",
        input_kind="rgb+sparse",
        size=SIZES[scene],
        build=TINY,
        layers=LAYERS,
        defaults=TUNED,
        checkpoint=Path(__file__).parent / "weights" / f"sparse2dense-tiny{scene}.safetensors",
    )


_PUBLISHED = [
    published(depth, decoder, modality, scene)
    for depth in (18, 50)
    for decoder in DECODERS
    for modality in MODALITIES
    for scene in SIZES
]
definitions: dict[str, ModelDefinition] = {
    one.name: one
    for one in (*_PUBLISHED, _sparse2dense_selfsup.definition, *(tiny(scene) for scene in SIZES))
}
definitions["sparse2dense"] = definitions["sparse2dense-r50-upproj"]
definitions["sparse2dense-kitti"] = definitions["sparse2dense-r18-upproj-kitti"]
