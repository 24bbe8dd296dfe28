"""Scores a depth map by the measures that are formulas of its pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from pnpdepth_cli.measures import MEASURES, Measure


@dataclass(frozen=True, kw_only=True)
class Scores(Mapping[str, float]):
    """Errors of a prediction over the pixels with known ground truth and valid prediction.

    A mapping from the keys of `pnpdepth_cli.measures.MEASURES`, such as `scores["rmse"]`.
    """

    values_by_key: Mapping[str, float]
    """The measures by key; NaN where no pixel is scored."""
    pixels: int
    """Number of scored pixels."""
    coverage: float
    """Scored pixels over pixels with known ground truth."""

    def __getitem__(self, key: str) -> float:
        """Returns the measure with this key."""
        return self.values_by_key[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_by_key)

    def __len__(self) -> int:
        return len(self.values_by_key)

    def to_json(self) -> dict[str, int | float | None]:
        """Returns the measures, the number of pixels and the coverage by their names."""
        return {**self, "pixels": self.pixels, "coverage": self.coverage}


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
        values_by_key={
            measure.key: float(measure.of_pixels(p, g))
            for measure in measures
            if measure.of_pixels is not None
        },
        pixels=len(g),
        coverage=len(g) / int(known.sum()) if known.any() else math.nan,
    )
