"""`fcrn`, a residual network with up-projections (Laina et al., 3DV 2016), metres.

ResNet-50 down to 1/32, one convolution without a non-linearity (the paper's z), four
up-projections to about half the size. The graph is that of the authors' own code, including what
ports change: strides on the first 1×1 convolution of a stage, a bias in `conv1` and `layer1`,
TensorFlow's padding of the pooling, up-projections as four small convolutions whose outputs
interleave, and a last ReLU.

Input: rgb in 0…255, 228×304, no mean subtracted. Output: depth in metres, 128×160. The authors'
`NYU_ResNet-UpProj.npy` (iro-cp/FCRN-DepthPrediction, Simplified BSD) loads; the pickle in it is
not run. Their TensorFlow checkpoint, easier to find today, loads too:
`--checkpoint NYU_FCRN.ckpt.index`. Files of PyTorch ports do not load: their networks differ.
Own code from the paper and from what is known of that graph.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._same_padding import same_padding
from pnpdepth_cli.models.definition import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Fixed,
    ModelDefinition,
    Normalisation,
    Settings,
)

SIZE = (228, 304)
"""Rows and columns of the input."""
BLOCKS = {"res2": 3, "res3": 4, "res4": 6, "res5": 3}
"""Number of blocks of each stage of ResNet-50."""
UP_PROJECTIONS = ("layer2x", "layer4x", "layer8x", "layer16x")


def batch_norm(channels: int) -> nn.BatchNorm2d:
    """Returns a batch normalisation with the authors' epsilon."""
    return nn.BatchNorm2d(channels, eps=1e-4)


class MaxPoolSame(nn.Module):
    """3×3 max pooling at stride 2 with TensorFlow's SAME padding."""

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, c, ⌈h/2⌉, ⌈w/2⌉) from (B, c, h, w)."""
        rows, columns = (same_padding(length, 3, 2) for length in x.shape[-2:])
        return F.max_pool2d(F.pad(x, (*columns, *rows), value=-torch.inf), 3, 2)


class Bottleneck(nn.Module):
    """A block of ResNet-50: convolutions 1×1 (with the stride), 3×3, 1×1, added to its input.

    Args:
        channels: Channels of the input.
        middle: Channels of the 3×3 convolution; the output has four times as many.
        stride: Stride of the first convolution.
        project: Whether the sum is with a 1×1 projection of the input, as its shape is another.
    """

    def __init__(self, channels: int, middle: int, stride: int, *, project: bool) -> None:
        super().__init__()
        out = 4 * middle
        self.branch2a = nn.Conv2d(channels, middle, 1, stride=stride, bias=False)
        self.bn_branch2a = batch_norm(middle)
        self.branch2b = nn.Conv2d(middle, middle, 3, padding=1, bias=False)
        self.bn_branch2b = batch_norm(middle)
        self.branch2c = nn.Conv2d(middle, out, 1, bias=False)
        self.bn_branch2c = batch_norm(out)
        self.branch1 = nn.Conv2d(channels, out, 1, stride=stride, bias=False) if project else None
        self.bn_branch1 = batch_norm(out) if project else None

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, 4·middle, h/stride, w/stride) from (B, channels, h, w)."""
        y = F.relu(self.bn_branch2a(self.branch2a(x)))
        y = F.relu(self.bn_branch2b(self.branch2b(y)))
        y = self.bn_branch2c(self.branch2c(y))
        if self.branch1 is not None and self.bn_branch1 is not None:
            x = self.bn_branch1(self.branch1(x))
        return F.relu(x + y)


