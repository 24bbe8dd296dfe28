"""The method: update an intermediate feature map until the prediction fits the sparse points.

Wang et al., "Plug-and-Play: Improve Depth Estimation via Sparse Data Propagation", ICRA 2019,
equations 2 and 3:

    z_0     = f_front(x)
    z_{k+1} = z_k − α·U(∂L(f_rear(z_k), D_s) / ∂z_k)
    depth   = f_rear(z_K)

`refine_from` is that loop. L and D_s are those of `core.losses` and `points`, U one of
`core.update_rules`, as are α and its schedule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.core.split.tensors import map_tensors, tensors_in
from pnpdepth_cli.core.update_rules import SCHEDULES, Update, blurred, step_size
from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.errors import BatchError, DivergedError, LayerError, ModelError, PnpDepthError
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

_LOSS_SCALE = 1024.0
"""Factor on the loss where float16 is involved, whose smallest number exceeds many gradients."""

DepthOf = Callable[[Any], Tensor]
"""Turns the network's output for one frame into depth (1, 1, h, w) in metres, differentiably."""

OnIteration = Callable[[int, float], None]
"""Called with (updates made, loss)."""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """The result of a refinement."""

    before: Tensor  # depth (1, 1, h, w) in metres of z_0
    after: Tensor  # depth (1, 1, h, w) in metres of z_K
    losses: tuple[float, ...]  # L(z_0) … L(z_K)
    step: float  # α as a number


def refine(
    split: Split,
    arguments: Sequence[Tensor],
    points: SparsePoints,
    settings: Settings,
    *,
    depth_of: DepthOf,
) -> Refinement:
    """Returns the network's depth for one frame, refined to agree with the points.

    Args:
        points: Sparse depth on the grid of the predicted depth's field of view.
        settings: How z is updated.
        depth_of: Turns the network's output into depth (1, 1, h, w) in metres, differentiably.

    Raises:
        DivergedError: The loss or its gradient is not finite; `last_good` is the Refinement until
            then.
        ModelError: The first prediction is not finite at any point.
        LayerError: The depth does not depend on z.
    """
    with torch.no_grad():
        z0 = split.front(*arguments)
    (result,) = refine_from(split, z0, (points,), settings, depth_of=(depth_of,))
    if isinstance(result, PnpDepthError):
        raise result
    return result


def refine_from(
    split: Split,
    z: Tensor,
    points: Sequence[SparsePoints],
    settings: Settings,
    *,
    depth_of: Sequence[DepthOf],
    on_iteration: OnIteration = lambda done, loss: None,
) -> list[Refinement | PnpDepthError]:
    """Returns for each of B frames its refinement, or the error that ended it.

    The frames share the passes of the network; each has its own α, loss and end, as if alone.

    Args:
        z: z_0 of all frames, stacked along axis 0; the front has run.
        points: Of each frame.
        settings: Of all frames.
        depth_of: Of each frame; called with the frame's part of the network's output.
        on_iteration: Called after each update; gets the mean loss before it.

    Raises:
        BatchError: z or the output does not have one part per frame; refine them one at a time.
    """
    settings, count = settings.complete(), len(points)
    scale = _LOSS_SCALE if split.in_half else 1.0  # of the loss, so that no gradient vanishes
    frames = [
        _FrameRefinement(settings, z0, at, read)
        for z0, at, read in zip(frame_parts(z, count), points, depth_of, strict=True)
    ]
    for iteration in range(settings.iterations):
        z = z.detach().requires_grad_(True)
        with torch.enable_grad():
            losses = _losses(frames, split.rear(z))
            if not losses:
                break
            gradient = gradient_at(z, torch.stack(losses).sum() * scale)
        if gradient is None:
            raise LayerError(
                f"layer {split.layer!r}: no gradient comes back from the prediction to it; either"
                " the prediction does not depend on it or the network's forward runs under"
                " torch.no_grad, inference_mode or detach (take that out, or cut at a later layer)"
            )
        with torch.no_grad():
            parts = zip(
                frames,
                frame_parts(z.detach(), count),
                frame_parts(gradient / scale, count),
                strict=True,
            )
            moved = [frame.updated(*part) for frame, *part in parts]
            z = torch.cat(moved) if count > 1 else moved[0]
        if running := [frame.losses[-1] for frame in frames if frame.error is None]:
            on_iteration(iteration + 1, sum(running) / len(running))
    else:
        with torch.no_grad():
            _losses(frames, split.rear(z))
    return [frame.result() if frame.error is None else frame.error for frame in frames]


