"""The method on weights: they move until the prediction fits points that the network is not given.

A network that is given the points as an input fits them before the first update, so that L says
little. `refine_weights` hides some points m_k ⊂ D_s from the input and takes L at these, a new
random m_k at every step, and moves the weights θ instead of z:

    θ_{k+1} = θ_k − α·U(∂L(f_θ(x, D_s ∖ m_k), m_k) / ∂θ_k)
    depth   = f_θ*(x, D_s)

θ* is the last θ_k, unless another is better beyond chance at points never shown; k = 0 is among
them. With target "given" nothing is hidden, and L is taken at all points, as in equation 3.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.masks import SET_ASIDE, Masks, set_aside
from pnpdepth_cli.core.refine import DepthOf, OnIteration, Refinement, bad_prediction
from pnpdepth_cli.core.update_rules import SCHEDULES, Update, step_size
from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.core.weights import MovingWeights
from pnpdepth_cli.errors import DivergedError, LayerError
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

MIN_POINTS = 30
"""With fewer points no step is made: what a few hidden points ask does not hold for a frame."""
CHECKS = 3
"""How often the points set aside are looked at, besides before the first step."""
PATIENCE = 2
"""The steps end after so many checks in a row that are worse than the best beyond chance."""

Predict = Callable[[SparsePoints], Any]
"""Returns what the network returns for a frame when it is given these of its points."""


@dataclass(frozen=True, kw_only=True)
class FrameOfPoints:
    """A frame whose depth the network predicts from any of its points."""

    points: SparsePoints  # all points, on the network's grid
    inliers: SparsePoints  # those that the steps are made with
    output: Any  # what the network returns for all points
    predict: Predict  # returns what the network returns for some of them, differentiably
    predict_in_steps: Predict
    """The same for the steps, perhaps from a smaller image of the same field of view."""
    depth_of: DepthOf  # turns that into depth (1, 1, h, w) in metres, differentiably


def refine_weights(
    frame: FrameOfPoints,
    weights: MovingWeights,
    settings: Settings,
    *,
    on_iteration: OnIteration = lambda done, loss: None,
) -> Refinement:
    """Returns the depth of one frame after moving weights, which are back in place afterwards.

    Args:
        frame: The frame, and how the network predicts it.
        weights: The weights that move, θ_0.
        settings: What is updated and how.
        on_iteration: Called after each step; gets the loss before it.

    Raises:
        DivergedError: As of `refine`.
        ModelError: As of `refine`.
        LayerError: The depth depends on no weight behind the cut.
    """
    state = _WeightsRefinement(frame, weights, settings.complete())
    for _ in range(state.iterations):
        state.step()
        on_iteration(len(state.losses), state.losses[-1])
        if state.finished():
            break
    return state.result()


class _WeightsRefinement:
    """The state of a refinement by moving weights: masks, losses, and the best weights."""

    def __init__(self, frame: FrameOfPoints, weights: MovingWeights, settings: Settings) -> None:
        self._frame, self._weights, self._settings = frame, weights, settings
        self._loss = checked_loss(settings.loss)
        generator = torch.Generator().manual_seed(settings.seed)
        fraction = SET_ASIDE if settings.masked else 0.0
        aside = set_aside(frame.inliers, fraction, generator)
        self._shown, self._aside = frame.inliers.select(~aside), frame.inliers.select(aside)
        self._masks = Masks(self._shown, settings, generator)
        self._rules: list[Update] = []
        self._steps: list[float] = []
        self._errors: dict[int, float] = {}  # loss at the points set aside, by number of steps
        self._checked: dict[int, list[Tensor]] = {}  # weights, by number of steps
        self._started = time.monotonic()
        self.losses: list[float] = []
        self._before = frame.depth_of(frame.output).detach()
        at_points = frame.points.sample(self._before)
        if not bool(at_points.isfinite().all()):
            raise bad_prediction(at_points)
        self._check()

    @property
    def iterations(self) -> int:
        """Number of steps at most."""
        enough = len(self._frame.inliers) >= MIN_POINTS or not self._settings.masked
        return self._settings.iterations if enough else 0

    def step(self) -> None:
        """Moves the weights: θ_{k+1} = θ_k − α·U(∂L/∂θ_k).

        Raises:
            DivergedError: L or its gradient is not finite.
            LayerError: No weight can move.
        """
        shown = hidden = self._shown
        if self._settings.masked:
            away = self._masks.next()
            shown, hidden = self._shown.select(~away), self._shown.select(away)
        with torch.enable_grad(), self._weights.in_place(requires_grad=True) as theta:
            depth = self._frame.depth_of(self._frame.predict_in_steps(shown))
            loss = self._loss(hidden.sample(depth), hidden.depth)
            if loss.requires_grad:
                with wrap_user_errors("the gradient of the network"):
                    loss.backward()  # type: ignore[no-untyped-call]
        done = len(self.losses)
        if not done:
            self._start_rules([value.grad for value in theta])
        known = [value.grad for value in theta if value.grad is not None]
        finite = loss.isfinite().all() & torch.stack([g.isfinite().all() for g in known]).all()
        if not bool(finite):
            raise DivergedError(
                f"the loss or its gradient is not finite after {done} steps of the weights; try a"
                " smaller --lr",
                self.result(),
            )
        self.losses.append(float(loss.detach()))
        factor = SCHEDULES[self._settings.schedule](done / self._planned())
        self._weights.theta = [
            value - factor * alpha * rule(gradient)
            for value, alpha, rule, gradient in zip(
                self._weights.theta, self._steps, self._rules, known, strict=True
            )
        ]

    def finished(self) -> bool:
        """Whether no further step is worth its time, by the points set aside and the budget."""
        steps, of = len(self.losses), self._settings.iterations
        last = steps >= self._planned()
        if last or steps * CHECKS // of > (steps - 1) * CHECKS // of:
            self._check()
        if last or not self._errors:
            return last
        best = min(self._errors, key=self._errors.__getitem__)
        later = [steps for steps in self._errors if steps > best]
        return sum(self._beyond_chance(best, steps) for steps in later) >= PATIENCE

    def result(self) -> Refinement:
        """Returns the refinement with the best weights, given all points.

        Those of the last check, unless another is better beyond chance.
        """
        kept = max(self._checked)
        if self._errors:
            best = min(self._errors, key=self._errors.__getitem__)
            kept = best if self._beyond_chance(best, kept) else kept
        self._weights.theta = self._checked[kept]
        return Refinement(
            before=self._before,
            after=self._predicted(self._frame.points) if kept else self._before,
            losses=tuple(self.losses),
            step=self._steps[0] if self._steps else 0.0,
            kept=kept,
        )

    def _check(self) -> None:
        """Notes the weights, and the loss at the points set aside if there are any."""
        self._checked[len(self.losses)] = list(self._weights.theta)
        if len(self._aside):
            self._errors[len(self.losses)] = self._error_at(self._aside)

    def _error_at(self, points: SparsePoints) -> float:
        return float(self._loss(points.sample(self._predicted(self._shown)), points.depth))

    def _beyond_chance(self, better: int, worse: int) -> bool:
        """Whether one check is better than another by more than a mean over so few points varies.

        A mean of m absolute errors varies by about 1/√m of itself; two checks at the same points
        share much of that, so that half of it counts. A check that is not finite is always worse.
        """
        margin = 1 - 0.5 * len(self._aside) ** -0.5
        return not self._errors[better] >= margin * self._errors[worse]

    def _predicted(self, points: SparsePoints) -> Tensor:
        with torch.no_grad(), self._weights.in_place():
            return self._frame.depth_of(self._frame.predict(points)).detach()

    def _planned(self) -> int:
        """Number of steps in all: those of the settings, or as many as fit in the time budget.

        α falls to 0 with the last of them, so that a budget shortens the schedule.
        """
        steps, budget = len(self.losses), self._settings.time_budget_s
        if budget is None:
            return self._settings.iterations
        step_s = (time.monotonic() - self._started) / steps
        # The last prediction takes less than a step.
        return max(steps, min(self._settings.iterations, int(budget / step_s) - 1))

    def _start_rules(self, gradients: Sequence[Tensor | None]) -> None:
        """Begins with those weights that a gradient reaches."""
        self._weights.keep([gradient is not None for gradient in gradients])
        if not self._weights.theta:
            raise LayerError(
                "no weight can move: the prediction depends on no parameter behind the cut; take"
                " --set parameters=elements, or cut at an earlier layer"
            )
        self._checked = {0: list(self._weights.theta)}
        lr, update = self._settings.lr, self._settings.update
        self._rules = [UPDATES[update]() for _ in self._weights.theta]
        self._steps = [step_size(lr, parameter) for parameter in self._weights.parameters()]
