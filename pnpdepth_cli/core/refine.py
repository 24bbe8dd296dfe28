"""The method: update an intermediate feature map until the prediction fits the sparse points.

Wang et al., "Plug-and-Play: Improve Depth Estimation via Sparse Data Propagation", ICRA 2019,
equations 2 and 3:

    z_0     = f_front(x)
    z_{k+1} = z_k − α·U(∂L(f_rear(z_k), D_s) / ∂z_k)
    depth   = f_rear(z_K)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.choices import LOSSES, UPDATES
from pnpdepth_cli.core.losses import Loss
from pnpdepth_cli.core.proximity import proximity_loss
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.core.split.structure import map_tensors, tensors_in
from pnpdepth_cli.core.step_sizes import SCHEDULES, Channels, blurred, step_size
from pnpdepth_cli.core.update_rules import Update
from pnpdepth_cli.errors import BatchError, DivergedError, LayerError, ModelError, PnpDepthError
from pnpdepth_cli.points import SparsePoints

DepthOf = Callable[[Any], Tensor]

_HALF_SCALE = 1024.0
"""Of the loss where float16 is involved: its smallest number is larger than many a gradient."""


@dataclass(frozen=True, kw_only=True)
class RefineSettings:
    """How z is updated; the values are the paper's.

    iterations: the number of updates of z, 0 for the plain prediction.
    lr: α as a number, or a text like "3%": that share of the standard deviation of z_0.
    schedule: how α falls over the updates. blur: how far the gradient is blurred, in spacings of
        the points. parameters: what is updated; see `pnpdepth_cli.core.step_sizes` for these three.
    proximity: the weight of `pnpdepth_cli.core.proximity.proximity_loss` in L.
    line_search: whether an update that raises L is taken back and made half as far instead.
    keep_best: whether the result is the depth of the lowest loss instead of the last; with a line
        search it always is.
    align, align_every: how `depth_of` was asked to fit the network's numbers to metres, and
        whether again for every z; see `pnpdepth_cli.completion.alignment`.
    """

    iterations: int = 5
    lr: float | str = 0.01
    loss: str = "l1"
    update: str = "sign"
    schedule: str = "constant"
    blur: float = 0.0
    parameters: str = "elements"
    proximity: float = 0.0
    line_search: bool = False
    keep_best: bool = False
    align: str = "none"
    align_every: bool = False

    @property
    def gives_best(self) -> bool:
        """Whether the result is the depth of the lowest loss."""
        return self.keep_best or self.line_search


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """What refinement gives.

    before, after: depth (1, 1, h, w) in metres of z_0 and of z_kept, which is z_K or the best.
    losses: L(z_0) … L(z_K).
    step: α as a number.
    """

    before: Tensor
    after: Tensor
    losses: tuple[float, ...]
    step: float
    kept: int


def refine(
    split: Split,
    arguments: Sequence[Tensor],
    points: SparsePoints,
    settings: RefineSettings,
    *,
    depth_of: DepthOf,
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> Refinement:
    """The network's depth for `arguments`, brought to agree with the points.

    depth_of: turns what the network returns into depth (1, 1, h, w) in metres, differentiably.
    Raises DivergedError at a non-finite loss or gradient (its `last_good` is the Refinement up to
    there), ModelError if the first prediction is already bad, LayerError if z does not reach the
    depth.
    """
    (result,) = refine_batch(
        split, arguments, (points,), settings, depth_of=(depth_of,), on_iteration=on_iteration
    )
    if isinstance(result, PnpDepthError):
        raise result
    return result


def refine_batch(
    split: Split,
    arguments: Sequence[Tensor],
    points: Sequence[SparsePoints],
    settings: RefineSettings,
    *,
    depth_of: Sequence[DepthOf],
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> list[Refinement | PnpDepthError]:
    """B frames refined at once, each as if alone: its own α, loss and end, an error in its place.

    arguments: of the network for all frames, stacked. points, depth_of: of each; a `depth_of` is
    given its frame's part of what the network returns. on_iteration gets the mean loss.
    BatchError where z or the output is not one part per frame; then refine them one at a time.
    """
    with torch.no_grad():
        z = split.front(*arguments)
    return refine_from(split, z, points, settings, depth_of=depth_of, on_iteration=on_iteration)


def refine_from(
    split: Split,
    z: Tensor,
    points: Sequence[SparsePoints],
    settings: RefineSettings,
    *,
    depth_of: Sequence[DepthOf],
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> list[Refinement | PnpDepthError]:
    """The same from z_0 on: the front of these arguments is not run again for other points."""
    frames = [
        _Frame(settings, z0, at, read)
        for z0, at, read in zip(_apart(z, len(points)), points, depth_of, strict=True)
    ]
    for iteration in range(settings.iterations):
        z = z.detach().requires_grad_(True)
        with torch.enable_grad():
            losses = _losses(frames, split.rear(z))
            if not losses:
                break
            gradient = _gradient(torch.stack(losses).sum(), z, split)
        with torch.no_grad():
            z = _moved(frames, z.detach(), gradient)
        if going := [frame.losses[-1] for frame in frames if frame.error is None]:
            on_iteration(iteration, sum(going) / len(going))
    else:
        with torch.no_grad():
            _losses(frames, split.rear(z))
    return [frame.refinement() if frame.error is None else frame.error for frame in frames]


class _Frame:
    """A frame on its way: the losses and depths so far, and the error that ended it."""

    def __init__(
        self, settings: RefineSettings, z0: Tensor, points: SparsePoints, depth_of: DepthOf
    ) -> None:
        self._settings, self._points, self._depth_of = settings, points, depth_of
        self._step, self._halvings = step_size(settings.lr, z0), 0
        self._loss_of: Loss = LOSSES[settings.loss]
        self._update: Update = UPDATES[settings.update]()
        self._channels = Channels(z0) if settings.parameters == "channels" else None
        self._way: tuple[Tensor, Tensor] | None = None  # the lowest loss's z, and where it points
        self._depths: list[Tensor] = []  # of z_0, and of z_kept
        self._kept = 0
        self.losses: list[float] = []
        self.error: PnpDepthError | None = None

    def loss(self, output: Any) -> Tensor | None:
        """L of what the network returned for this frame; None where there is none to go by."""
        try:
            depth = self._depth_of(output)
        except PnpDepthError as error:
            self.error = error
            return None
        at_points = self._points.sample(depth)
        loss = self._loss_of(at_points, self._points.depth)
        if self._settings.proximity and self._depths:
            loss = loss + self._settings.proximity * proximity_loss(depth, self._depths[0])
        if self._settings.iterations and not bool(loss.isfinite()):
            self.error = self._diverged("loss", len(self.losses))
            if not self.losses and not bool(at_points.isfinite().all()):
                self.error = _bad_from_the_start(at_points)
            return None
        self.losses.append(float(loss.detach()))
        if not self._settings.gives_best or self.losses[-1] <= min(self.losses):
            self._kept = len(self.losses) - 1
            self._depths = [*self._depths[:1], depth.detach()]
        return loss

    def moved(self, z: Tensor, gradient: Tensor) -> Tensor:
        """z_{k+1} of z_k; the same z_k once the frame has ended."""
        made = len(self.losses) - 1
        if self.error is None and not bool(gradient.isfinite().all()):
            self.error = self._diverged("gradient", made)
        if self.error is not None:
            return z
        if self._settings.line_search and self._way is not None and self._kept < made:
            self._halvings += 1
            z, direction = self._way
        else:
            direction = self._direction(blurred(gradient, self._points, self._settings.blur))
            if self._settings.line_search:
                self._way = z, direction
        alpha = self._step * SCHEDULES[self._settings.schedule](made / self._settings.iterations)
        return z - alpha * 0.5**self._halvings * direction

    def _direction(self, gradient: Tensor) -> Tensor:
        if self._channels is None:
            return self._update(gradient)
        return self._channels.change_of_z(self._update(self._channels.gradient(gradient)))

    def refinement(self) -> Refinement:
        """What has come of it so far."""
        return Refinement(
            before=self._depths[0],
            after=self._depths[-1],
            losses=tuple(self.losses),
            step=self._step,
            kept=self._kept,
        )

    def _diverged(self, what: str, updates: int) -> DivergedError:
        return DivergedError(
            f"the {what} is not finite after {updates} update{'s' if updates != 1 else ''} of z"
            f" (step {self._step:.3g}); try a smaller --lr or fewer --iterations",
            self.refinement() if self._depths else None,
        )


def _bad_from_the_start(at_points: Tensor) -> ModelError:
    return ModelError(
        f"the network's prediction is not finite at {int((~at_points.isfinite()).sum()):,} of"
        f" {len(at_points):,} sparse points, before any update of z; are its weights, its input"
        " range (--normalise) and --precision right?"
    )


def _losses(frames: Sequence[_Frame], output: Any) -> list[Tensor]:
    """L of every frame that has not ended."""
    parts = zip(frames, _apart(output, len(frames)), strict=True)
    found = [frame.loss(part) for frame, part in parts if frame.error is None]
    return [loss for loss in found if loss is not None]


def _moved(frames: Sequence[_Frame], z: Tensor, gradient: Tensor) -> Tensor:
    if len(frames) == 1:
        return frames[0].moved(z, gradient)
    parts = zip(
        frames, z.tensor_split(len(frames)), gradient.tensor_split(len(frames)), strict=True
    )
    return torch.cat([frame.moved(*part) for frame, *part in parts])


def _apart(structure: Any, frames: int) -> list[Any]:
    """What z or the network's output is for each frame; for one frame, whatever it may be."""
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


def _gradient(loss: Tensor, z: Tensor, split: Split) -> Tensor:
    gradient = gradient_at(z, loss * _HALF_SCALE if split.in_half else loss)
    if gradient is None:
        raise LayerError(
            f"layer {split.layer!r}: no gradient comes back from the prediction to it; either the"
            " prediction does not depend on it or the network's forward runs under"
            " torch.no_grad, inference_mode or detach (take that out, or cut at a later layer)"
        )
    return gradient / _HALF_SCALE if split.in_half else gradient
