"""Scores a depth map by the measures that are functions of sums over pixels.

Either the sums of several images are added (all pixels have equal weight), or the measures are
averaged (all images have equal weight).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pnpdepth_cli.measures import (
    DELTA_THRESHOLDS,
    MEASURES,
    Formula,
    Measure,
    Pixels,
    Term,
    pixel_count,
)

_CHUNK = 1 << 20
"""Pixels processed at once, so that memory is bounded for any image."""


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
    sums = error_sums(predicted, ground_truth, thresholds)
    known, pixels = (int(total) for total in sums[:2])
    values = measures_of(sums).tolist()
    return Scores(
        values={measure.key: value for measure, value in zip(MEASURES, values, strict=True)},
        pixels=pixels,
        coverage=pixels / known if known else math.nan,
    )


def error_sums(
    predicted: Tensor,
    ground_truth: Tensor,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
    measures: Sequence[Measure] = MEASURES,
) -> Tensor:
    """Returns the sums over an image that the measures are functions of, (S,) float64.

    The first is the number of pixels with known ground truth, the second that of scored pixels.
    Sums of more measures begin with those of the first ones.

    Args:
        predicted: Depth in metres, of any shape; 0, negative or not finite where missing.
        ground_truth: Ground truth depth of the same shape, likewise.
        thresholds: Thresholds of δ1 to δ3.
        measures: Measures, of which those with a `Formula` count.
    """
    if predicted.shape != ground_truth.shape:
        raise ValueError(
            f"prediction is {tuple(predicted.shape)}, ground truth {tuple(ground_truth.shape)}"
        )
    terms = _terms_of(measures)
    sums = torch.zeros(1 + len(terms), dtype=torch.float64, device=ground_truth.device)
    predicted, ground_truth = predicted.reshape(-1), ground_truth.reshape(-1)
    for start in range(0, ground_truth.numel(), _CHUNK):
        piece = slice(start, start + _CHUNK)
        p, g = predicted[piece].double(), ground_truth[piece].double()
        known = g.isfinite() & (g > 0)
        scored = known & p.isfinite() & (p > 0)
        pixels = Pixels(p[scored], g[scored], thresholds)
        sums += torch.stack([known.sum().double(), *(term(pixels).sum() for term in terms)])
    return sums


def measures_of(sums: Tensor, measures: Sequence[Measure] = MEASURES) -> Tensor:
    """Returns measures (…, M) of sums (…, S); NaN where no pixel was scored.

    Args:
        sums: Sums from `error_sums` of the same measures.
        measures: Measures, of which the M with a `Formula` count.
    """
    place = {term: number for number, term in enumerate(_terms_of(measures), start=1)}
    values = [
        formula.of_sums(*(sums[..., place[term]] for term in formula.terms))
        for formula in _formulas_of(measures)
    ]
    return torch.stack(values, dim=-1)


def _formulas_of(measures: Sequence[Measure]) -> list[Formula]:
    return [each.formula for each in measures if isinstance(each.formula, Formula)]


def _terms_of(measures: Sequence[Measure]) -> list[Term]:
    """What is summed over pixels, each once, the number of pixels first."""
    terms = [term for formula in _formulas_of(measures) for term in formula.terms]
    return list(dict.fromkeys([pixel_count, *terms]))
