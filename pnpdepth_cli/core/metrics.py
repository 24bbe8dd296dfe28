"""Scores a depth map by the measures that are formulas of its pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from pnpdepth_cli.measures import MEASURES, Measure


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Errors of a prediction over the pixels with known ground truth and valid prediction.

    Each measure of `pnpdepth_cli.measures.MEASURES` is an attribute, such as `scores.rmse`.
    """

    values: Mapping[str, float]
    """The measures by key; NaN where no pixel is scored."""
    pixels: int
    """Number of scored pixels."""
    coverage: float
    """Scored pixels over pixels with known ground truth."""

    def __getattr__(self, key: str) -> float:
        """Returns the measure with this key."""
        values: Mapping[str, float] = self.__dict__.get("values", {})
        if key not in values:
            raise AttributeError(f"there is no measure {key!r}")
        return values[key]

    def to_json(self) -> dict[str, int | float | None]:
        """Returns the measures, the number of pixels and the coverage by their names."""
        return {**self.values, "pixels": self.pixels, "coverage": self.coverage}


def score(
    predicted: Tensor, ground_truth: Tensor, measures: Sequence[Measure] = MEASURES
) -> Scores:
    """Returns the scores of a prediction against the ground truth.

    Args:
        predicted: Depth in metres, of any shape; 0, negative or not finite where missing.
        ground_truth: Ground truth depth of the same shape, likewise.
        measures: Measures, of which those that are formulas of pixels are computed.
    """
    known = ground_truth.isfinite() & (ground_truth > 0)
    scored = known & predicted.isfinite() & (predicted > 0)
    p, g = predicted[scored].double(), ground_truth[scored].double()
    return Scores(
        values={each.key: float(each.of_pixels(p, g)) for each in measures if each.of_pixels},
        pixels=len(g),
        coverage=len(g) / int(known.sum()) if known.any() else math.nan,
    )
