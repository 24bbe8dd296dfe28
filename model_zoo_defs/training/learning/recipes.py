"""Training recipes of the tiny editions: losses, stages and initial weights.

RECIPES["fcrn-tiny"].stage(0.4)  # after 40 % of the run
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

NEAREST = 0.1  # metres; below this the logarithm is continued by its tangent


def smooth_log(depth: Tensor) -> Tensor:
    """Returns log(depth), below `NEAREST` its tangent, so that negative predictions count."""
    above = depth.clamp(min=NEAREST)
    return torch.log(above) + (depth - above) / NEAREST


def log_error(depth: Tensor, ground_truth: Tensor) -> Tensor:
    """Returns the mean |log depth − log ground truth| over known pixels; metres, 0 = unknown."""
    known = ground_truth > 0
    return (smooth_log(depth[known]) - torch.log(ground_truth[known])).abs().mean()


def log_error_up_to_scale(depth: Tensor, ground_truth: Tensor) -> Tensor:
    """Returns `log_error` without the mean log error of each image, its scale.

    A tenth of the size of that mean is added: it draws the network to give 1 at 10 m.
    """
    losses = []
    for predicted, true in zip(depth, ground_truth, strict=True):
        known = true > 0
        difference = smooth_log(predicted[known]) - torch.log(true[known] / 10.0)
        mean = difference.mean()
        losses.append((difference - mean).abs().mean() + 0.1 * mean.abs())
    return torch.stack(losses).mean()


def relative_error(depth: Tensor, ground_truth: Tensor) -> Tensor:
    """Returns the mean log of each image's MAE over its median depth.

    So near and far scenes count alike.
    """
    losses = []
    for predicted, true in zip(depth, ground_truth, strict=True):
        known = true > 0
        error = (predicted[known] - true[known]).abs().mean() / true[known].median()
        losses.append(torch.log(error + 1e-2))
    return torch.stack(losses).mean()


def inverse_error(depth: Tensor, ground_truth: Tensor) -> Tensor:
    """Returns the mean log of each image's MAE of inverse depth, times its median depth."""
    # Below `NEAREST` continued by its tangent, so that negative predictions count.
    inverse = 1.0 / depth.clamp(min=NEAREST) + (NEAREST - depth).clamp(min=0.0) / NEAREST**2
    losses = []
    for predicted, true in zip(inverse, ground_truth, strict=True):
        known = true > 0
        error = (predicted[known] - 1.0 / true[known]).abs().mean() * true[known].median()
        losses.append(torch.log(error + 1e-2))
    return torch.stack(losses).mean()


Loss = Callable[[Tensor, Tensor], Tensor]
Outputs = Callable[[Any, tuple[Tensor, ...]], list[Tensor]]


def whole(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """The output of the network."""
    return [network(*arguments)]


def pyramid(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """Returns outputs of a network at several resolutions, the finest first."""
    outputs: list[Tensor] = network.pyramid(*arguments)
    return outputs


def coarse(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """The output of the coarse half of `eigen`."""
    return [network.coarse(*arguments)]


def fine_and_coarse(network: Any, arguments: tuple[Tensor, ...]) -> list[Tensor]:
    """Returns the outputs of both halves of `eigen`, the fine one first."""
    first = network.coarse(*arguments)
    return [network.fine(*arguments, first), first]


@torch.no_grad()
def hand_coarse_depth_on(network: Any) -> None:
    """Initialises the fine half of `eigen` to pass on the coarse log depth, a channel per sign."""
    fine = network.fine
    for channel, sign in ((0, 1.0), (1, -1.0)):
        fine.conv2.weight[channel] = 0.0
        fine.conv2.weight[channel, -1, 2, 2] = sign
        fine.conv2.bias[channel] = 0.0
        fine.conv3.weight[0, channel, 2, 2] = sign


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A part of a run, until this fraction of it.

    window: (H, W) of the crops of the frames.
    shown: (h, w) the network's input image is resized to; None: the size of the window.
    outputs: function that returns the outputs compared with the ground truth.
    """

    window: tuple[int, int]
    until: float = 1.0
    shown: tuple[int, int] | None = None
    outputs: Outputs = whole


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Data, loss, initialisation and stages for the training of one network.

    quiet: endings of the names of normalisations that start at 0, the last ones of residual
        branches, so that a deep network starts out shallow.
    flat: layers that start as this constant, so that no step is lost on finding the mean.
    scaffold: layers that are normalised while they learn, in a network that has no normalisation.
    start: further initialisation of the network before the first step.
    spliced: fraction of windows that are spliced from two frames, left and right; for networks that
        overfit to rooms.
    own_start: whether the network's own initial weights are kept; otherwise He's are taken.
    dropout: dropout probability in training; the published 0.5 is too much for a narrow network.
    farthest: depth beyond these metres is unknown.
    half_precision: whether to train in bfloat16; it is neither exact enough nor faster for networks
        with depth input only and for depthwise convolutions.
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
        """The stage at this fraction of the run."""
        return next((stage for stage in self.stages if progress < stage.until), self.stages[-1])


KINECT = 10.0  # metres; windows of rooms look farther
# Rows and columns of the windows: what the paper's networks take for NYU and for KITTI, and a
# quarter of NYU's pixels.
ROOM = (228, 304)
STREET = (228, 912)
QUARTER = (114, 152)

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
        loss=relative_error, points=many_points, own_start=True, half_precision=False,
        stages=(Stage(window=(112, 152)),),
    ),
    "adnn-tiny": Recipe(
        loss=relative_error, points=many_points, own_start=True, half_precision=False,
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