class Unpooling(nn.Module):
    """Twice the size: four convolutions whose outputs interleave, each a quarter of the pixels.

    Like a 5×5 convolution of the input with zeros between its pixels, but without the zeros.
    """

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.ConvA = nn.Conv2d(channels, out, (3, 3))
        self.ConvB = nn.Conv2d(channels, out, (2, 3))
        self.ConvC = nn.Conv2d(channels, out, (3, 2))
        self.ConvD = nn.Conv2d(channels, out, (2, 2))
        self.BN = batch_norm(out)

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, out, 2h, 2w) from (B, channels, h, w)."""
        padded = F.pad(x, (1, 1, 1, 1))
        # The pixels of even rows in the even columns, and of odd rows there.
        a = self.ConvA(padded)
        b = self.ConvB(padded[..., :-1, :])
        # The same in the odd columns.
        c = self.ConvC(padded[..., :-1])
        d = self.ConvD(padded[..., :-1, :-1])
        # (B, out, h, 2, w): rows a, b, a, b, … and c, d, c, d, …
        even_columns = torch.stack([a, b], dim=3)
        odd_columns = torch.stack([c, d], dim=3)
        batch, channels, height, _, width = even_columns.shape
        # (B, out, h, 2, w, 2)
        interleaved = torch.stack([even_columns, odd_columns], dim=5)
        enlarged = interleaved.reshape(batch, channels, 2 * height, 2 * width)
        normalised: Tensor = self.BN(enlarged)
        return normalised


class UpProjection(nn.Module):
    """Twice the size and half the channels: two unpoolings, one with a convolution behind it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        out = channels // 2
        self.br1 = Unpooling(channels, out)
        self.Conv = nn.Conv2d(out, out, 3, padding=1)
        self.BN = batch_norm(out)
        self.br2 = Unpooling(channels, out)

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, channels/2, 2h, 2w) from (B, channels, h, w)."""
        y = self.BN(self.Conv(F.relu(self.br1(x))))
        return F.relu(y + self.br2(x))


class FCRN(nn.Module):
    """Depth (B, 1, 128, 160) in metres from rgb (B, 3, 228, 304).

    At any other input size, the output's sides are 16 × ⌈side / 32⌉.

    Args:
        width: Channels of the first convolution, 64 as published; all others follow from it.
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        # ResNet-50 down to 1/32.
        self.conv1 = nn.Conv2d(3, width, 7, stride=2, padding=3)
        self.bn_conv1 = batch_norm(width)
        self.relu = nn.ReLU()
        self.pool = MaxPoolSame()
        channels = width
        self.trunk: list[str] = []
        for stage, (stage_name, count) in enumerate(BLOCKS.items()):
            middle = width * 2**stage
            for letter in "abcdef"[:count]:
                # The first block of a stage changes the channels and, but for the first stage,
                # halves the size.
                is_first = letter == "a"
                stride = 2 if is_first and stage > 0 else 1
                name = f"{stage_name}{letter}"
                self.add_module(name, Bottleneck(channels, middle, stride, project=is_first))
                self.trunk.append(name)
                channels = 4 * middle
        # Four up-projections, each to twice the size and half the channels.
        self.layer1 = nn.Conv2d(channels, channels // 2, 1)
        channels //= 2
        self.layer1_BN = batch_norm(channels)
        for name in UP_PROJECTIONS:
            self.add_module(name, UpProjection(channels))
            channels //= 2
        self.ConvPred = nn.Conv2d(channels, 1, 3, padding=1)
        # Untrained depth is 2 m: at 0 m the ReLU would pass no gradient.
        self.ConvPred.bias = nn.Parameter(torch.full((1,), 2.0))

    def forward(self, rgb: Tensor) -> Tensor:
        """Returns depth (B, 1, 16·⌈H/32⌉, 16·⌈W/32⌉) in metres from the image (B, 3, H, W)."""
        x = self.pool(self.relu(self.bn_conv1(self.conv1(rgb))))
        for name in self.trunk:
            x = self.get_submodule(name)(x)
        x = self.layer1_BN(self.layer1(x))
        for name in UP_PROJECTIONS:
            x = self.get_submodule(name)(x)
        return F.relu(self.ConvPred(x))


KINDS = {
    "weights": "weight",
    "biases": "bias",
    "scale": "weight",
    "offset": "bias",
    "mean": "running_mean",
    "variance": "running_var",
}
"""Torch's name for each kind of array in the authors' files."""
COUNTERS = ("global_step", "beta1_power", "beta2_power")
"""Variables of the authors' optimiser."""
PORTS = {
    "up1.conv1_1.weight": "XPFly1989/FCRN",
    "upSample.layer1.upper_branch.conv1.weight": "dontLoveBugs/FCRN_pytorch",
}
"""Ports to PyTorch whose files do not load, by a tensor that they have."""


def read_authors(state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Returns the state dict from the authors' arrays or variables.

    Args:
        state: Names such as "res2a_branch2a.weights", kernels (rows, columns, in, out); or a state
            dict of `FCRN`, which is returned as it is.

    Raises:
        ValueError: The file is of a PyTorch port.
        KeyError: An array is of no known kind.
    """
    for name, port in PORTS.items():
        if name in state:
            raise ValueError(
                f"this is of the port {port}, a different network (strides, biases, interleaving);"
                " take the authors' NYU_ResNet-UpProj.npy"
            )
    if "conv1.weights" not in state:
        return state
    renamed = {}
    for name, tensor in state.items():
        layer, _, kind = name.rpartition(".")
        if layer in state or name in COUNTERS:
            continue  # the optimiser's own, such as conv1.weights.Momentum
        if kind not in KINDS:
            raise KeyError(f"{name} is none of {', '.join(KINDS)}")
        if kind == "weights":
            tensor = tensor.permute(3, 2, 0, 1)  # torch's order is (out, in, rows, columns)
        renamed[f"{module_of(layer)}.{KINDS[kind]}"] = tensor
    return renamed


def module_of(layer: str) -> str:
    """Returns the submodule for an authors' name: bn2a_branch2b is res2a.bn_branch2b."""
    layer = re.sub(r"^bn(\d[a-f])_", r"res\1.bn_", layer)
    layer = re.sub(r"^(res\d[a-f])_", r"\1.", layer)
    layer = re.sub(r"^(layer\d+x)_", r"\1.", layer)
    return re.sub(r"\.(br\d)_", r".\1.", layer)


# Layers to cut at, from the image to the depth; the default is the paper's z.
LAYERS = ("res4f", "res5c", "layer1_BN", *UP_PROJECTIONS[:3])
DEFAULTS = Settings(layer="layer1_BN")
TINY = Path(__file__).parent / "weights" / "fcrn-tiny.safetensors"

_NYU = ModelDefinition(
    name="fcrn",
    summary="ResNet-50 with up-projections, metres, indoors",
    paper="Laina et al., Deeper Depth Prediction with Fully Convolutional Residual Networks,"
    " 3DV 2016",
    licence="published weights: Simplified BSD, not shipped",
    input_kind="rgb",
    size=Fixed(*SIZE),
    normalisation=Normalisation(std=(1 / 255, 1 / 255, 1 / 255)),  # 0..255 goes in
    layers=LAYERS,
    defaults=DEFAULTS,
    build=FCRN,
    read_checkpoint=read_authors,
)
_TINY = replace(
    _NYU,
    name="fcrn-tiny",
    summary="the same at a seventh of the width and half the size, trained on rendered rooms",
    licence="Apache-2.0",
    size=Fixed(SIZE[0] // 2, SIZE[1] // 2),
    normalisation=Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
    defaults=replace(DEFAULTS, update="adam", lr="10%", iterations=20),
    build=partial(FCRN, width=9),
    checkpoint=TINY,
    read_checkpoint=None,
)
definitions = {definition.name: definition for definition in (_NYU, _TINY)}
