"""What each tiny edition is shown and what is asked of it: losses, stages and starts.

RECIPES["fcrn-tiny"].stage(0.4)  # 40 per cent of the run are over
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn

from model_zoo_defs.training.learning.batches import Points, many_points, some_points
from model_zoo_defs.training.learning.scaffold import scaffolded

NEAREST = 0.1  # metres; below this a logarithm goes on as a straight line


def smooth_log(depth: Tensor) -> Tensor:
    """log(depth), and its tangent below `NEAREST`, where a network's metres may be negative."""
    above = depth.clamp(min=NEAREST)
    return torch.log(above) + (depth - above) / NEAREST


def log_error(depth: Tensor, truth: Tensor) -> Tensor:
    """Mean |log depth − log truth| where the truth is known; 0 = unknown."""
    known = truth > 0
    return (smooth_log(depth[known]) - torch.log(truth[known])).abs().mean()


def log_error_up_to_scale(depth: Tensor, truth: Tensor) -> Tensor:
    """The same once every picture's mean is taken off, which itself tends to 10 m = 1 slowly."""
    losses = []
    for one, other in zip(depth, truth, strict=True):
        known = other > 0
        difference = smooth_log(one[known]) - torch.log(other[known] / 10.0)
        mean = difference.mean()
        losses.append((difference - mean).abs().mean() + 0.1 * mean.abs())
    return torch.stack(losses).mean()


def share_of_distance(depth: Tensor, truth: Tensor) -> Tensor:
    """Log of each picture's mean error over its median depth: near and far scenes count alike."""
    losses = []
    for one, other in zip(depth, truth, strict=True):
        known = other > 0
        error = (one[known] - other[known]).abs().mean() / other[known].median()
        losses.append(torch.log(error + 1e-2))
    return torch.stack(losses).mean()


def inverse_error(depth: Tensor, truth: Tensor) -> Tensor:
    """Log of each picture's mean error of inverse depth, times its median depth."""
    inverse = 1.0 / depth.clamp(min=NEAREST) + (NEAREST - depth).clamp(min=0.0) / NEAREST**2
    losses = []
    for one, other in zip(inverse, truth, strict=True):
        known = other > 0
        error = (one[known] - 1.0 / other[known]).abs().mean() * other[known].median()
        losses.append(torch.log(error + 1e-2))
    return torch.stack(losses).mean()


Loss = Callable[[Tensor, Tensor], Tensor]
Outputs = Callable[[Any, tuple[Tensor, ...]], list[Tensor]]


