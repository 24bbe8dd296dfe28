"""The residual at the sparse points, propagated to every pixel without training.

With r the residual in log depth, the result is exp(r) · prediction, so that it is positive
everywhere. r stays within its values at the points. Outliers are removed first.

The ways to predict r are the entries of `TABLE`, listed in `choices.PROPAGATIONS`. A prediction
of 0, or not finite, is unknown and stays 0. Points there and points outside the image have no
effect. Of points at the same coordinates the nearest counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.choices import PROPAGATIONS
from pnpdepth_cli.completion import gaussian_process
from pnpdepth_cli.completion.diffusion import diffuse
from pnpdepth_cli.completion.local_lines import local_lines
from pnpdepth_cli.completion.outliers import without_outliers
from pnpdepth_cli.completion.residual_field import DEPTH, Kernel, ResidualField, residual_field
from pnpdepth_cli.points import SparsePoints

NONE = "none"
"""The name of no propagation at all."""


@dataclass(frozen=True, kw_only=True)
class Propagation:
    """A method that predicts the residual away from the points.

    `dense` and `at` take a field whose kernel `fit` has chosen.
    """

    title: str  # what it does, in a few words
    fit: Callable[[ResidualField], ResidualField] = lambda field: field
    """Chooses the field's kernel."""
    dense: Callable[[ResidualField], Tensor]  # residual (H, W) float32 at every pixel
    at: Callable[[ResidualField, SparsePoints], Tensor] | None = None
    """Residual (M,) at the coordinates of M points. None: it is sampled from `dense`."""


def _residual_by_lines(field: ResidualField, queries: SparsePoints | None = None) -> Tensor:
    """The residual by lines over the predicted log depth, (H, W) or at the queries (M,)."""
    xy = None if queries is None else queries.xy
    depth = field.features[DEPTH] if queries is None else field.features_at(queries)[:, DEPTH]
    at, weights = field.at[:, DEPTH].double(), torch.ones_like(field.residual)
    shift, slope = local_lines(field.points, xy, field.residual, at, weights)
    return (shift + slope * depth).float()


TABLE = {
    "gp": Propagation(
        title="Gaussian process",
        fit=gaussian_process.fit,
        dense=gaussian_process.predict,
        at=lambda field, queries: gaussian_process.predict_at(
            field, queries.xy, field.features_at(queries)
        ),
    ),
    "local": Propagation(
        title="lines through the nearest points",
        dense=_residual_by_lines,
        at=_residual_by_lines,
    ),
    "diffusion": Propagation(title="edge-aware diffusion", dense=diffuse),
}
"""The propagations by name, as in `choices.PROPAGATIONS`."""


@dataclass(frozen=True, kw_only=True)
class Propagated:
    """Depth after propagation."""

    depth: Tensor  # (H, W) float32 metres, 0 = unknown
    kernel: Kernel | None = None  # that fits the residual best; None with "none"


def propagate(
    prediction: Tensor, points: SparsePoints, rgb: Tensor | None, *, kind: str = "gp"
) -> Propagated:
    """Returns the prediction with its residual at the points propagated.

    Args:
        prediction: (H, W) metres.
        points: Sparse depth of the same image.
        rgb: (3, H, W) in 0…1, or None.
        kind: A name in `choices.PROPAGATIONS`, or "none".

    Raises:
        NoPointsError: No point has a prediction, except with "none".
    """
    propagation = None if kind == NONE else PROPAGATIONS[kind]
    known = prediction.isfinite() & (prediction > 0)
    if propagation is None:
        return Propagated(depth=torch.where(known, prediction, 0.0).float())
    field = propagation.fit(without_outliers(residual_field(prediction, points, rgb)))
    factor = _clamp(propagation.dense(field), field).exp().to(prediction.device)
    depth = torch.where(known, prediction * factor, 0.0).float()
    return Propagated(depth=depth, kernel=field.kernel)


def propagate_at(
    prediction: Tensor,
    points: SparsePoints,
    rgb: Tensor | None,
    xy: Tensor,
    *,
    kind: str = "gp",
    kernel: Kernel | None = None,
) -> Tensor:
    """Returns the propagated depth (M,) metres at pixel coordinates only; 0 where it is unknown.

    Args:
        prediction: (H, W) metres.
        points: Sparse depth of the same image.
        rgb: (3, H, W) in 0…1, or None.
        xy: (M, 2) pixel coordinates.
        kind: A name in `choices.PROPAGATIONS`, or "none".
        kernel: Kernel of an earlier propagation. None: it is fitted.

        Raises:
            NoPointsError: No point has a prediction, except with "none".
    """
    propagation = None if kind == NONE else PROPAGATIONS[kind]
    queries = SparsePoints(xy=xy, depth=torch.ones_like(xy[:, 0]), size=points.size)
    known = prediction.isfinite() & (prediction > 0)
    predicted = queries.sample(torch.where(known, prediction, torch.nan)).nan_to_num(0.0)
    if propagation is None:
        return predicted.float()
    field = without_outliers(residual_field(prediction, points, rgb))
    field = propagation.fit(field) if kernel is None else replace(field, kernel=kernel)
    queries = queries.tensors()
    if propagation.at is None:
        residual = queries.sample(propagation.dense(field))
    else:
        residual = propagation.at(field, queries)
    return (predicted * _clamp(residual, field).exp().to(predicted.device)).float()


def _clamp(residual: Tensor, field: ResidualField) -> Tensor:
    """The residual within its range at the points."""
    return residual.clamp(float(field.residual.min()), float(field.residual.max()))
