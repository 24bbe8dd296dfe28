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
"""Points of `--holdout`, which nothing uses."""
VALIDATION = "validation"
"""Points that the method itself predicts from the others."""
USED = "used"
"""Points that the depth was fitted to."""
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


def _rms(errors: Tensor) -> Tensor:
    """The root of the mean square of errors (N,)."""
    return errors.square().mean().sqrt()


def _mean_abs(errors: Tensor) -> Tensor:
    """The mean absolute value of errors (N,)."""
    return errors.abs().mean()


def _log(predicted: Tensor, true: Tensor) -> Tensor:
    """(N,) natural logarithm of the predicted depth less that of the true depth."""
    return predicted.log() - true.log()


def _inv(predicted: Tensor, true: Tensor) -> Tensor:
    """(N,) inverse of the predicted depth less that of the true depth, 1/km of depths in metres."""
    return 1000 / predicted - 1000 / true


def _silog(predicted: Tensor, true: Tensor) -> Tensor:
    """100 times the standard deviation of log predicted − log true depth."""
    errors = _log(predicted, true)
    return 100 * _rms(errors - errors.mean())


def _delta(predicted: Tensor, true: Tensor, threshold: float) -> Tensor:
    """The fraction of pixels at which the larger depth is below `threshold` times the smaller."""
    ratios = (predicted / true).maximum(true / predicted)
    return (ratios < threshold).double().mean()


@dataclass(frozen=True)
class Measure:
    """A measure: its name, how it is shown, and its formula."""

    key: str
    """Name in files and on the command line."""
    title: str
    """Name in tables."""
    unit: str = ""
    """Unit in files."""
    better: Literal["lower", "higher", "neither"] = "lower"
    decimals: int = 4
    percent: bool = False
    """Whether values are fractions of 1, which tables show in per cent."""
    shown_unit: str = ""
    """Unit in tables; empty: `unit`."""
    shown_factor: float = 1.0
    """Factor from `unit` to the unit in tables."""
    main: bool = False
    """Whether short tables have it."""
    of_pixels: OfPixels | None = field(default=None, compare=False, repr=False)
    """Formula of the scored pixels; NaN without any."""
    formula: Callable[..., float] | None = field(default=None, compare=False, repr=False)
    """Function of images, where there is no formula of pixels. None: the measure is from a file.

    It takes predicted and true depth (H, W) in metres, 0 where unknown or not scored. It gives NaN
    where there is no value."""

    @property
    def heading(self) -> str:
        """A title such as `RMSE [m] ↓`: the unit in tables, and an arrow to what is better."""
        unit = self.shown_unit or self.unit
        arrow = {-1: " ↓", 0: "", 1: " ↑"}[self.sign]
        return f"{self.title} [{unit}]{arrow}" if unit else f"{self.title}{arrow}"

    @property
    def sign(self) -> int:
        """1 if higher is better, −1 if lower is, 0 if neither."""
        return {"lower": -1, "higher": 1, "neither": 0}[self.better]

    def text(self, value: float | None, unit: str = "") -> str:
        """Returns the value as tables show it, a dash for NaN and None.

        Args:
            value: Value in `unit`.
            unit: Text after the number, except after per cent; empty for none.
        """
        if value is None or math.isnan(value):
            return "–"
        if self.percent:
            return f"{value:.{self.decimals}%}"
        return f"{value * self.shown_factor:,.{self.decimals}f} {unit}".rstrip()

    def to_json(self) -> dict[str, object]:
        """Returns all fields by their names but the formulas."""
        # The formulas are the fields that do not count when measures are compared.
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.compare}


