"""The error measures of depth: what each is called, how it is shown, its formula, and of what.

`MEASURES` are computed everywhere; `choices.MEASURES` has those that `eval --columns` computes on
request. A measure is one entry of either. A depth has errors at several stages of its
refinement, on several bases; `score` measures one. Importing this module imports no library.

Sources: Eigen et al. 2014 (RMSE, RMSE of the logarithm, AbsRel = MRE, SqRel, δ < 1.25^k, SILog),
the paper and NYU's tables (log10), the KITTI depth completion benchmark (iRMSE, iMAE), Depth Pro
(Bochkovskii et al., ICLR 2025) and MoGe-2 (Wang et al. 2025) for the boundaries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

from pnpdepth_cli.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    Image = NDArray[np.float32]
    Floats = NDArray[np.float64]

BEFORE = "before"
"""The user's network, aligned with the points."""
UPDATED = "updated"
"""The user's network after the updates of z."""
PROPAGATED = "propagated"
"""The user's network after propagation of the residual."""
ALONE = "alone"
"""The network that takes a prior, without one."""
AFTER = "after"
"""The result."""
LINEAR = "linear"
"""Linear interpolation of all points, which is no stage but is compared with them."""

GT = "ground_truth"
HELD_OUT = "held_out"
VALIDATION = "validation"
USED = "used"
BASES = {
    GT: "against ground truth",
    HELD_OUT: "at held-out points",
    VALIDATION: "at validation points",
    USED: "at points used",
}
"""What errors are measured on, the best first. A change at the points used means nothing."""

DELTA_THRESHOLDS = (1.25, 1.25**2, 1.25**3)
"""Thresholds of δ1 to δ3 (Eigen et al. 2014). The paper's KITTI rows use 1.01^k."""


OfPixels = Callable[["Tensor", "Tensor"], "Tensor"]
"""Function of N pixels that returns a scalar.

It takes predicted and true depth (N,) float64, all positive, in metres."""


def _rms(values: Tensor) -> Tensor:
    return values.square().mean().sqrt()


def _mean_abs(values: Tensor) -> Tensor:
    return values.abs().mean()


def _log(p: Tensor, g: Tensor) -> Tensor:
    return p.log() - g.log()


def _inv(p: Tensor, g: Tensor) -> Tensor:
    """1/p − 1/g, 1/km."""
    return 1000 / p - 1000 / g


def _silog(p: Tensor, g: Tensor) -> Tensor:
    errors = _log(p, g)
    return 100 * _rms(errors - errors.mean())


def _delta(p: Tensor, g: Tensor, threshold: float) -> Tensor:
    """The fraction of pixels whose ratio max(p/g, g/p) is below the threshold."""
    return ((p / g).maximum(g / p) < threshold).double().mean()


@dataclass(frozen=True)
class Measure:
    """A measure: its name, how it is shown, and its formula."""

    key: str
    """Name in files and on the command line."""
    title: str
    unit: str = ""
    """Unit in files."""
    better: Literal["lower", "higher", "neither"] = "lower"
    decimals: int = 4
    percent: bool = False
    """True for a fraction of 1 that tables show in per cent."""
    shown_unit: str = ""
    """Unit in tables; empty: `unit`."""
    shown_factor: float = 1.0
    """Factor from `unit` to the unit in tables."""
    main: bool = False
    """True if short tables have it."""
    of_pixels: OfPixels | None = field(default=None, compare=False, repr=False)
    """Formula of the scored pixels; NaN without any."""
    formula: Callable[..., float] | None = field(default=None, compare=False, repr=False)
    """Function of images, where there is no formula of pixels. None: the measure is from a file.

    It takes predicted and true depth (H, W) in metres, 0 where unknown or not scored. It gives NaN
    where there is no value."""

    @property
    def heading(self) -> str:
        """A title such as `RMSE [m] ↓`."""
        unit = self.shown_unit or self.unit
        arrow = {-1: " ↓", 0: "", 1: " ↑"}[self.sign]
        return f"{self.title} [{unit}]{arrow}" if unit else f"{self.title}{arrow}"

    @property
    def sign(self) -> int:
        """1 if higher is better, −1 if lower is, 0 if neither."""
        return {"lower": -1, "higher": 1, "neither": 0}[self.better]

    def text(self, value: float | None, unit: str = "") -> str:
        """Returns the value as tables show it, followed by a unit; – for NaN and None."""
        if value is None or math.isnan(value):
            return "–"
        if self.percent:
            return f"{value:.{self.decimals}%}"
        return f"{value * self.shown_factor:,.{self.decimals}f} {unit}".rstrip()

    def to_json(self) -> dict[str, object]:
        """Returns all but the formula."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.compare}


def frame_means(frames: Iterable[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Returns the mean of each value over the frames that have it; None where no frame does.

    Args:
        frames: Values of each frame by their key; None and NaN where a frame has none.
    """
    sums: dict[str, tuple[float, int]] = {}
    for values in frames:
        for key, value in values.items():
            total, count = sums.get(key, (0.0, 0))
            if value is not None and math.isfinite(value):
                total += value
                count += 1
            sums[key] = total, count
    return {key: total / count if count else None for key, (total, count) in sums.items()}