def whole(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """What the network says."""
    return [network(*arguments)]


def pyramid(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """What a network says that has outputs at several sizes, the finest first."""
    found: list[Tensor] = network.pyramid(*arguments)
    return found


def coarse(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """What the coarse half of `eigen` says."""
    return [network.coarse(*arguments)]


def fine_and_coarse(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """What both halves of `eigen` say."""
    first = network.coarse(*arguments)
    return [network.fine(*arguments, first), first]


@torch.no_grad()
def hand_coarse_depth_on(network: Any) -> None:
    """The fine half of `eigen` says what the coarse one says: a channel each for log depth ± ."""
    fine = network.fine
    for channel, sign in ((0, 1.0), (1, -1.0)):
        fine.conv2.weight[channel] = 0.0
        fine.conv2.weight[channel, -1, 2, 2] = sign
        fine.conv2.bias[channel] = 0.0
        fine.conv3.weight[0, channel, 2, 2] = sign


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A part of a run, up to this share of it.

    window: (H, W) cut out of the frames.
    shown: (h, w) of the network's picture of the window, where it is not the window's own size.
    outputs: what is compared with the truth.
    """

    window: tuple[int, int]
    until: float = 1.0
    shown: tuple[int, int] | None = None
    outputs: Outputs = whole


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What a network is shown and what is asked of it.

    quiet: endings of the names of normalisations that start at 0, the last ones of residual
        branches, so that a deep network starts as a shallow one.
    flat: layers that start as this constant, so that no step is lost on finding the mean.
    scaffold: layers that are normalised while they learn, in a network that has no normalisation.
    start: what else is put in place before the first step.
    spliced: the share of windows that are put together of two frames, left and right; for networks
        that would learn rooms by heart.
    own_start: the network's own initial weights are right; otherwise He's are taken.
    dropout: the share that dropout drops in training; half, as published, is more than a narrow
        network has to spare.
    farthest: depth beyond these metres is unknown.
    half_precision: whether bfloat16 is exact enough and faster; it is neither for depth that comes
        in as numbers only and for convolutions channel by channel.
    """

    loss: Loss
    stages: tuple[Stage, ...]
    points: Points | None = None
    lr: float = 2e-3
    batch: int = 8
    quiet: tuple[str, ...] = ()
    flat: Mapping[str, float] = field(default_factory=dict)
    scaffold: tuple[str, ...] = ()
    start: Callable[[Any], None] | None = None
    spliced: float = 0.0
    dropout: float = 0.1
    own_start: bool = False
    farthest: float = math.inf
    half_precision: bool = True

    def stage(self, progress: float) -> Stage:
        """The stage at this share of the run."""
        return next((one for one in self.stages if progress < one.until), self.stages[-1])


KINECT = 10.0  # metres; windows of rooms look farther
ROOM, STREET, QUARTER = (228, 304), (228, 912), (114, 152)

# metres straight from normalised features: rooms and streets together are learnt much more slowly
WITH_POINTS = Recipe(
    loss=log_error, points=some_points, quiet=(".bn2",),
    stages=(Stage(window=QUARTER, until=0.4), Stage(window=ROOM)),
)  # fmt: skip

RECIPES = {
    # the coarse half first, as the authors did it; it is a fifth of the work
    "eigen-tiny": Recipe(
        loss=log_error, batch=16, farthest=KINECT, spliced=0.5,
        flat={"coarse.fc2": 0.75, "fine.conv3": 0.0}, start=hand_coarse_depth_on,
        scaffold=(*(f"coarse.conv{i}" for i in range(1, 6)), "coarse.fc1", "fine.conv1"),
        stages=(
            Stage(window=ROOM, until=0.9, outputs=coarse),
            Stage(window=ROOM, outputs=fine_and_coarse),
        ),
    ),
    # fewer pixels are less work and show most of what there is to learn; it keeps half the size
    "fcrn-tiny": Recipe(
        loss=log_error, batch=16, farthest=KINECT, quiet=("bn_branch2c",), spliced=0.5,
        stages=(
            Stage(window=ROOM, shown=(57, 76), until=0.2),
            Stage(window=ROOM, shown=QUARTER),
        ),
    ),
    "sfmlearner-tiny": Recipe(
        loss=log_error_up_to_scale, own_start=True, lr=1e-3,
        stages=(Stage(window=STREET, shown=(128, 416), outputs=pyramid),),
    ),
    "sparseconv-tiny": Recipe(
        loss=share_of_distance, points=many_points, own_start=True, half_precision=False,
        stages=(Stage(window=(112, 152)),),
    ),
    "adnn-tiny": Recipe(
        loss=share_of_distance, points=many_points, own_start=True, half_precision=False,
        stages=(Stage(window=(112, 152)),),
    ),
    "sparse2dense-tiny": WITH_POINTS,
    "sparse2dense-tiny-kitti": replace(
        WITH_POINTS, stages=(Stage(window=ROOM, until=0.6), Stage(window=STREET))
    ),
    "latefusion-tiny": Recipe(
        loss=inverse_error, points=some_points, own_start=True, batch=4, half_precision=False,
        stages=(Stage(window=(128, 160), until=0.7), Stage(window=(224, 288))),
    ),
}  # fmt: skip


def with_start(network: nn.Module, recipe: Recipe) -> nn.Module:
    """The network with the recipe's initial weights in it."""
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Conv2d | nn.Linear) and not recipe.own_start:
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        if isinstance(layer, nn.Dropout):
            layer.p = recipe.dropout
        if isinstance(layer, nn.BatchNorm2d) and name.endswith(recipe.quiet):
            nn.init.zeros_(layer.weight)
    for name, constant in recipe.flat.items():
        layer = network.get_submodule(name)
        assert isinstance(layer, nn.Conv2d | nn.Linear)
        assert layer.bias is not None
        nn.init.zeros_(layer.weight)
        nn.init.constant_(layer.bias, constant)
    if recipe.start is not None:
        recipe.start(network)
    return scaffolded(network, recipe.scaffold)
