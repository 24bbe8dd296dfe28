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
"""Frames of a sequence from which a network learns, at least; fewer teach too little."""
SIGNIFICANT = 0.05
"""Level of the one-sided paired t test over the frames for validation."""

Weights = Mapping[str, Tensor]
"""Values of parameters in float32, by name."""

Lesson = tuple[PreparedFrame, SparsePoints]
"""A frame to learn from, and those of its points that are hidden from the network and asked for:
all that are no outliers."""

_LARGEST_PERIOD = 5
"""One frame of so many is for validation, in a long sequence."""
_LEAST_FOR_VALIDATION = 3
"""Frames for validation, at least, where a sequence has `LEAST_FRAMES`: the t test needs some."""


@dataclass(frozen=True, kw_only=True)
class Learnt:
    """Weights that learnt from a sequence, and their loss before and after."""

    weights: Weights
    """The parameters that learnt, as they are afterwards."""
    before: NDArray[np.float64]
    """(F,) loss at hidden points of each of F frames for validation, before the weights learnt."""
    after: NDArray[np.float64]
    """(F,) the same with `weights`."""

    @property
    def is_better(self) -> bool:
        """Whether the loss fell, in the mean and beyond chance, by a t test of its log ratios."""
        from scipy.stats import ttest_1samp

        test = ttest_1samp(np.log(self.after / self.before), 0, alternative="less")
        return bool(self.after.mean() < self.before.mean() and test.pvalue < SIGNIFICANT)

    def __str__(self) -> str:
        change = self.after.mean() / self.before.mean() - 1
        doubt = "" if self.is_better else " is not beyond chance"
        return f"{change:+.1%} loss at hidden points of {len(self.after)} frames{doubt}"


def reason_not_to_learn(count: int, first: Frame) -> str | None:
    """Returns why the points of a sequence teach a network nothing; None if they can teach it.

    Args:
        count: Number of frames of the sequence.
        first: Its first frame, whose points stand for those of all.
    """
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
    """Returns weights of a network that learnt from the points of a sequence, and their losses.

    Half of a frame's points are hidden from the network's input, and the loss is the mean error of
    log depth at these. The network itself does not change.

    Args:
        network: Network that takes sparse depth, not cut.
        frames: Frames with their names for messages, at least `LEAST_FRAMES`.
        seed: Random seed of the frames' order and of the hidden points.
        on_step: Function that is called after each of the `STEPS` updates.

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
    # The last of every `period` frames is for validation, the others are for training. A short
    # sequence has shorter periods, so that at least `_LEAST_FOR_VALIDATION` frames are for it; but
    # no period is shorter than 2, which leaves one of two frames for training.
    lessons = [_lesson(network, name, frame) for name, frame in frames]
    period = max(2, min(_LARGEST_PERIOD, len(lessons) // _LEAST_FOR_VALIDATION))
    validation = lessons[period - 1 :: period]
    training = [lesson for number, lesson in enumerate(lessons, 1) if number % period]
    # The loss before.
    theta = _weights_that_learn(network)
    before = _losses_of(network, validation, theta, seed)
    # The updates.
    _make_updates(network, training, theta, seed=seed, on_step=on_step)
    # The loss after.
    weights = {name: weight.detach() for name, weight in theta.items()}
    after = _losses_of(network, validation, theta, seed)
    return Learnt(weights=weights, before=before, after=after)


def _make_updates(
    network: Network,
    lessons: Sequence[Lesson],
    theta: Weights,
    *,
    seed: int,
    on_step: Callable[[], None],
) -> None:
    """Afterwards the weights theta have had `STEPS` updates, a few on each frame in turn.

    Args:
        network: The network.
        lessons: The frames to learn from, and their points of which half is hidden at each update.
        theta: Weights with gradients by name, float32, which change in place.
        seed: Random seed of the frames' order and of the hidden points.
        on_step: Function that is called after each update.

    Raises:
        DivergedError: The loss is not finite.
    """
    # Adam, its step size falling to 0.
    optimiser = torch.optim.Adam(theta.values(), LR, eps=EPSILON)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    # Visits of frames in random order, each with other points hidden at every update.
    generator = torch.Generator().manual_seed(seed)
    order = _shuffle(len(lessons), generator)
    for first_step in range(0, STEPS, STEPS_A_VISIT):  # the number of a visit's first update
        lesson = lessons[next(order)]
        with _open_lesson(network, lesson, generator) as loss_of:
            for step in range(first_step, min(first_step + STEPS_A_VISIT, STEPS)):
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


@contextmanager
def weights_in_place(network: Network, weights: Weights) -> Iterator[None]:
    """Inside, the network computes with these weights; afterwards it has its own again.

    Args:
        network: The network, whose other parameters stay.
        weights: Values of parameters by name, which are given their parameter's type.
    """
    parameters = dict(network.module.named_parameters())
    originals = {name: parameters[name].data for name in weights}
    try:
        for name, weight in weights.items():
            parameters[name].data = weight.to(parameters[name].dtype)
        yield
    finally:
        for name, original in originals.items():
            parameters[name].data = original


def _lesson(network: Network, name: str, frame: Frame) -> Lesson:
    """A frame as the network takes it, and its points to learn from, without outliers.

    Args:
        network: The network that learns.
        name: The frame's name in messages.
        frame: The frame.

    Raises:
        NoPointsError: The network sees fewer than two points.
    """
    prepared = prepare(network, frame.registered())
    points = prepared.points
    if len(points) < 2:
        raise NoPointsError(
            f"{name}: {len(points)} points; hiding some needs 2, so leave this frame out"
        )
    # Outliers are left out: points whose depth contradicts their neighbours', told by the residual
    # beside a constant depth. Of few points none is left out: an outlier may be all that is seen of
    # a small object.
    if len(points) >= FEW_POINTS:
        outlying = ResidualField(torch.ones(points.size), points.tensors(), None).outliers
        points = points.select(~outlying.to(points.xy.device))
    return prepared, points


@contextmanager
def _open_lesson(
    network: Network, lesson: Lesson, generator: torch.Generator
) -> Iterator[Callable[[Weights], Tensor]]:
    """Inside, a function of weights θ returns the loss at points that the network is not given.

    The loss is L(f_θ(x, D_s ∖ m), m), where x is the frame's image, D_s its points and m a half of
    these, another one at every call. The points are divided into two halves, and each half is
    hidden once before they are divided anew: halves that complement each other make steps that
    agree more.

    Args:
        network: The network f.
        lesson: The frame and its points.
        generator: Generator of the halves.
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
        typed_weights = {
            name: weight.to(parameters[name].dtype) for name, weight in weights.items()
        }
        arguments = tuple(tensor.clone() for tensor in prepared.arguments_for(shown))
        with wrap_user_errors("the network's forward"):
            output = functional_call(network.module, typed_weights, arguments)
        predicted = hidden.sample(reader(output))
        is_known = predicted.isfinite()  # some networks leave depth unknown, such as in the sky
        log_error = predicted[is_known].clamp_min(MIN_DEPTH).log() - hidden.depth[is_known].log()
        return log_error.abs().mean()

    with encoding_once(network, {}):  # the image encoder does not learn
        yield loss_of