def with_thresholds(thresholds: Sequence[float]) -> tuple[Measure, ...]:
    """Returns `MEASURES` with other thresholds of δ1, δ2 and δ3."""
    deltas = (
        Measure(
            f"delta{number}",
            f"δ{number}",
            better="higher",
            percent=True,
            decimals=2,
            main=number == 1,
            of_pixels=partial(_delta, threshold=threshold),
        )
        for number, threshold in enumerate(thresholds, 1)
    )
    return (*_ERRORS, *deltas)


_ERRORS = (
    Measure("rmse", "RMSE", "m", main=True, of_pixels=lambda p, g: _rms(p - g)),
    Measure("mae", "MAE", "m", main=True, of_pixels=lambda p, g: _mean_abs(p - g)),
    Measure("mre", "MRE", main=True, of_pixels=lambda p, g: ((p - g).abs() / g).mean()),
    Measure("sq_rel", "SqRel", "m", of_pixels=lambda p, g: ((p - g).square() / g).mean()),
    Measure("log10", "log10", of_pixels=lambda p, g: 1 / math.log(10) * _mean_abs(_log(p, g))),
    Measure("rmse_log", "RMSE log", of_pixels=lambda p, g: _rms(_log(p, g))),
    Measure("irmse", "iRMSE", "1/km", decimals=2, of_pixels=lambda p, g: _rms(_inv(p, g))),
    Measure("imae", "iMAE", "1/km", decimals=2, of_pixels=lambda p, g: _mean_abs(_inv(p, g))),
    Measure("silog", "SILog", "100·log m", decimals=2, of_pixels=_silog),
)
MEASURES = with_thresholds(DELTA_THRESHOLDS)
"""The measures that are computed everywhere, in the order of all tables."""
COVERAGE = Measure("coverage", "coverage", better="higher", percent=True, decimals=2)
"""The fraction of the ground truth that has a prediction, which stands beside the measures."""


def by_depth(measures: Sequence[Measure], near_m: float, far_m: float) -> tuple[Measure, ...]:
    """Returns the main ones of the measures, of near, middle and far pixels by their true depth.

    Args:
        measures: Such as `MEASURES`.
        near_m: Depth below which a pixel is near, metres.
        far_m: Depth from which on a pixel is far, metres.
    """
    parts = (
        ("near", f"< {near_m:g} m", 0.0, near_m),
        ("middle", f"{near_m:g}–{far_m:g} m", near_m, far_m),
        ("far", f"≥ {far_m:g} m", far_m, math.inf),
    )
    return tuple(
        replace(
            measure,
            key=f"{measure.key}_{name}",
            title=f"{measure.title} {title}",
            main=False,
            of_pixels=partial(_within, of=measure.of_pixels, low_m=low_m, high_m=high_m),
        )
        for name, title, low_m, high_m in parts
        for measure in measures
        if measure.main and measure.of_pixels
    )


