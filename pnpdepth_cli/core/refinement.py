"""The refinement of one frame: its settings, its state between updates of z, and its result."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from pnpdepth_cli.choices import LOSSES, PARAMETERS, UPDATES
from pnpdepth_cli.core.losses import Loss, proximity_loss
from pnpdepth_cli.core.masks import MaskSettings
from pnpdepth_cli.core.step_sizes import SCHEDULES, Channels, blurred, step_size
from pnpdepth_cli.core.update_rules import Update
from pnpdepth_cli.errors import DivergedError, ModelError, PnpDepthError
from pnpdepth_cli.points import SparsePoints

DepthOf = Callable[[Any], Tensor]
"""Turns the network's output for one frame into depth (1, 1, h, w) in metres, differentiably."""


@dataclass(frozen=True, kw_only=True)
class RefineSettings:
    """What is updated and how; the defaults are the paper's."""

    iterations: int = 5
    """Number of updates; 0 gives the plain prediction."""
    lr: float | str = 0.01
    """Step size α: a number, or a text such as "3%" of the standard deviation of z_0."""
    loss: str = "l1"
    """L, one of `choices.LOSSES`."""
    update: str = "sign"
    """U, one of `choices.UPDATES`."""
    schedule: str = "constant"
    """How α changes over the updates, one of `choices.SCHEDULES`."""
    blur: float = 0.0
    """Standard deviation of the blur of the gradient, in mean spacings of the points."""
    parameters: str = "elements"
    """What is updated: "elements" or "channels" of z, "weights", or "lora:R"."""
    target: str = "given"
    """Which points L is taken at, one of `choices.TARGETS`."""
    mask: MaskSettings = field(default_factory=MaskSettings)
    """With target "masked": which points are hidden from the input."""
    time_budget_s: float | None = None
    """Seconds after which no update of weights begins; None sets no limit."""
    proximity: float = 0.0
    """Weight of the proximity loss in L."""
    line_search: bool = False
    """Whether an update that raised L is repeated from the best z with half the step."""
    keep_best: bool = False
    """Whether the result is the depth of the lowest loss instead of the last."""
    align: str = "none"
    """How `depth_of` fits the network's output to the points, one of `choices.ALIGNMENTS`."""
    align_every: bool = False
    """Whether `depth_of` repeats that fit at every update."""

    @property
    def moves_weights(self) -> bool:
        """Whether weights of the network are updated instead of z."""
        return self.parameters not in PARAMETERS

    @property
    def masked(self) -> bool:
        """Whether L is taken at points hidden from the network's input."""
        return self.target == "masked"

    @property
    def gives_best(self) -> bool:
        """Whether the result is the depth of the lowest loss; with a line search it always is."""
        return self.keep_best or self.line_search


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """The result of a refinement."""

    before: Tensor
    """Depth (1, 1, h, w) in metres of z_0."""
    after: Tensor
    """Depth (1, 1, h, w) in metres of z_kept."""
    losses: tuple[float, ...]
    """L(z_0) … L(z_K)."""
    step: float
    """α as a number."""
    kept: int
    """Number of updates after which `after` was predicted: K, or those of the lowest loss."""
    depths: Mapping[int, Tensor] = field(default_factory=dict)
    """Depth (1, 1, h, w) after each of the chosen numbers of updates, as far as they were made."""
    z: Tensor | None = None
    """z_K; None where weights moved."""
    warm: bool = False
    """Whether it began where the frame before ended."""


