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

from pnpdepth_cli.choices import LOSSES, UPDATES
from pnpdepth_cli.core.losses import Loss
from pnpdepth_cli.core.masks import SET_ASIDE, Masks, set_aside
from pnpdepth_cli.core.refinement import DepthOf, Refinement, bad_prediction
from pnpdepth_cli.core.step_sizes import SCHEDULES, step_size
from pnpdepth_cli.core.update_rules import Update
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

    points: SparsePoints
    """All points, on the network's grid."""
    inliers: SparsePoints
    """Those that the steps are made with."""
    output: Any
    """What the network returns for all points."""
    predict: Predict
    """Returns what the network returns for some of them, differentiably."""
    predict_in_steps: Predict
    """The same for the steps, perhaps from a smaller image of the same field of view."""
    depth_of: DepthOf
    """Turns that into depth (1, 1, h, w) in metres, differentiably."""


def refine_weights(
    frame: FrameOfPoints,
    weights: MovingWeights,
    settings: Settings,
    *,
    carried: MovingWeights | None = None,
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> Refinement:
    """Returns the depth of one frame after moving weights, which are back in place afterwards.

    Args:
        frame: The frame, and how the network predicts it.
        weights: The weights that move, θ_0.
        settings: What is updated and how.
        carried: θ* of the frame before, which moves instead where its L is lower than that of θ_0
            at the points set aside.
        on_iteration: Called after each step k with k and L(θ_k).

    Raises:
        DivergedError: As of `refine`.
        ModelError: As of `refine`.
        LayerError: The depth depends on no weight behind the cut.
    """
    state = WeightsRefinement(frame, weights, settings)
    state.begin()
    if carried is not None and state.takes(carried):
        weights = carried
    for iteration in range(state.iterations):
        shown, hidden = state.mask()
        with torch.enable_grad(), weights.in_place(requires_grad=True) as theta:
            loss = state.loss(frame.predict_in_steps(shown), hidden)
            gradients = _gradients(loss, theta)
        state.update(loss, gradients)
        if state.error is not None:
            break
        on_iteration(iteration, state.losses[-1])
        if state.finished():
            break
    if state.error is not None:
        state.error.last_good = state.result()
        raise state.error
    return state.result()


def _gradients(loss: Tensor, theta: Sequence[Tensor]) -> list[Tensor | None]:
    """∂L/∂θ_k; None for what L does not depend on."""
    if loss.requires_grad:
        with wrap_user_errors("the gradient of the network"):
            loss.backward()  # type: ignore[no-untyped-call]
    return [value.grad for value in theta]


class WeightsRefinement:
    """The state of a refinement by moving weights: masks, losses, and the best weights.

    Args:
        frame: The frame.
        weights: The weights that move.
        settings: What is updated and how.
    """

    def __init__(self, frame: FrameOfPoints, weights: MovingWeights, settings: Settings) -> None:
        settings = settings.complete()
        self._frame, self._weights, self._settings = frame, weights, settings
        self._loss: Loss = LOSSES[settings.loss]
        generator = torch.Generator().manual_seed(settings.seed)
        masked = settings.masked
        fraction = SET_ASIDE if masked else 0.0
        aside = set_aside(frame.inliers, fraction, generator)
        self._shown, self._aside = frame.inliers.select(~aside), frame.inliers.select(aside)
        self._masks = Masks(self._shown, settings, generator)
        self._rules: list[Update] = []
        self._steps: list[float] = []
        self._errors: dict[int, float] = {}
        self._checked: dict[int, list[Tensor]] = {0: list(weights.theta)}
        self._started = time.monotonic()
        self._before = torch.empty(0)
        self._warm = False
        self.losses: list[float] = []
        self.error: DivergedError | None = None

    @property
    def iterations(self) -> int:
        """Number of steps at most."""
        enough = len(self._frame.inliers) >= MIN_POINTS or not self._settings.masked
        return self._settings.iterations if enough else 0

    def begin(self) -> None:
        """Predicts the depth before any step. Raises ModelError where it is not finite."""
        self._before = self._frame.depth_of(self._frame.output).detach()
        at_points = self._frame.points.sample(self._before)
        if not bool(at_points.isfinite().all()):
            raise bad_prediction(at_points)
        self._check(0)

    def takes(self, carried: MovingWeights) -> bool:
        """Begins with the weights of another frame, if L at the points set aside is lower there.

        Without points set aside, L is taken at all inliers.
        """
        at = self._aside if len(self._aside) else self._frame.inliers
        cold = float(self._loss(at.sample(self._predicted(self._shown)), at.depth))
        plain, self._weights = self._weights, carried
        warm = float(self._loss(at.sample(self._predicted(self._shown)), at.depth))
        self._warm = warm < cold
        if not self._warm:
            self._weights = plain
            return False
        self._check(0)
        return True

    def mask(self) -> tuple[SparsePoints, SparsePoints]:
        """Returns the points that the network is given, and those that L is taken at."""
        if not self._settings.masked:
            return self._shown, self._shown
        away = self._masks.next()
        return self._shown.select(~away), self._shown.select(away)

    def loss(self, output: Any, points: SparsePoints) -> Tensor:
        """Returns L of the network's output at these points."""
        return self._loss(points.sample(self._frame.depth_of(output)), points.depth)

    def update(self, loss: Tensor, gradients: Sequence[Tensor | None]) -> None:
        """Moves the weights: θ_{k+1} = θ_k − α·U(∂L/∂θ_k). Sets `error` where that diverges."""
        done = len(self.losses)
        if not done:
            self._start_rules(gradients)
        known = [gradient for gradient in gradients if gradient is not None]
        finite = loss.isfinite().all() & torch.stack([g.isfinite().all() for g in known]).all()
        if not bool(finite):
            self.error = self._diverged(done)
            return
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
            self._check(steps)
        return last or self._getting_worse()

    def result(self) -> Refinement:
        """Returns the refinement with the best weights, given all points."""
        kept = self._kept()
        self._weights.theta = self._checked[kept]
        return Refinement(
            before=self._before,
            after=self._predicted(self._frame.points) if kept or self._warm else self._before,
            losses=tuple(self.losses),
            step=self._steps[0] if self._steps else 0.0,
            kept=kept,
            warm=self._warm,
        )

    def _check(self, steps: int) -> None:
        """Notes the loss at the points set aside; without any, that the last weights count."""
        self._checked[steps] = list(self._weights.theta)
        if len(self._aside):
            at_points = self._aside.sample(self._predicted(self._shown))
            self._errors[steps] = float(self._loss(at_points, self._aside.depth))

    def _kept(self) -> int:
        """The step that counts: the last, unless another is better beyond chance."""
        last = max(self._checked)
        if not self._errors:
            return last
        best = min(self._errors, key=lambda steps: self._errors[steps])
        return best if self._beyond_chance(best, last) else last

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

    def _getting_worse(self) -> bool:
        if not self._errors:
            return False
        best = min(self._errors, key=lambda steps: self._errors[steps])
        later = [steps for steps in self._errors if steps > best]
        return sum(self._beyond_chance(best, steps) for steps in later) >= PATIENCE

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

    def _diverged(self, steps: int) -> DivergedError:
        return DivergedError(
            f"the loss or its gradient is not finite after {steps} steps of the weights; try a"
            " smaller --lr"
        )