def _weights_that_learn(network: Network) -> dict[str, Tensor]:
    """θ at its start: float32 copies, by name, of the parameters that learn, with gradients.

    All floating-point parameters learn but those of the image encoder that the definition names.
    """
    encoder = network.definition.image_encoder
    weights: dict[str, Tensor] = {}
    for name, parameter in network.module.named_parameters():
        is_of_encoder = encoder is not None and name.startswith(f"{encoder}.")
        if parameter.is_floating_point() and not is_of_encoder:
            weights[name] = parameter.detach().float().clone().requires_grad_()
    return weights


def _losses_of(
    network: Network, lessons: Sequence[Lesson], theta: Weights, seed: int
) -> NDArray[np.float64]:
    """(F,) the loss at hidden points of each of F frames with the weights theta.

    Args:
        network: The network.
        lessons: The frames, and their points of which half is hidden.
        theta: The weights by name.
        seed: Random seed of the hidden points: with one seed they are the same for all weights.
    """
    losses: list[float] = []
    for lesson in lessons:
        generator = torch.Generator().manual_seed(seed)
        with _open_lesson(network, lesson, generator) as loss_of, torch.no_grad():
            losses.append(float(loss_of(theta)))
    return np.array(losses)


def _shuffle(count: int, generator: torch.Generator) -> Iterator[int]:
    """Yields 0 … count − 1 without end, shuffled anew when all were there."""
    while True:
        yield from torch.randperm(count, generator=generator).tolist()


def _halves(count: int, generator: torch.Generator) -> Iterator[Tensor]:
    """Yields masks (count,) bool without end: a random half, its complement, another half, …"""
    while True:
        # The odd ones of shuffled numbers are a random half of the points.
        is_second = (torch.randperm(count, generator=generator) % 2).bool()
        yield ~is_second
        yield is_second
