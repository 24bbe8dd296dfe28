"""Propagations of the residual; `pnpdepth_cli.choices.PROPAGATIONS` lists the names."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.completion import gaussian_process
from pnpdepth_cli.completion.diffusion import diffuse
from pnpdepth_cli.completion.propagation import Propagation
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.points import SparsePoints


def _gp_at(field: ResidualField, queries: SparsePoints) -> Tensor:
    """With many points, each query is predicted from the points nearest to it."""
    return gaussian_process.predict_at(field, queries.xy, field.features_at(queries))


TABLE = {
    "gp": Propagation(
        title="Gaussian process",
        fit=gaussian_process.fit,
        dense=gaussian_process.predict,
        at=_gp_at,
    ),
    "diffusion": Propagation(title="edge-aware diffusion", dense=diffuse),
}