def _within(p: Tensor, g: Tensor, of: OfPixels, low_m: float, high_m: float) -> Tensor:
    """The value of the pixels whose true depth lies in [low_m, high_m)."""
    inside = (g >= low_m) & (g < high_m)
    return of(p[inside], g[inside])


_RATIOS = tuple(1.05 + 0.2 * step / 9 for step in range(10))
"""A pixel is on a boundary if its neighbour is farther by such a factor: ten from 1.05 to 1.25."""


def _boundary_f1(predicted: Image, truth: Image) -> float:
    """Scale-invariant F1 of the boundaries as Depth Pro's code prints it; NaN without any pair."""
    import numpy as np

    # Precision and recall are means over four directions; F1 is weighted by the ratio. Depth Pro
    # scores dense ground truth; here pairs with an unknown pixel are left out.
    sides = ((0, 1), (0, -1), (1, 0), (-1, 0))
    both, own, true = _boundary_counts(predicted, truth, sides, margin=0)
    recall = (both / np.maximum(true, 1)).sum(axis=0) / 4
    precision = (both / np.maximum(own, 1)).sum(axis=0) / 4
    return _weigh(2 * recall * precision, recall + precision, _RATIOS)


def _boundary_f1_within(predicted: Image, truth: Image, radius: int) -> float:
    """F1 of the boundaries as MoGe's code prints it, with neighbours within `radius` pixels."""
    # All pairs count together, and F1 is weighted by the ratio − 1. Pixels nearer than the radius
    # to the border are neighbours alone.
    span = range(-radius, radius + 1)
    disc = [(down, right) for down in span for right in span if down**2 + right**2 <= radius**2]
    counts = _boundary_counts(predicted, truth, disc, margin=radius)
    both, own, true = (of_places.sum(axis=0) for of_places in counts)
    return _weigh(2 * both, own + true, [ratio - 1 for ratio in _RATIOS])


def _boundary_counts(
    predicted: Image, truth: Image, offsets: Sequence[tuple[int, int]], *, margin: int
) -> Floats:
    """(3, N, ratios) how many pixels have a farther neighbour, in each of N places of it.

    Pairs of known true depth count that are farther by the ratio in both images, in the prediction,
    and in the truth; NaN without any such pair. In a border as wide as the margin are no pixels but
    neighbours.
    """
    import numpy as np

    height, width = truth.shape
    predicted, truth = (np.pad(image, 1) for image in (predicted, truth))  # unknown around them

    def moved(down: int, right: int) -> tuple[slice, slice]:
        rows = slice(1 + margin + down, 1 + height - margin + down)
        return rows, slice(1 + margin + right, 1 + width - margin + right)

    counts = []
    pairs = 0
    ratios = np.array(_RATIOS)[:, None]
    here = moved(0, 0)
    for offset in offsets:
        # the pixels and their neighbours, and by which factor these are farther
        there = moved(*offset)
        known = (truth[here] > 0) & (truth[there] > 0)
        pairs += int(np.count_nonzero(known))
        factors = []
        for image in (predicted, truth):
            depth = image[here][known].astype(np.float64)
            beside = image[there][known].astype(np.float64)
            factors.append(np.divide(beside, depth, out=np.zeros_like(depth), where=depth > 0))
        is_own, is_true = (factor > ratios for factor in factors)
        counts.append([edges.sum(axis=1) for edges in (is_own & is_true, is_own, is_true)])
    return np.array(counts, np.float64).swapaxes(0, 1) * (1.0 if pairs else math.nan)


def _weigh(hits: Floats, of: Floats, weights: Sequence[float]) -> float:
    """The weighted mean of hits / of, which is 0 where there is nothing."""
    import numpy as np

    return float(np.average(hits / np.where(of > 0, of, 1), weights=weights))


# The measures that are computed on request alone.
BOUNDARY_F1 = Measure("boundary_f1", "boundary F1", better="higher", formula=_boundary_f1)
BOUNDARY_F1_1PX, BOUNDARY_F1_2PX, BOUNDARY_F1_3PX = (
    Measure(
        f"boundary_f1_{radius}px",
        f"boundary F1, {radius} px",
        better="higher",
        formula=partial(_boundary_f1_within, radius=radius),
    )
    for radius in (1, 2, 3)
)


