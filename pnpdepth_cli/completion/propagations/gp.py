"""Propagation by a Gaussian process (kriging)."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.completion.gaussian_process import fit, predict, predict_at, predict_with_sigma
from pnpdepth_cli.completion.propagation import Propagation
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.points import SparsePoints


def _at(field: ResidualField, queries: SparsePoints) -> Tensor:
    """With many points, each query is predicted from the points nearest to it."""
    return predict_at(field, queries.xy, field.features_at(queries))


propagation = Propagation(
    title="Gaussian process",
    fit=fit,
    dense=predict,
    at=_at,
    with_sigma=predict_with_sigma,
)