def frame_means(frames: Iterable[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Returns the mean of each value over the frames that have it; None where no frame does.

    Args:
        frames: Values of each frame by their key; None and NaN where a frame has none.
    """
    sums: dict[str, tuple[float, int]] = {}  # sum and number of the values by key
    for values_by_key in frames:
        for key, value in values_by_key.items():
            total, count = sums.get(key, (0.0, 0))
            if value is not None and math.isfinite(value):
                total += value
                count += 1
            sums[key] = total, count
    return {key: total / count if count else None for key, (total, count) in sums.items()}


def with_thresholds(thresholds: Sequence[float]) -> tuple[Measure, ...]:
    """Returns `MEASURES` with other thresholds of δ1, δ2 and δ3.

    Args:
        thresholds: Ratios of two depths, above 1, below which a pixel counts; one for each δ.
    """
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


# p is the predicted depth, g the true depth: (N,) float64, in metres.
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
    """Returns each main measure three times: of the near, the middle and the far pixels alone.

    Which a pixel is follows from its true depth. All measures of near pixels come first.

    Args:
        measures: Measures, such as `MEASURES`.
        near_m: Depth below which a pixel is near, metres.
        far_m: Depth from which on a pixel is far, metres.
    """
    ranges = (
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
            of_pixels=partial(_within, formula=measure.of_pixels, low_m=low_m, high_m=high_m),
        )
        for name, title, low_m, high_m in ranges
        for measure in measures
        if measure.main and measure.of_pixels
    )


def _within(
    predicted: Tensor, true: Tensor, formula: OfPixels, low_m: float, high_m: float
) -> Tensor:
    """The value of a formula over the pixels whose true depth lies in [low_m, high_m).

    Args:
        predicted: (N,) predicted depth, metres.
        true: (N,) true depth, metres.
        formula: Formula of pixels, as of a measure.
        low_m: Least true depth, metres.
        high_m: True depth from which on pixels are left out, metres.
    """
    is_inside = (true >= low_m) & (true < high_m)
    return formula(predicted[is_inside], true[is_inside])


_RATIOS = tuple(1.05 + 0.2 * step / 9 for step in range(10))
"""A pixel is on a boundary if its neighbour is farther by such a factor: ten from 1.05 to 1.25.

They are those of Depth Pro."""


def _boundary_f1(predicted: Image, truth: Image) -> float:
    """Scale-invariant F1 of the boundaries, 0…1, as Depth Pro's code prints it.

    F1 is 2 · recall · precision / (recall + precision) of the pixels on a boundary. NaN if no two
    neighbours have known true depth.

    Args:
        predicted: (H, W) depth, 0 where unknown.
        truth: (H, W) ground truth, 0 where unknown.
    """
    import numpy as np

    # Precision and recall are means over four directions; F1 is a mean over the ratios, weighted by
    # them. Depth Pro scores dense ground truth; here pairs with an unknown pixel are left out.
    sides = ((0, 1), (0, -1), (1, 0), (-1, 0))
    in_both, in_prediction, in_truth = _boundary_counts(predicted, truth, sides, margin=0)
    recall = (in_both / np.maximum(in_truth, 1)).sum(axis=0) / len(sides)
    precision = (in_both / np.maximum(in_prediction, 1)).sum(axis=0) / len(sides)
    return _mean_quotient(2 * recall * precision, recall + precision, _RATIOS)


def _boundary_f1_within(predicted: Image, truth: Image, radius: int) -> float:
    """F1 of the boundaries, 0…1, as MoGe's code prints it.

    F1 is twice the number of pixels on a boundary in both images, over the sum of their numbers in
    the prediction and in the truth. NaN if no two neighbours have known true depth.

    Args:
        predicted: (H, W) depth, 0 where unknown.
        truth: (H, W) ground truth, 0 where unknown.
        radius: Largest distance of a pixel's neighbours, pixels.
    """
    # All pairs count together, and F1 is a mean over the ratios, weighted by ratio − 1. A pixel
    # nearer to the border of the image than the radius counts as a neighbour only.
    span = range(-radius, radius + 1)
    disc = [(down, right) for down in span for right in span if down**2 + right**2 <= radius**2]
    counts = _boundary_counts(predicted, truth, disc, margin=radius)
    in_both, in_prediction, in_truth = (of_offsets.sum(axis=0) for of_offsets in counts)
    weights = [ratio - 1 for ratio in _RATIOS]
    return _mean_quotient(2 * in_both, in_prediction + in_truth, weights)


def _boundary_counts(
    predicted: Image, truth: Image, offsets: Sequence[tuple[int, int]], *, margin: int
) -> Floats:
    """(3, offsets, ratios) number of pixels on a boundary towards the neighbour at each offset.

    A pixel is on a boundary if its neighbour is farther by one of `_RATIOS`. Only pairs whose true
    depths are both known count. The three numbers are of pixels that are on a boundary in both
    images, in the prediction, and in the truth. All are NaN if there is no pair.

    Args:
        predicted: (H, W) depth, 0 where unknown.
        truth: (H, W) ground truth, 0 where unknown.
        offsets: Rows down and columns right from a pixel to its neighbour.
        margin: Width in pixels of the border of the image whose pixels are neighbours only.
    """
    import numpy as np

    # A neighbour may lie one pixel outside of the image, where depth is unknown. So the image
    # begins at row and column 1 of the padded one.
    height, width = truth.shape
    predicted, truth = (np.pad(image, 1) for image in (predicted, truth))

    def window_at(down: int, right: int) -> tuple[slice, slice]:
        """Rows and columns of all pixels inside the margin, moved by an offset."""
        rows = slice(1 + margin + down, 1 + height - margin + down)
        columns = slice(1 + margin + right, 1 + width - margin + right)
        return rows, columns

    counts = []
    pair_count = 0
    ratios = np.array(_RATIOS)[:, None]
    pixels = window_at(0, 0)
    for offset in offsets:
        # The pairs of known true depth.
        neighbours = window_at(*offset)
        is_known = (truth[pixels] > 0) & (truth[neighbours] > 0)
        pair_count += int(np.count_nonzero(is_known))
        # By which factor the neighbour is farther, in each image; 0 where depth is unknown.
        factors = []
        for image in (predicted, truth):
            depth = image[pixels][is_known].astype(np.float64)
            beside = image[neighbours][is_known].astype(np.float64)
            factors.append(np.divide(beside, depth, out=np.zeros_like(depth), where=depth > 0))
        # (ratios, pairs) whether it is a boundary of this ratio.
        in_prediction, in_truth = (factor > ratios for factor in factors)
        in_both = in_prediction & in_truth
        counts.append([edges.sum(axis=1) for edges in (in_both, in_prediction, in_truth)])
    by_image = np.array(counts, np.float64).swapaxes(0, 1)
    return by_image if pair_count else np.full_like(by_image, math.nan)


def _mean_quotient(numerators: Floats, denominators: Floats, weights: Sequence[float]) -> float:
    """The weighted mean of numerators / denominators; 0 / 0 counts as 0.

    Args:
        numerators: (N,), each 0 where its denominator is 0.
        denominators: (N,), none below 0.
        weights: N weights, of any sum.
    """
    import numpy as np

    divisors = np.where(denominators > 0, denominators, 1)
    return float(np.average(numerators / divisors, weights=weights))


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


_SPARSIFICATION_STEPS = 20
"""Steps in which pixels are removed, 5 % of them in each."""


def _within_sigma(predicted: Image, truth: Image, sigma: Image, factor: int) -> float:
    """Fraction of pixels whose error is at most `factor` times their σ; NaN without any pixel.

    All images are (H, W) in metres, 0 where unknown; sigma is the predicted standard deviation.
    """
    errors, deviations = _errors_with_sigma(predicted, truth, sigma)
    return float((errors <= factor * deviations).mean()) if len(errors) else math.nan


def _sparsification_error(predicted: Image, truth: Image, sigma: Image) -> float:
    """Area under the sparsification error (Ilg et al., ECCV 2018) in units of the MAE.

    The sparsification error is the MAE without the most uncertain pixels, less the MAE without as
    many pixels of largest error. It is 0 for a σ that orders the pixels as their errors do. NaN
    without any pixel.

    All images are (H, W) in metres, 0 where unknown; sigma is the predicted standard deviation.
    """
    import numpy as np

    errors, deviations = _errors_with_sigma(predicted, truth, sigma)
    if not len(errors):
        return math.nan
    # How many pixels are kept in each step, all in the first.
    removed = np.arange(_SPARSIFICATION_STEPS) / _SPARSIFICATION_STEPS
    kept = np.maximum(1, np.round((1 - removed) * len(errors))).astype(int)
    # Their MAE, when the most uncertain pixels are removed, and those of largest error.
    by_sigma, by_error = (
        np.cumsum(errors[order])[kept - 1] / kept
        for order in (np.argsort(deviations, kind="stable"), np.argsort(errors))
    )
    difference = by_sigma - by_error
    area = (difference[1:] + difference[:-1]).sum() / 2 / _SPARSIFICATION_STEPS  # of trapezia
    mae = by_sigma[0]
    return float(area / mae) if mae else 0.0


def _errors_with_sigma(predicted: Image, truth: Image, sigma: Image) -> tuple[Floats, Floats]:
    """(N,) absolute errors and (N,) standard deviations of the pixels where all three are known.

    The images are (H, W) in metres, 0 where unknown; the results are float64 in metres.
    """
    import numpy as np

    is_known = (truth > 0) & (predicted > 0) & (sigma > 0)
    errors = np.abs(predicted[is_known].astype(np.float64) - truth[is_known])
    return errors, sigma[is_known].astype(np.float64)


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
        """Returns the measures by key, and the number of pixels and the coverage by name."""
        return {**self, "pixels": self.pixels, "coverage": self.coverage}


def score(
    predicted: Tensor, ground_truth: Tensor, measures: Sequence[Measure] = MEASURES
) -> Scores:
    """Returns the scores of a prediction against the ground truth.

    Args:
        predicted: Depth in metres, of any shape; 0, negative or not finite where unknown.
        ground_truth: Ground truth of the same shape, in metres and unknown likewise.
        measures: Measures to compute; those without a formula of pixels are left out.
    """
    # The pixels where both depths are known, in 64 bits.
    has_truth = ground_truth.isfinite() & (ground_truth > 0)
    is_scored = has_truth & predicted.isfinite() & (predicted > 0)
    predicted_depth = predicted[is_scored].double()
    true_depth = ground_truth[is_scored].double()
    pixel_count = len(true_depth)
    return Scores(
        values_by_key={
            measure.key: float(measure.of_pixels(predicted_depth, true_depth))
            for measure in measures
            if measure.of_pixels is not None
        },
        pixels=pixel_count,
        coverage=pixel_count / int(has_truth.sum()) if has_truth.any() else math.nan,
    )


def parse_keys(text: str) -> tuple[str, ...]:
    """Returns the keys in a text such as `rmse,mae`, each once, in the order of the text."""
    return tuple(dict.fromkeys(text.split(",")))


def choose_measures(measures: Sequence[Measure], keys: Sequence[str] | None) -> tuple[Measure, ...]:
    """Returns the measures with these keys, in the order of the keys.

    Args:
        measures: Measures to choose from.
        keys: Keys that the user gave. None: those of all measures.

    Raises:
        UsageError: A key is that of no measure.
    """
    by_key = {measure.key: measure for measure in measures}
    chosen = tuple(by_key) if keys is None else keys
    unknown = [key for key in chosen if key not in by_key]
    if unknown:
        raise UsageError(f"--columns {unknown[0]} is not one of {', '.join(by_key)}")
    return tuple(by_key[key] for key in chosen)
