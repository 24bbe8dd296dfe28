"""The residual at the points, diffused over the image up to the edges.

With r the residual in log depth at the points and c the correction on a grid of nodes,

    min over c of  Σ_points (c(p) − r_p)² + λ·Σ_edges w_ij·(c_i − c_j)² + ε·Σ_i (c_i − median r)²,

w_ij = 1 / (position² + (u_i − u_j)² + (colour_i − colour_j)²), each over its length: one sparse
linear system, as in Levin, Lischinski, Weiss, "Colorization using optimization", 2004, with the
weights of Perona and Malik 1990. The fewer the points, the coarser the grid: each node between two
points counts as one more step, so that on a fine grid the residual stays close to the points.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.residual_field import ResidualField

STIFFNESS = 1e-4
"""λ, with the weights at 1 where neighbours look the same."""
EDGE_DEPTH, EDGE_COLOUR = 0.1, 0.5
"""Differences of neighbouring nodes, in standard deviations of the image, that halve a weight."""

_NODES_PER_POINT, _MIN_NODES, _MAX_NODES = 10, 2_000, 30_000
_REGULARISATION = 1e-9  # ε: for nodes that no point reaches


def diffuse(field: ResidualField) -> Tensor:
    """Returns the residual (H, W) float32 at every pixel."""
    from scipy.sparse import coo_array, csc_array, eye_array
    from scipy.sparse.csgraph import laplacian
    from scipy.sparse.linalg import splu

    height, width = field.points.size
    wanted = min(max(_NODES_PER_POINT * len(field.points), _MIN_NODES), _MAX_NODES)
    shrink = min(1.0, math.sqrt(wanted / (height * width)))
    rows, columns = max(1, round(height * shrink)), max(1, round(width * shrink))
    nodes = F.interpolate(torch.stack(field.features)[None], (rows, columns), mode="area")[0]
    number = torch.arange(rows * columns).reshape(rows, columns)
    first = torch.cat([number[:, :-1].flatten(), number[:-1].flatten()])
    second = torch.cat([number[:, 1:].flatten(), number[1:].flatten()])
    node_features = nodes.flatten(1).t().double()
    step = node_features[first] - node_features[second]
    apart = (step[:, 2] / EDGE_DEPTH).square()
    apart = apart + (step[:, 3:] / EDGE_COLOUR).square().sum(dim=1)
    weight = STIFFNESS / (1 + apart)
    total = rows * columns
    ends = torch.cat([first, second]).numpy(), torch.cat([second, first]).numpy()
    adjacent = coo_array((weight.repeat(2).numpy(), ends), shape=(total, total)).tocsr()
    reads = _readings(field, rows, columns)
    middle = float(field.residual.median())
    system = reads.T @ reads + laplacian(adjacent) + _REGULARISATION * eye_array(total)
    right = reads.T @ (field.residual - middle).numpy()
    # The matrix is positive definite: diagonal pivots are stable, and keep the factors sparse.
    mode = {"SymmetricMode": True}
    order = "MMD_AT_PLUS_A"
    factors = splu(csc_array(system), permc_spec=order, diag_pivot_thresh=0.0, options=mode)
    solution = torch.from_numpy(factors.solve(right)).float()
    correction = solution.reshape(1, 1, rows, columns) + middle
    return F.interpolate(correction, (height, width), mode="bilinear", align_corners=False)[0, 0]


def _readings(field: ResidualField, rows: int, columns: int) -> Any:
    """The sparse matrix (N, nodes) that reads a map of the nodes at the points, bilinearly."""
    from scipy.sparse import coo_array

    xy = field.points.resized(rows, columns).xy.double()
    x, y = xy[:, 0].clamp(0, columns - 1), xy[:, 1].clamp(0, rows - 1)
    left, top = x.floor(), y.floor()
    fx, fy = x - left, y - top
    right, bottom = x.ceil(), y.ceil()
    nodes = torch.stack([row * columns + x for row in (top, bottom) for x in (left, right)])
    weights = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    which = torch.arange(len(xy)).repeat(4, 1)
    values = (weights.flatten().numpy(), (which.flatten().numpy(), nodes.long().flatten().numpy()))
    return coo_array(values, shape=(len(xy), rows * columns)).tocsr()
