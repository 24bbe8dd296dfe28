"""Weights that learn from the points of many frames, without ground truth.

As in `--target masked` (`core.refine`), points are hidden from the network's input and asked for;
here the weights keep what they learn, over all frames. A part of the frames is for validation: the
weights with the smallest loss at its hidden points are kept, the first among them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import ttest_1samp
from torch import Tensor

from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.masks import Masks
from pnpdepth_cli.core.split import InputSplit
from pnpdepth_cli.core.update_rules import SCHEDULES, Update, step_size
from pnpdepth_cli.core.weights import MovingWeights
from pnpdepth_cli.core.weights_refinement import FrameOfPoints
from pnpdepth_cli.errors import DivergedError, NoPointsError
from pnpdepth_cli.frames.frame import Frame, is_dense
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import opened_frame
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.settings import Settings

LR = 4e-4
"""Step size at the start."""
STEPS = 100
"""Updates on the frames of one sequence."""
LEAST_FRAMES = 8
"""Of a sequence; fewer teach too little."""
SIGNIFICANT = 0.05
"""Of the one-sided paired t test over the frames for validation."""
MOST_VALIDATED = 16
STEPS_A_VISIT = 4
"""Updates on a frame before the next is taken."""
_IN_MEMORY = 64
"""Frames that are kept in memory."""

OnStep = Callable[[int, int, str], None]
"""Called with (updates made, of, text)."""


def adaptation_settings(
    network: Network, first: Frame, *, steps: int = STEPS, lr: float = LR, seed: int = 0
) -> Settings:
    """Returns the settings of an adaptation; `iterations` are those of all frames together."""
    options = Settings(
        target="masked",
        iterations=steps,
        lr=str(lr),
        update="adam",
        schedule="cosine",
        seed=seed,
    )
    return resolve_settings(network.definition, options, dense=is_dense(first.points))


def validated_of(count: int) -> int:
    """Returns in how many frames of a sequence one is for validation."""
    return max(2, min(5, count // 3))


def too_little(count: int, first: Frame) -> str | None:
    """Returns why these frames of a sequence, the first of which is given, teach nothing."""
    if count < LEAST_FRAMES:
        return f"{count} frames; at least {LEAST_FRAMES} are needed"
    if is_dense(first.points):
        return "points as dense as a LiDAR's teach nothing"
    return None


def is_significant(p_value: float | None) -> bool:
    """Returns whether `Adaptation.p_value` says that the weights are better beyond chance."""
    return p_value is not None and p_value < SIGNIFICANT


def learnt(
    network: Network, frames: Sequence[Frame], seed: int
) -> tuple[MovingWeights | None, str]:
    """Returns weights that are better beyond chance, or None, and what was learnt.

    Args:
        network: A resolved one.
        frames: Of one sequence.

    Raises:
        UsageError: The network takes no sparse depth.
        DivergedError: The loss is not finite.
    """
    unused = "adapt: the network's own weights are used:"
    if why := too_little(len(frames), frames[0]):
        return None, f"{unused} {why}"
    adaptation = Adaptation(
        network,
        adaptation_settings(network, frames[0], seed=seed),
        {f"frame {number}": partial(_same, frame) for number, frame in enumerate(frames)},
        validated=validated_of(len(frames)),
        checks=1,
    )
    losses = adaptation.run()
    change = losses[adaptation.kept] / losses[0] - 1
    text = f"{change:+.1%} loss at hidden points of {len(adaptation.validation)} frames"
    if not is_significant(adaptation.p_value()):
        return None, f"{unused} {text} is not beyond chance"
    return adaptation.best, f"adapt: {text}"


class Adaptation:
    """An adaptation: its frames, the weights, and the best of them.

    Args:
        network: A resolved one that takes points; it does not change.
        settings: From `adaptation_settings`.
        frames: By name; each gives a frame when it is needed.
        validated: One frame in so many is for validation; of fewer frames, the last.
        checks: How often the validation frames are looked at, besides before the first update.

    Attributes:
        training: Positions of the frames that are learnt from.
        validation: Positions of the frames for validation.
        best: The weights with the smallest loss at hidden points of the validation frames.
        kept: The number of updates that made them.
    """

    def __init__(
        self,
        network: Network,
        settings: Settings,
        frames: Mapping[str, Callable[[], Frame]],
        *,
        validated: int,
        checks: int,
    ) -> None:
        self._frames = list(frames.items())
        every = list(range(len(frames)))
        validation = every[validated - 1 :: validated] or every[-1:]
        chosen = np.linspace(0, len(validation) - 1, min(MOST_VALIDATED, len(validation)))
        self.validation = [validation[round(position)] for position in chosen]
        self.training = [index for index in every if index not in set(validation)]
        self._network, self._settings, self._checks = network, settings, checks
        self._prepared = lru_cache(_IN_MEMORY)(self._prepare)
        self._generator = torch.Generator().manual_seed(settings.seed)
        self._weights = MovingWeights(network.module, "weights")
        self._rules: list[Update] = []
        self._alphas: list[float] = []
        self.best, self.kept = self._weights, 0
        self._losses: dict[int, NDArray[np.float64]] = {}

    def run(self, on_step: OnStep = lambda done, of, text: None) -> dict[int, float]:
        """Makes all updates. Returns the validation loss by the number of updates.

        Raises:
            UsageError: The network takes no sparse depth.
            DivergedError: The loss is not finite.
        """
        with self._network.cut_at_points() as split:
            return self._run(split, on_step)

    def _run(self, split: InputSplit, on_step: OnStep) -> dict[int, float]:
        of, updates = self._settings.iterations, 0
        losses = {0: self._validated(split, 0)}
        best: list[Tensor] | None = None
        for index in self._visits():
            visit = min(STEPS_A_VISIT, of - updates)
            loss = self._visited(split, index, updates, visit)
            checked = (updates + visit) * self._checks // of > updates * self._checks // of
            updates += visit
            on_step(updates, of, f"loss {loss:.4f}")
            if checked:
                losses[updates] = self._validated(split, updates)
                if losses[updates] < losses[self.kept]:
                    best, self.kept = list(self._weights.theta), updates
        start = [parameter.detach().float() for parameter in self._weights.parameters()]
        self._weights.theta = start if best is None else best
        return losses

    def p_value(self) -> float | None:
        """Returns that of a one-sided paired t test that the validation loss fell."""
        ratios = np.log(self._losses[self.kept] / self._losses[0])
        if len(ratios) < 2 or not self.kept:
            return None
        return float(ttest_1samp(ratios, 0, alternative="less").pvalue)

    def _visits(self) -> Iterator[int]:
        """The frames to learn from, shuffled anew when all were visited."""
        left = -(-self._settings.iterations // STEPS_A_VISIT)
        while left > 0:
            order = torch.randperm(len(self.training), generator=self._generator).tolist()
            yield from (self.training[index] for index in order[:left])
            left -= len(order)

    def _visited(self, split: InputSplit, index: int, first: int, steps: int) -> float:
        """Updates the weights on a frame. Returns the mean loss."""
        total = 0.0
        with self._frame(split, index) as frame:
            masks = Masks(frame.inliers, self._settings, self._generator)
            for step in range(first, first + steps):
                hidden = masks.next()
                with torch.enable_grad(), self._weights.in_place(requires_grad=True) as theta:
                    loss = self._loss(frame, hidden)
                    loss.backward()  # type: ignore[no-untyped-call]
                if not bool(loss.isfinite()):
                    raise DivergedError(
                        f"the loss is not finite after {step} updates; try a smaller --lr"
                    )
                self._update([value.grad for value in theta], step)
                total += float(loss.detach())
        return total / steps

    def _update(self, gradients: Sequence[Tensor | None], step: int) -> None:
        if not self._rules:
            self._weights.keep([gradient is not None for gradient in gradients])
            self._rules = [UPDATES[self._settings.update]() for _ in self._weights.theta]
            lr = self._settings.lr
            self._alphas = [step_size(lr, each) for each in self._weights.parameters()]
        factor = SCHEDULES[self._settings.schedule](step / self._settings.iterations)
        known = [gradient for gradient in gradients if gradient is not None]
        moving = zip(self._weights.theta, self._alphas, self._rules, known, strict=True)
        self._weights.theta = [
            value - factor * alpha * rule(gradient) for value, alpha, rule, gradient in moving
        ]

    def _validated(self, split: InputSplit, updates: int) -> float:
        """The mean loss at hidden points of the validation frames, the same each time."""
        losses = []
        for index in self.validation:
            generator = torch.Generator().manual_seed(self._settings.seed)
            with self._frame(split, index) as frame, torch.no_grad(), self._weights.in_place():
                hidden = Masks(frame.inliers, self._settings, generator).next()
                losses.append(float(self._loss(frame, hidden)))
        self._losses[updates] = np.array(losses)
        return float(np.mean(losses))

    def _loss(self, frame: FrameOfPoints, hidden: Tensor) -> Tensor:
        output = frame.predict_in_steps(frame.inliers.select(~hidden))
        hidden_points = frame.inliers.select(hidden)
        loss = checked_loss(self._settings.loss)
        return loss(hidden_points.sample(frame.depth_of(output)), hidden_points.depth)

    @contextmanager
    def _frame(self, split: InputSplit, index: int) -> Iterator[FrameOfPoints]:
        prepared = self._prepared(index)
        reader = prepared.depth_reader(self._settings)
        with opened_frame(split, prepared, reader, self._settings.mask_scale) as frame:
            yield frame

    def _prepare(self, index: int) -> PreparedFrame:
        name, read = self._frames[index]
        prepared = prepare(self._network, read().registered())
        if len(prepared.points) < 2:
            raise NoPointsError(f"{name}: {len(prepared.points)} points; hiding some needs 2")
        return prepared


def _same(frame: Frame) -> Frame:
    return frame
