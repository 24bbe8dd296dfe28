"""`eigen`, a coarse and a fine network for depth from one image (Eigen et al., NIPS 2014).

The coarse network predicts log depth at about a quarter of the image's size, through two fully
connected layers; the fine network corrects it with local features. Input: rgb in 0…1, 228×304.
Output: the logarithm of depth in metres, over the whole image.

No weights are published. imran3180/depth-map-prediction trains it and writes two files,
coarse_model_N.pth and fine_model_N.pth: put both into a folder, `--checkpoint FOLDER`.

The paper of this method cuts the coarse network and does not say where. Here z is the output of its
last convolution, before the ReLU. Own code from the papers and the layers' names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

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
OUT = (55, 74)
"""Rows and columns of the output."""
DEEP = (6, 8)
"""Rows and columns of the coarse network's last feature map."""


class Coarse(nn.Module):
    """Log depth (B, 1, 55, 74) from rgb (B, 3, 228, 304).

    Args:
        channels: Channels of the five convolutions.
        hidden: Numbers between the two fully connected layers.
    """

    def __init__(self, channels: tuple[int, int, int, int, int], hidden: int) -> None:
        super().__init__()
        first, second, third, fourth, fifth = channels
        self.conv1 = nn.Conv2d(3, first, 11, stride=4)
        self.conv2 = nn.Conv2d(first, second, 5, padding=2)
        self.conv3 = nn.Conv2d(second, third, 3, padding=1)
        self.conv4 = nn.Conv2d(third, fourth, 3, padding=1)
        self.conv5 = nn.Conv2d(fourth, fifth, 3, stride=2)
        self.fc1 = nn.Linear(fifth * DEEP[0] * DEEP[1], hidden)
        self.fc2 = nn.Linear(hidden, OUT[0] * OUT[1])
        self.relu = nn.ReLU()
        self.pool = nn.MaxPool2d(2)
        self.dropout = nn.Dropout(0.5)

    def forward(self, rgb: Tensor) -> Tensor:
        """Returns coarse log depth (B, 1, h, w) from the image (B, 3, H, W)."""
        x = self.pool(self.relu(self.conv1(rgb)))
        x = self.pool(self.relu(self.conv2(x)))
        x = self.relu(self.conv4(self.relu(self.conv3(x))))
        x = self.relu(self.conv5(x)).flatten(1)
        x = self.fc2(self.dropout(self.relu(self.fc1(x))))
        log_depth: Tensor = x.reshape(-1, 1, *OUT)
        return log_depth


class Fine(nn.Module):
    """Log depth (B, 1, h, w) from rgb (B, 3, H, W) and the coarse log depth (B, 1, h, w).

    Args:
        channels: Channels inside the network, one of which is the coarse log depth.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, channels - 1, 9, stride=2)
        self.conv2 = nn.Conv2d(channels, channels, 5, padding=2)
        self.conv3 = nn.Conv2d(channels, 1, 5, padding=2)
        self.relu = nn.ReLU()
        self.pool = nn.MaxPool2d(2)

    def forward(self, rgb: Tensor, coarse: Tensor) -> Tensor:
        """Returns log depth (B, 1, h, w) from image (B, 3, H, W) and coarse one (B, 1, h, w)."""
        x = self.pool(self.relu(self.conv1(rgb)))
        x = self.relu(self.conv2(torch.cat([x, coarse], dim=1)))
        log_depth: Tensor = self.conv3(x)
        return log_depth


class Eigen(nn.Module):
    """Log depth (B, 1, 55, 74) from rgb (B, 3, 228, 304).

    Args:
        channels: Channels of the coarse network's five convolutions.
        hidden: Numbers between its two fully connected layers.
        fine: Channels of the fine network.
    """

    def __init__(
        self,
        *,
        channels: tuple[int, int, int, int, int] = (96, 256, 384, 384, 256),
        hidden: int = 4096,
        fine: int = 64,
    ) -> None:
        super().__init__()
        self.coarse = Coarse(channels, hidden)
        self.fine = Fine(fine)

    def forward(self, rgb: Tensor) -> Tensor:
        """Returns log depth (B, 1, 55, 74) from the image (B, 3, 228, 304)."""
        log_depth: Tensor = self.fine(rgb, self.coarse(rgb))
        return log_depth


def read_two_files(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the tensors of a coarse and a fine file under the names of `Eigen`.

    Args:
        state: Tensors by name, each preceded by that of its file, as in
            "coarse_model_12.conv1.weight".

    Raises:
        ValueError: One of the two files is missing, or there are two of a kind.
    """
    for layer, network in (("fc1.weight", "coarse"), ("conv3.weight", "fine")):
        if layer in state:
            raise ValueError(
                f"this is the {network} network only; name a folder with one file coarse*.pth and"
                " one fine*.pth in it"
            )
    renamed: dict[str, Tensor] = {}
    files: dict[str, str] = {}
    for name, tensor in state.items():
        file, _, own_name = name.partition(".")
        # A file of any other name keeps it, and its tensors are refused as unexpected.
        networks = (network for network in ("coarse", "fine") if file.startswith(network))
        network = next(networks, file)
        if files.setdefault(network, file) != file:
            raise ValueError(
                f"{files[network]} and {file} are both the {network} network; keep one"
            )
        renamed[f"{network}.{own_name}"] = tensor
    return renamed


LAYERS = ("coarse.conv2", "coarse.conv3", "coarse.conv4", "coarse.conv5", "coarse.fc1", "coarse")
DEFAULTS = Settings(layer="coarse.conv5")
TINY = Path(__file__).parent / "weights" / "eigen-tiny.safetensors"

_NYU = ModelDefinition(
    name="eigen",
    summary="coarse and fine network, log depth, indoors",
    paper="Eigen et al., Depth Map Prediction from a Single Image, NIPS 2014",
    licence="no published weights",
    input_kind="rgb",
    size=Fixed(*SIZE),
    output_kind="log",
    layers=LAYERS,
    defaults=DEFAULTS,
    build=Eigen,
    read_checkpoint=read_two_files,
)
_TINY = replace(
    _NYU,
    name="eigen-tiny",
    summary="the same as `eigen`, narrower, trained on rendered rooms only",
    licence="Apache-2.0",
    normalisation=Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
    defaults=replace(DEFAULTS, update="adam", lr="10%", iterations=20),
    build=partial(Eigen, channels=(40, 80, 112, 112, 64), hidden=128, fine=48),
    checkpoint=TINY,
    read_checkpoint=None,
)
definitions = {definition.name: definition for definition in (_NYU, _TINY)}