class FrameRefinement:
    """The refinement of one frame between updates: losses, depths, and the error that ended it.

    Args:
        settings: How z is updated.
        z0: z_0 of this frame.
        points: The frame's sparse depth, on the network's grid.
        depth_of: Turns the network's output for this frame into depth.
        keep_depths: Numbers of updates after which depth is kept in the result.
    """

    def __init__(
        self,
        settings: RefineSettings,
        z0: Tensor,
        points: SparsePoints,
        depth_of: DepthOf,
        keep_depths: Collection[int] = (),
    ) -> None:
        self._settings, self._points, self._depth_of = settings, points, depth_of
        self._step, self._halvings = step_size(settings.lr, z0), 0
        self._loss: Loss = LOSSES[settings.loss]
        self._update: Update = UPDATES[settings.update]()
        self._channels = Channels(z0) if settings.parameters == "channels" else None
        self._best: tuple[Tensor, Tensor] | None = None  # z of the lowest loss and its direction
        self._first: Tensor | None = None  # depth of z_0
        self._after: Tensor | None = None  # depth of z_kept
        self._kept = 0
        self._keep_depths = frozenset(keep_depths)
        self._z = z0
        self._depths: dict[int, Tensor] = {}
        self.losses: list[float] = []
        self.error: PnpDepthError | None = None

    def loss(self, output: Any) -> Tensor | None:
        """Returns L of the network's output for this frame; None once the frame has ended."""
        try:
            depth = self._depth_of(output)
        except PnpDepthError as error:
            self.error = error
            return None
        at_points = self._points.sample(depth)
        loss = self._loss(at_points, self._points.depth)
        if self._settings.proximity and self._first is not None:
            loss = loss + self._settings.proximity * proximity_loss(depth, self._first)
        if self._settings.iterations and not bool(loss.isfinite()):
            self.error = self._diverged("loss", len(self.losses))
            if not self.losses and not bool(at_points.isfinite().all()):
                self.error = bad_prediction(at_points)
            return None
        self._record(loss, depth.detach())
        return loss

    def updated(self, z: Tensor, gradient: Tensor) -> Tensor:
        """Returns z_{k+1} = z_k − α·U(gradient); the same z_k once the frame has ended."""
        updates = len(self.losses) - 1
        if self.error is None and not bool(gradient.isfinite().all()):
            self.error = self._diverged("gradient", updates)
        if self.error is not None:
            return z
        if self._best is not None and self._kept < updates:  # the last update raised the loss
            self._halvings += 1
            z, direction = self._best
        else:
            direction = self._direction(blurred(gradient, self._points, self._settings.blur))
            if self._settings.line_search:
                self._best = z, direction
        alpha = self._step * SCHEDULES[self._settings.schedule](updates / self._settings.iterations)
        self._z = z - alpha * 0.5**self._halvings * direction
        return self._z

    def result(self) -> Refinement:
        """Returns the refinement as far as it has come."""
        assert self._first is not None
        assert self._after is not None
        return Refinement(
            before=self._first,
            after=self._after,
            losses=tuple(self.losses),
            step=self._step,
            kept=self._kept,
            depths=dict(self._depths),
            z=self._z.detach(),
        )

    def _record(self, loss: Tensor, depth: Tensor) -> None:
        updates = len(self.losses)
        self.losses.append(float(loss.detach()))
        if self._first is None:
            self._first = depth
        if not self._settings.gives_best or self.losses[-1] <= min(self.losses):
            self._kept, self._after = updates, depth
        if updates in self._keep_depths:
            self._depths[updates] = depth

    def _direction(self, gradient: Tensor) -> Tensor:
        if self._channels is None:
            return self._update(gradient)
        return self._channels.change_of_z(self._update(self._channels.gradient(gradient)))

    def _diverged(self, quantity: str, updates: int) -> DivergedError:
        return DivergedError(
            f"the {quantity} is not finite after {updates} update{'s' if updates != 1 else ''} of z"
            f" (step {self._step:.3g}); try a smaller --lr or fewer --iterations",
            self.result() if self.losses else None,
        )


def bad_prediction(at_points: Tensor) -> ModelError:
    """Returns the error of a plain prediction (N,) at the points that is not finite."""
    return ModelError(
        f"the network's prediction is not finite at {int((~at_points.isfinite()).sum()):,} of"
        f" {len(at_points):,} sparse points, before any update of z; are its weights, its input"
        " range (--normalise) and --precision right?"
    )
