"""The refinement of one frame: its settings, its state between updates of z, and its result."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from pnpdepth_cli.choices import LOSSES, UPDATES
from pnpdepth_cli.core.losses import Loss, proximity_loss
from pnpdepth_cli.core.step_sizes import SCHEDULES, Channels, blurred, step_size
from pnpdepth_cli.core.update_rules import Update
from pnpdepth_cli.errors import DivergedError, ModelError, PnpDepthError
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

DepthOf = Callable[[Any], Tensor]
"""Turns the network's output for one frame into depth (1, 1, h, w) in metres, differentiably."""


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
        settings: Settings,
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
        " range (normalise) and precision right?"
    )
