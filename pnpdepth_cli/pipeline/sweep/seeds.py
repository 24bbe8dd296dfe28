"""How much a sweep's means depend on the draw of the points."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
MIN_SEEDS = 3
"""An interval of fewer draws says nothing: of two it is 13 standard errors wide."""
_FIGURES = ("plain", "linear", "refined", "gain")


def over_seeds(cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the MAE over the seeds of the points, for each setting of the other parameters.

    Every figure has a mean and the ends of its 95 % interval (Student's t over the draws, of each
    of which the mean over all frames is taken). The interval covers the choice of the points, not
    that of the frames.

    Args:
        cells: Of one study; those without a parameter `seed`, or without scores, are left out.
    """
    groups: dict[tuple[tuple[str, str], ...], list[Mapping[str, float]]] = {}
    for cell in cells:
        parameters, measures = cell["parameters"], cell["measures"]
        if "seed" in parameters and measures is not None:
            others = tuple((name, value) for name, value in parameters.items() if name != "seed")
            groups.setdefault(others, []).append(measures["mae"])
    return [
        {
            "parameters": dict(others),
            "seeds": len(drawn),
            "mae": {name: _interval([each[name] for each in drawn]) for name in _FIGURES},
        }
        for others, drawn in groups.items()
        if len(drawn) >= MIN_SEEDS
    ]


def _interval(values: Sequence[float | None]) -> dict[str, float | None]:
    """The mean and the ends of its interval; None where a value is missing."""
    numbers = np.array([math.nan if value is None else value for value in values])
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(numbers) - 1) * stats.sem(numbers)
    ends = {"mean": numbers.mean(), "low": numbers.mean() - half, "high": numbers.mean() + half}
    return {name: float(end) if math.isfinite(end) else None for name, end in ends.items()}