def _within_sigma(predicted: Image, truth: Image, sigma: Image, factor: int) -> float:
    """Fraction of errors that are at most `factor` standard deviations; NaN without any pixel."""
    errors, deviations = _errors_with_sigma(predicted, truth, sigma)
    return float((errors <= factor * deviations).mean()) if len(errors) else math.nan


def _sparsification_error(predicted: Image, truth: Image, sigma: Image) -> float:
    """Area under the sparsification error (Ilg et al., ECCV 2018) in units of the MAE."""
    import numpy as np

    errors, deviations = _errors_with_sigma(predicted, truth, sigma)
    if not len(errors):
        return math.nan
    # the MAE of what remains when the most uncertain pixels are removed, or those of largest error
    removed = np.arange(20) / 20
    kept = np.maximum(1, np.round((1 - removed) * len(errors))).astype(int)
    by_sigma, by_error = (
        np.cumsum(errors[order])[kept - 1] / kept
        for order in (np.argsort(deviations, kind="stable"), np.argsort(errors))
    )
    difference = by_sigma - by_error
    area = (difference[1:] + difference[:-1]).sum() / 2 / 20  # trapezia
    return float(area / by_sigma[0]) if by_sigma[0] else 0.0


def _errors_with_sigma(predicted: Image, truth: Image, sigma: Image) -> tuple[Floats, Floats]:
    """(N,) absolute errors and standard deviations, float64, of the pixels with all three."""
    import numpy as np

    known = (truth > 0) & (predicted > 0) & (sigma > 0)
    errors = np.abs(predicted[known].astype(np.float64) - truth[known])
    return errors, sigma[known].astype(np.float64)


OF_SIGMA = (
    *(
        Measure(
            f"within_{factor}_sigma",
            f"errors within {factor}σ (normal: {normal})",
            better="neither",
            percent=True,
            decimals=1,
            formula=partial(_within_sigma, factor=factor),
        )
        for factor, normal in ((1, "68.3 %"), (2, "95.4 %"))
    ),
    Measure("ause", "AUSE of σ", formula=_sparsification_error),
)
"""The measures of a predicted standard deviation, which frames with one have.

Their functions take the deviation (H, W) in metres too, 0 where unknown."""


DEVKIT_MEASURES = (
    Measure("mae", "MAE", "m", decimals=6, main=True),
    Measure("rmse", "RMSE", "m", decimals=6, main=True),
    Measure("inverse_mae", "inverse MAE", "1/m", decimals=6, main=True),
    Measure("inverse_rmse", "inverse RMSE", "1/m", decimals=6, main=True),
    Measure("log_mae", "log MAE", decimals=6),
    Measure("log_rmse", "log RMSE", decimals=6),
    Measure("scale_invariant_log", "scale invariant log", decimals=6),
    Measure("abs_relative", "abs relative", decimals=6),
    Measure("squared_relative", "squared relative", decimals=6),
)
"""The figures of KITTI's development kit, in its order and with its six decimals.

`commands/evaluation/kitti_devkit.py` computes them. Its squared relative is (p − g)²/g²."""


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
    p = predicted[scored].double()
    g = ground_truth[scored].double()
    return Scores(
        values_by_key={
            measure.key: float(measure.of_pixels(p, g))
            for measure in measures
            if measure.of_pixels is not None
        },
        pixels=len(g),
        coverage=len(g) / int(known.sum()) if known.any() else math.nan,
    )


def parse_keys(text: str) -> tuple[str, ...]:
    """Returns the keys in a text such as `rmse,mae`."""
    return tuple(dict.fromkeys(text.split(",")))


def choose_measures(measures: Sequence[Measure], keys: Sequence[str] | None) -> tuple[Measure, ...]:
    """Returns the measures with these keys, in their order; all for None.

    Raises:
        UsageError: If one is unknown.
    """
    by_key = {measure.key: measure for measure in measures}
    if unknown := [key for key in keys or () if key not in by_key]:
        raise UsageError(f"--columns {unknown[0]} is not one of {', '.join(by_key)}")
    return tuple(by_key[key] for key in (by_key if keys is None else keys))
