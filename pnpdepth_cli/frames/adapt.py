"""Weights that learn from the points of a sequence, without ground truth: `--adapt`.

A network that is given the points as an input fits them already. So it is asked for points that it
is not given. Half of a frame's points, m ⊂ D_s, are hidden from the input. The loss L, the mean
error of log depth, is taken at these, and Adam updates the weights θ:

    θ_{k+1} = θ_k − α·Adam(∂L(f_θ(x, D_s ∖ m_k), m_k) / ∂θ_k)

A part of the frames is for validation. The new weights are used only if the loss at hidden points
of these frames fell beyond chance. The image encoder that a definition names does not learn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.func import functional_call

from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.core.losses import MIN_DEPTH
from pnpdepth_cli.errors import DivergedError, NoPointsError, UsageError, wrap_user_errors
from pnpdepth_cli.frames.frame import Frame, is_dense
from pnpdepth_cli.frames.open_network import FEW_POINTS, PreparedFrame, encoding_once, prepare
from pnpdepth_cli.models.aligned_depth import AlignedDepth
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints

STEPS = 100
"""Updates on the frames of one sequence."""
LR = 4e-4
"""α at the first update; it falls to 0 as a cosine does."""
EPSILON = 1e-12
"""ε of Adam. It is smaller than the common 1e-8, which would suppress the small gradients."""
STEPS_A_VISIT = 4
"""Updates on a frame before the next is taken: every point is hidden twice."""
LEAST_FRAMES = 8
"""Least number of frames of a sequence; fewer teach too little."""
SIGNIFICANT = 0.05
"""Level of the one-sided paired t test over the frames for validation."""

Weights = Mapping[str, Tensor]
"""Values of parameters in float32, by name."""

Lesson = tuple[PreparedFrame, SparsePoints]
"""A frame to learn from, and its points to hide and to ask for: those that are no outliers."""


@dataclass(frozen=True, kw_only=True)
class Learnt:
    """What the weights of a network learnt from a sequence."""

    weights: Weights
    before: NDArray[np.float64]  # loss at hidden points of each frame for validation
    after: NDArray[np.float64]  # the same with these weights

    @property
    def is_better(self) -> bool:
        """Whether the loss fell beyond chance."""
        from scipy.stats import ttest_1samp

        fell = ttest_1samp(np.log(self.after / self.before), 0, alternative="less")
        return bool(self.after.mean() < self.before.mean() and fell.pvalue < SIGNIFICANT)

    def __str__(self) -> str:
        change = self.after.mean() / self.before.mean() - 1
        unsure = "" if self.is_better else " is not beyond chance"
        return f"{change:+.1%} loss at hidden points of {len(self.after)} frames{unsure}"


def too_little(count: int, first: Frame) -> str | None:
    """Returns why a sequence of so many frames, the first of which is given, teaches nothing."""
    if count < LEAST_FRAMES:
        return f"{count} frames; at least {LEAST_FRAMES} are needed"
    if is_dense(first.points):
        return "points as dense as a LiDAR's teach nothing"
    return None


def learn(
    network: Network,
    frames: Iterable[tuple[str, Frame]],
    *,
    seed: int = 0,
    on_step: Callable[[], None] = lambda: None,
) -> Learnt:
    """Returns what the weights of a network learn from the points of a sequence.

    The network itself does not change.

    Args:
        frames: Frames with their names, at least `LEAST_FRAMES`.
        seed: Random seed of the frames' order and of the hidden points.

    Raises:
        UsageError: The network takes no sparse depth.
        NoPointsError: A frame has fewer than two points.
        DivergedError: The loss is not finite.
    """
    if "sparse" not in network.definition.input_kind:
        name = network.definition.name
        raise UsageError(
            f"network {name!r} takes no sparse depth, so none can be hidden from it; adapt one that"
            " takes it"
        )
    # Some frames are for validation.
    lessons = [_lesson(network, name, frame) for name, frame in frames]
    every = max(2, min(5, len(lessons) // 3))
    validation = lessons[every - 1 :: every]
    training = [lesson for number, lesson in enumerate(lessons, 1) if number % every]
    # The loss before.
    theta = _weights_that_learn(network)
    before = _losses_of(network, validation, theta, seed)
    # All updates, a few on each frame.
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(theta.values(), LR, eps=EPSILON)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    visited = _shuffle(len(training), generator)
    for first in range(0, STEPS, STEPS_A_VISIT):
        with _open_lesson(network, training[next(visited)], generator) as loss_of:
            for step in range(first, min(first + STEPS_A_VISIT, STEPS)):
                optimiser.zero_grad()
                with torch.enable_grad():
                    loss = loss_of(theta)
                if not bool(loss.isfinite()):
                    raise DivergedError(
                        f"the loss is not finite after {step} updates of weights; use the network's"
                        " own ones, without `adapt`"
                    )
                with wrap_user_errors("the gradient of the network"):
                    loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
                schedule.step()
                on_step()
    weights = {name: value.detach() for name, value in theta.items()}
    after = _losses_of(network, validation, theta, seed)
    return Learnt(weights=weights, before=before, after=after)


@contextmanager
def weights_in_place(network: Network, weights: Weights) -> Iterator[None]:
    """Inside, the network computes with these weights; afterwards it has its own again."""
    parameters = dict(network.module.named_parameters())
    originals = {name: parameters[name].data for name in weights}
    try:
        for name, value in weights.items():
            parameters[name].data = value.to(parameters[name].dtype)
        yield
    finally:
        for name, original in originals.items():
            parameters[name].data = original


def _lesson(network: Network, name: str, frame: Frame) -> Lesson:
    """The lesson of a frame. Raises NoPointsError with fewer than two points."""
    prepared = prepare(network, frame.registered())
    points = prepared.points
    if len(points) < 2:
        raise NoPointsError(
            f"{name}: {len(points)} points; hiding some needs 2, so leave this frame out"
        )
    if len(points) >= FEW_POINTS:
        outlying = ResidualField(torch.ones(points.size), points.tensors(), None).outliers
        points = points.select(~outlying.to(points.xy.device))
    return prepared, points


@contextmanager
def _open_lesson(
    network: Network, lesson: Lesson, generator: torch.Generator
) -> Iterator[Callable[[Weights], Tensor]]:
    """Gives a function: the loss L(f_θ(x, D_s ∖ m), m) for θ, with another m at every call.

    The points are divided into two halves, and each half is hidden once before they are divided
    anew: halves that complement each other make steps that agree more.
    """
    prepared, points = lesson
    reader = AlignedDepth(network, prepared.points, network.definition.default_alignment)
    halves = _halves(len(points), generator)
    parameters = dict(network.module.named_parameters())

    def loss_of(weights: Weights) -> Tensor:
        """The loss at a half of the points, of which the network is given the other one."""
        is_hidden = next(halves).to(points.depth.device)
        shown = points.select(~is_hidden)
        hidden = points.select(is_hidden)
        values = {name: value.to(parameters[name].dtype) for name, value in weights.items()}
        arguments = tuple(tensor.clone() for tensor in prepared.arguments_for(shown))
        with wrap_user_errors("the network's forward"):
            output = functional_call(network.module, values, arguments)
        predicted = hidden.sample(reader(output))
        known = predicted.isfinite()  # unknown where the network says so, such as in the sky
        log_error = predicted[known].clamp_min(MIN_DEPTH).log() - hidden.depth[known].log()
        return log_error.abs().mean()

    with encoding_once(network, {}):
        yield loss_of


def _weights_that_learn(network: Network) -> dict[str, Tensor]:
    """θ at its start."""
    encoder = network.definition.image_encoder
    return {
        name: parameter.detach().float().clone().requires_grad_()
        for name, parameter in network.module.named_parameters()
        if parameter.is_floating_point() and not (encoder and name.startswith(f"{encoder}."))
    }


def _losses_of(
    network: Network, lessons: Sequence[Lesson], theta: Weights, seed: int
) -> NDArray[np.float64]:
    """The loss at hidden points of each frame; with a seed the same points are hidden."""
    losses: list[float] = []
    for lesson in lessons:
        generator = torch.Generator().manual_seed(seed)
        with _open_lesson(network, lesson, generator) as loss_of, torch.no_grad():
            losses.append(float(loss_of(theta)))
    return np.array(losses)


def _shuffle(count: int, generator: torch.Generator) -> Iterator[int]:
    """0 … count − 1 without end, shuffled anew when all were there."""
    while True:
        yield from torch.randperm(count, generator=generator).tolist()


def _halves(count: int, generator: torch.Generator) -> Iterator[Tensor]:
    """(count,) bool without end: a random half, then the other one."""
    while True:
        is_second = (torch.randperm(count, generator=generator) % 2).bool()
        yield ~is_second
        yield is_second
