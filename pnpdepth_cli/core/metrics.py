"""Scores a depth map by the measures that are formulas of its pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from pnpdepth_cli.measures import DELTA_THRESHOLDS, MEASURES, Measure, Pixels


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
    predicted: Tensor,
    ground_truth: Tensor,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
) -> Scores:
    """Returns the scores of a prediction against the ground truth.

    Args:
        predicted: Depth in metres, of any shape; 0, negative or not finite where missing.
        ground_truth: Ground truth depth of the same shape, likewise.
        thresholds: Thresholds of δ1 to δ3.
    """
    known = int((ground_truth.isfinite() & (ground_truth > 0)).sum())
    pixels = scored_pixels(predicted, ground_truth, thresholds)
    count = len(pixels.truth)
    return Scores(
        values=measure_pixels(pixels, MEASURES),
        pixels=count,
        coverage=count / known if known else math.nan,
    )


def scored_pixels(
    predicted: Tensor, ground_truth: Tensor, thresholds: tuple[float, float, float]
) -> Pixels:
    """Returns the pixels that have a prediction and ground truth; arguments as of `score`."""
    if predicted.shape != ground_truth.shape:
        raise ValueError(
            f"prediction is {tuple(predicted.shape)}, ground truth {tuple(ground_truth.shape)}"
        )
    scored = predicted.isfinite() & (predicted > 0) & ground_truth.isfinite() & (ground_truth > 0)
    return Pixels(predicted[scored].double(), ground_truth[scored].double(), thresholds)


def measure_pixels(pixels: Pixels, measures: Sequence[Measure]) -> dict[str, float]:
    """Returns those of the measures that are formulas of pixels by their key; NaN of no pixel."""
    return {each.key: float(each.of_pixels(pixels)) for each in measures if each.of_pixels}
