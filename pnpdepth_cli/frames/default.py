"""The default method for one frame, and the one check of it.

A fifth of the points, whole scan lines of a LiDAR, is hidden once. The networks and linear
interpolation predict them from the others, and what depends on the image alone is computed once
for both passes. Only where this shows that the image does not help, the result moves to one that
uses it less. The same points calibrate `frames.uncertainty`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.completion.folds import spatial_folds
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.outliers import far_points, inlier_weights
from pnpdepth_cli.completion.propagation import propagate, propagate_at
from pnpdepth_cli.completion.residual_field import Kernel
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Check, Frame, Refined, is_dense
from pnpdepth_cli.frames.fuse import Fused, Fusion, Member, weighted_mean
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_lines, scan_pattern

ALIGNED, FUSED, UPDATED, PROPAGATED = "aligned", "fused", "updated", "propagated"
"""The stages of the method."""
LINEAR, RESULT = "linear", "result"
"""Names in `Check.predicted` besides the stages."""
FOLDS = 5
"""One of so many folds is hidden."""
MIN_POINTS = 5
"""With fewer points none is hidden."""
MOST_HIDDEN = 1000
"""Of more hidden points a random part is predicted."""

GAIN = 0.75
"""Standard errors by which the method has to be better than linear interpolation at the hidden
points. Else the image may not belong to the points, and half of the result leaves it out."""
ENOUGH_FOR_GAIN = 60
"""Fewer hidden points show no gain even where there is one."""
CLEAR_GAIN = 1.75
"""An image whose edges call it unrelated is still used in full if the method is better by so many
standard errors. In 12 draws of RealSense frames, which are unrelated, the gain is at most 1.5; in
the one draw of ICL-NUIM that is wrongly called so it is 3.1."""
MANY_OUTLIERS = 0.05
"""If a larger fraction of the points was left out as outliers, no gain is required: outliers that
remain among the points hide it."""
LOSS = 2.0
"""Standard errors by which it has to be worse for linear interpolation to be half of the result."""
ENOUGH_FOR_LOSS = 20
"""Fewer hidden points decide nothing."""
GAP_FACTOR = 3.0
"""A network that takes the points serves as a prior if its error at the hidden points is at most
the other networks', or so many times that where whole scan lines are hidden: these are gaps that
the sensor does not leave. On even KITTI frames pncnn has 1.9 to 2.5 times the error of `compact`
there, and less with all points."""
COMPLETION_WEIGHT = 0.75
"""Weight of such a network's own depth in the result. On even KITTI frames this changes its MAE by
−0.9 (pncnn) and −2.8 % (nconv), the RMSE by +1.4 and −0.2 %; without it by +2 and −3, +13 and 0."""


@dataclass(frozen=True, kw_only=True)
class _Hidden:
    """The frame without its hidden points, refined."""

    points: SparsePoints
    weights: Tensor
    frame: Frame
    fused: Fused
    rejected: tuple[Member, ...]


def refine_default(fusion: Fusion, frame: Frame, *, seed: int = 0) -> Refined:
    """Returns the frame refined by the default method.

    Args:
        seed: Of the hidden points.

    Raises:
        PnpDepthError: The user's network gives no depth.
    """
    fusion.next_image()
    inliers, user = fusion.without_outliers(frame)
    hidden = _hidden(fusion, inliers, torch.from_numpy(user.before), seed)
    rejected = () if hidden is None else hidden.rejected
    fused = fusion.fuse(inliers, user=user, rejected=rejected)
    if fused.weighed is not None and not is_dense(inliers.points):
        inliers = inliers.without(far_points(fused.weighed, inliers.points))
    kind = propagation_of(inliers.points)
    propagated = propagate(fused.after, inliers.points, inliers.rgb, kind=kind)
    check, notes = None, tuple[str, ...]()
    if left_out := len(frame.points) - len(inliers.points):
        notes = (
            f"outliers: {left_out:,} of {len(frame.points):,} points left out, inconsistent with"
            " the others",
        )
    completion = _completion(fusion, fused, rejected)
    depth = final = _with_completion(propagated.depth, completion)
    if hidden is not None:
        check = _check(fusion, hidden, kind, propagated.kernel)
        if not completion:  # hidden lines are gaps that such a network was not trained with
            depth, check, moved = _moved(fusion, inliers, hidden, depth, check)
            notes += moved
    stages = {ALIGNED: user.before, FUSED: fused.before.numpy(), UPDATED: fused.after.numpy()}
    return replace(
        fused.user,
        after=depth.numpy(),
        used=inliers.points,
        stages=stages | {PROPAGATED: final.numpy()},
        check=check,
        notes=(*fused.user.notes, *notes),
    )


def propagation_of(points: SparsePoints) -> str:
    """Returns how the residual at these points is propagated, a name in `choices.PROPAGATIONS`.

    Of scan lines by "local": on even KITTI frames its MAE is 1.9 % and its RMSE 1.7 % below those
    of "gp", which is 0 to 28 % below it with points at random pixels.
    """
    return "local" if scan_pattern(points.xy.cpu().numpy(), points.size).has_scan_lines else "gp"


def check_fixed(
    refined: Refined, again: Refined, kept: SparsePoints, hidden: SparsePoints
) -> Check:
    """Returns the check of a fixed method that was run with all points, and with those kept."""
    before, after = (torch.from_numpy(depth) for depth in (again.before, again.after))
    return Check(
        hidden=hidden,
        kept=kept,
        network=before,
        weights=_inlier_weights(hidden, torch.from_numpy(refined.after)),
        predicted={
            ALIGNED: hidden.sample(before),
            LINEAR: linear(kept, hidden.xy),
            RESULT: hidden.sample(after),
        },
    )


def _completion(fusion: Fusion, fused: Fused, rejected: Collection[Member]) -> list[Tensor]:
    """The depths (H, W) of networks that take points and serve as priors."""
    return [
        torch.from_numpy(fused.alone[member].before)
        for member in fusion.completing
        if member in fused.alone and member not in rejected
    ]


def _with_completion(depth: Tensor, completion: Sequence[Tensor]) -> Tensor:
    """Depth (…) with the depths of completion networks."""
    if not completion:
        return depth
    weight = COMPLETION_WEIGHT / len(completion)
    return weighted_mean([(depth, 1 - COMPLETION_WEIGHT), *((own, weight) for own in completion)])


def split_hidden(points: SparsePoints, seed: int) -> tuple[SparsePoints, SparsePoints] | None:
    """Returns (kept points, hidden points); None where they are too few."""
    if len(points) < MIN_POINTS:
        return None
    held = spatial_folds(points, FOLDS, seed=seed) == 0
    if not 0 < int(held.sum()) < len(points):
        return None
    (numbers,) = held.nonzero(as_tuple=True)
    drawn = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(seed))
    return points.select(~held), points.select(numbers[drawn[:MOST_HIDDEN]])


def _hidden(fusion: Fusion, frame: Frame, prediction: Tensor, seed: int) -> _Hidden | None:
    """The frame refined without its hidden points; None where they are too few or it fails."""
    parts = split_hidden(frame.points, seed)
    if parts is None:
        return None
    kept, points = parts
    without = frame.with_points(kept)
    completing = fusion.completing
    rejected: tuple[Member, ...] = ()
    try:
        fused = fusion.fuse(without, rejected=completing, updates=False)
        if completing:
            rejected = _rejected(fused, completing, frame.points, points)
            if len(rejected) < len(completing):
                fused = fusion.fuse(without, user=fused.user, rejected=rejected, updates=False)
    except PnpDepthError:
        return None
    weights = _inlier_weights(points, prediction)
    return _Hidden(points=points, weights=weights, frame=without, fused=fused, rejected=rejected)


def _rejected(
    fused: Fused, completing: list[Member], points: SparsePoints, hidden: SparsePoints
) -> tuple[Member, ...]:
    """The networks that take points whose depth serves as no prior."""
    lines = scan_lines(points.xy.cpu().numpy(), points.size)
    factor = 1.0 if lines is None else GAP_FACTOR

    def error(depth: Tensor) -> float:
        return float((hidden.sample(depth) - hidden.depth).abs().mean())

    limit = factor * error(fused.after)
    alone = fused.alone
    return tuple(
        member
        for member in completing
        if member not in alone or error(torch.from_numpy(alone[member].before)) > limit
    )


def _inlier_weights(points: SparsePoints, prediction: Tensor) -> Tensor:
    """(N,) 0…1: the weight of each point in the check; outliers would decide it."""
    at_points = points.sample(prediction)
    residual = points.depth.double().log() - at_points.clamp_min(1e-6).double().log()
    weights = torch.where(at_points > 0, inlier_weights(points, residual), 0.0).float()
    return weights if bool(weights.any()) else torch.ones_like(weights)


def _check(fusion: Fusion, hidden: _Hidden, kind: str, kernel: Kernel | None) -> Check:
    points, frame, fused = hidden.points, hidden.frame, hidden.fused
    propagated = propagate_at(
        fused.after, frame.points, frame.rgb, points.xy, kind=kind, kernel=kernel
    )
    own = [points.sample(depth) for depth in _completion(fusion, fused, hidden.rejected)]
    propagated = _with_completion(propagated, own)
    network = torch.from_numpy(fused.user.before)
    predicted = {
        ALIGNED: points.sample(network),
        FUSED: points.sample(fused.after),
        PROPAGATED: propagated,
        LINEAR: linear(frame.points, points.xy),
        RESULT: propagated,
    }
    return Check(
        hidden=points,
        kept=frame.points,
        network=network,
        weights=hidden.weights,
        predicted=predicted,
    )


def _moved(
    fusion: Fusion,
    frame: Frame,
    hidden: _Hidden,
    depth: Tensor,
    check: Check,
) -> tuple[Tensor, Check, tuple[str, ...]]:
    """The result (H, W), moved away from an image that does not fit its points, and why."""
    count, gain = len(check.hidden), check.gain(PROPAGATED, LINEAR)
    outliers = 0 if frame.outliers is None else len(frame.outliers)
    shows_gain = count >= ENOUGH_FOR_GAIN and outliers <= MANY_OUTLIERS * len(frame.points)
    worse = count >= ENOUGH_FOR_LOSS and gain < (GAIN if shows_gain else -LOSS)
    if not worse and not (frame.unrelated and gain < CLEAR_GAIN):
        return depth, check, ()
    at_points, what = check.predicted[PROPAGATED], []
    blind = _blind(fusion, frame, hidden)
    if blind is not None:
        depth = weighted_mean([(depth, 1.0), (blind[0], 1.0)])
        at_points = weighted_mean([(at_points, 1.0), (blind[1], 1.0)])
        what.append("half of the result leaves the image out")
    if worse and gain < -LOSS:
        depth = weighted_mean([(depth, 1.0), (linear(frame.points), 1.0)])
        at_points = weighted_mean([(at_points, 1.0), (check.predicted[LINEAR], 1.0)])
        what.append("half is linear interpolation")
    if not what:
        return depth, check, ()
    error, of_linear = check.error(PROPAGATED), check.error(LINEAR)
    reason = (
        f"with it the error at {count:,} hidden points is {error:.4f}, linear interpolation has"
        f" {of_linear:.4f}"
        if worse
        else "depth changes at its edges no more often than by chance"
    )
    note = (
        f"warning: the image does not seem to belong to these points: {reason};"
        f" {' and '.join(what)}; see --registration"
    )
    return depth, check.with_prediction(RESULT, at_points), (note,)


def _blind(fusion: Fusion, frame: Frame, hidden: _Hidden) -> tuple[Tensor, Tensor] | None:
    """Depth of a grey image (H, W), and at the hidden points (M,), by a network with points."""
    takers = [member for member in fusion.members if member.takes_prior]
    if frame.rgb is None or not takers:
        return None
    fusion.next_image()
    grey = torch.full_like(frame.rgb, 0.5)
    results = []
    try:
        for points in (frame, hidden.frame):
            without = replace(points, rgb=grey)
            refined = fusion.refine_alone(takers[0], without)
            results.append(torch.from_numpy(refined.after))
    except PnpDepthError:
        return None
    finally:
        fusion.next_image()
    whole, part = results
    kept, xy = hidden.frame.points, hidden.points.xy
    return (
        propagate(whole, frame.points, grey).depth,
        propagate_at(part, kept, grey, xy),
    )