def frame_parts(structure: Any, frames: int) -> list[Any]:
    """Returns the part of each frame, with a batch axis of 1; for one frame the whole structure.

    Args:
        structure: A tensor, or tensors in nested containers, with the frames along axis 0.

    Raises:
        BatchError: A tensor does not have one element per frame along axis 0.
    """
    if frames == 1:
        return [structure]
    for path, tensor in tensors_in(structure):
        if tensor.shape[:1] != (frames,):
            name = ".".join(path) or "the tensor"
            raise BatchError(
                f"{name} of shape {tuple(tensor.shape)}, at the cut or in the output, has not one"
                f" part for each of {frames} frames; refine them one at a time"
            )
    parts = {path: tensor.tensor_split(frames) for path, tensor in tensors_in(structure)}

    def of_frame(index: int) -> Any:
        return map_tensors(structure, lambda path, _: parts[path][index])

    return [of_frame(index) for index in range(frames)]


def _losses(frames: Sequence[_FrameRefinement], output: Any) -> list[Tensor]:
    """L(f_rear(z_k), D_s) of every frame that has not ended."""
    parts = zip(frames, frame_parts(output, len(frames)), strict=True)
    losses = [frame.loss(part) for frame, part in parts if frame.error is None]
    return [loss for loss in losses if loss is not None]


class _FrameRefinement:
    """The refinement of one frame between updates: losses, depths, and the error that ended it.

    The arguments are those of `refine`, for this frame.
    """

    def __init__(
        self,
        settings: Settings,
        z0: Tensor,
        points: SparsePoints,
        depth_of: DepthOf,
    ) -> None:
        self._settings, self._points, self._depth_of = settings, points, depth_of
        self._step = step_size(settings.lr, z0)
        self._loss = checked_loss(settings.loss)
        self._update: Update = UPDATES[settings.update]()
        self._first: Tensor | None = None  # depth of z_0
        self._last: Tensor | None = None  # depth of z_k
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
        if not self.losses:  # a point has no part in L where f(x) is unknown, such as in the sky
            known = at_points.isfinite()
            if self._settings.iterations and not bool(known.any()):
                self.error = ModelError(
                    f"the network's prediction is not finite at any of {len(known):,} sparse"
                    " points, before any update of z; are its weights, its input range (normalise)"
                    " and precision right?"
                )
                return None
            self._points, at_points = self._points.select(known), at_points[known]
        loss = self._loss(at_points, self._points.depth)
        if self._settings.iterations and not bool(loss.isfinite()):
            self.error = self._diverged("loss", len(self.losses))
            return None
        self.losses.append(float(loss.detach()))
        self._last = depth.detach()
        if self._first is None:
            self._first = self._last
        return loss

    def updated(self, z: Tensor, gradient: Tensor) -> Tensor:
        """Returns z_{k+1} = z_k − α·U(gradient); the same z_k once the frame has ended."""
        updates = len(self.losses) - 1
        if self.error is None and not bool(gradient.isfinite().all()):
            self.error = self._diverged("gradient", updates)
        if self.error is not None:
            return z
        gradient = blurred(gradient, self._points, self._settings.blur)
        with wrap_user_errors(f"update rule {self._settings.update!r}"):
            direction = self._update(gradient).reshape(gradient.shape)
        alpha = self._step * SCHEDULES[self._settings.schedule](updates / self._settings.iterations)
        return z - alpha * direction

    def result(self) -> Refinement:
        """Returns the refinement as far as it has come."""
        assert self._first is not None
        assert self._last is not None
        return Refinement(
            before=self._first,
            after=self._last,
            losses=tuple(self.losses),
            step=self._step,
        )

    def _diverged(self, quantity: str, updates: int) -> DivergedError:
        return DivergedError(
            f"the {quantity} is not finite after {updates} update{'s' if updates != 1 else ''} of z"
            f" (step {self._step:.3g}); try a smaller --lr or fewer --iterations",
            self.result() if self.losses else None,
        )
