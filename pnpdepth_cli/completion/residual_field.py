"""The residual field of one prediction: what the sparse points say of it, at every pixel.

The residual is r = log measured − log predicted depth. It is known at the points. Elsewhere it is
predicted from the points that are no outliers, and exp(r) · prediction is the depth that agrees
with them. That depth is positive, and r stays within its values at the points.

A prediction of 0, or not finite, is unknown and stays 0. Points there and points outside the image
have no effect. Of points at the same coordinates the nearest counts.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from pnpdepth_cli.choices import PROPAGATIONS
from pnpdepth_cli.completion import outliers
from pnpdepth_cli.completion.gaussian_process import Residuals, residuals_of
from pnpdepth_cli.points import SparsePoints


class ResidualField:
    """How much deeper the scene is than one prediction says: log measured − log predicted depth.

    It is known at some points. What several steps need, such as which points are outliers, is
    computed when it is first asked for, and once.

    Args:
        prediction: Depth (H, W) in metres; 0 or not finite = unknown.
        points: The points, in pixels of the image.
        rgb: Image (3, H, W) in 0…1; None: colour has no effect.
    """

    def __init__(self, prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> None:
        self.prediction = prediction
        self._known = prediction.isfinite() & (prediction > 0)
        self._rgb = rgb
        self.points = points

    def is_of(self, prediction: Tensor, points: SparsePoints) -> bool:
        """Returns whether the field is that of these very objects, not only of equal ones."""
        return prediction is self.prediction and points is self.points

    @functools.cached_property
    def at_points(self) -> Residuals:
        """The residuals at the points that have a prediction.

        Raises:
            NoPointsError: No point has one.
        """
        return residuals_of(self.prediction, self.points, self._rgb)

    @functools.cached_property
    def at_inliers(self) -> Residuals:
        """The residuals at the points that are no outliers.

        Raises:
            NoPointsError: No point has a prediction.
        """
        return outliers.without_outliers(self.at_points)

    @functools.cached_property
    def outliers(self) -> Tensor:
        """(N,) bool: which points are outliers; none unless some clearly are."""
        used_keys = _coordinate_keys(self.at_points.points)
        inlier_keys = _coordinate_keys(self.at_inliers.points)
        outlier_keys = used_keys[~torch.isin(used_keys, inlier_keys)]
        # Of points at the same coordinates one has a residual, which speaks for all of them.
        all_keys = _coordinate_keys(self.points.tensors())
        return torch.isin(all_keys, outlier_keys).to(self.points.xy.device)

    def residual(self, queries: SparsePoints | None = None, *, kind: str = "gp") -> Tensor:
        """Returns log measured − log predicted depth at every pixel, (H, W), or at M points, (M,).

        It is predicted from the points that are no outliers, and lies between their least and
        largest residual.

        Args:
            queries: Points at whose coordinates the residual is wanted. None: every pixel.
            kind: Name of the way to predict it, in `choices.PROPAGATIONS`.

        Raises:
            NoPointsError: No point has a prediction.
        """
        inliers = self.at_inliers
        residual: Tensor = PROPAGATIONS[kind](inliers, queries)
        return residual.clamp(float(inliers.residual.min()), float(inliers.residual.max()))

    def depth(self, xy: Tensor | None = None, *, kind: str = "gp") -> Tensor:
        """Returns the depth that agrees with the points: exp(residual) · prediction.

        It is float32 metres, 0 = unknown.

        Args:
            xy: Pixel coordinates (M, 2) where depth (M,) is wanted. None: every pixel, (H, W).
            kind: Name of the way to predict the residual, in `choices.PROPAGATIONS`; with "none"
                the prediction itself is returned.

        Raises:
            NoPointsError: No point has a prediction, except with "none".
        """
        queries = None
        if xy is None:
            predicted = torch.where(self._known, self.prediction, 0.0)
        else:
            # Depth between pixels is unknown where one of these is: NaN spreads, and becomes 0.
            queries = SparsePoints(xy=xy, depth=xy.new_ones(len(xy)), size=self.points.size)
            nan_where_unknown = torch.where(self._known, self.prediction, torch.nan)
            predicted = queries.sample(nan_where_unknown).nan_to_num(0.0)
            queries = queries.tensors()
        if kind == "none":
            return predicted.float()
        residual = self.residual(queries, kind=kind)
        return (predicted * residual.exp().to(predicted.device)).float()


def _coordinate_keys(points: SparsePoints) -> Tensor:
    """(N,) int64, one number for each point, equal for equal coordinates.

    It has the 32 bits of x and the 32 bits of y.
    """
    return points.xy.float().contiguous().view(torch.int64).flatten()
