"""Two depths of one frame: how their order and their ratio agree, and what follows.

Of a unit or a scale that is wrong, the ratio of the two is the same everywhere. Of a kind that is
wrong, such as disparity, their order is reversed. A median alone tells neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.completion.two_depths import (
    FEWEST_PAIRS,
    OTHER_UNIT,
    TIGHT,
    Agreement,
    compare_depths,
)
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.formats import Reading

_OTHER_FIT = math.log(3.0)
"""Log ratio of a prediction to the truth, up to which a network's own scale explains it."""
_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0, 4000.0, 6553.5, 39.3701, 3.28084)
"""Numbers per metre in use. Millimetres, KITTI, TUM, cm, dm, m, 0.25 mm, Replica, inches, feet."""
_ROUNDED = 0.05
"""Log ratio of an estimated scale to the nearest of these, below which that one is meant."""
_ROUNDED_FIT = 0.15
"""The same for the depth of a network, which is biased."""


def check_order(what: str, first: NDArray[np.floating], second: NDArray[np.floating]) -> str | None:
    """Returns a line for a person if one depth of a frame is large where the other is small.

    The line says which kind of file, such as disparity, explains it. None: they have one order, or
    none that is clear.

    Args:
        what: Names of both depths, as a sentence begins.
        first: The depth that may be disparity, not above 0 where unknown; of any shape.
        second: The other depth in metres, of the same shape, not above 0 where unknown.
    """
    agreement = compare_depths(first, second)
    if not agreement.is_reversed:
        return None
    fact = (
        f"{what} have opposite orders (rank correlation {agreement.rank:.2f} of"
        f" {agreement.pairs:,} pixels): larger values are nearer in one of them, as of disparity"
        " and 1/depth"
    )
    # Of disparity, the product with depth is baseline · focal length, one number everywhere.
    inverse = np.divide(1.0, second, out=np.zeros(second.shape), where=second > 0)
    product = compare_depths(first, inverse)  # first / (1 / second) = first · second
    if product.spread > TIGHT:
        return f"{fact}; their product is not constant, so that no baseline · focal length fits"
    kind = f"disparity:{product.ratio:.4g}"
    if abs(math.log(product.ratio)) < _ROUNDED:
        kind = "inverse"
    return (
        f"{fact}. Their product is {product.ratio:.4g} (median), so --sparse-kind {kind} reads the"
        f" sparse depth if that is it, and --gt-kind {kind} of eval, or gt_kind of a list, the"
        " ground truth"
    )


class _OtherScale(NamedTuple):
    """A change of one file's scale that would make two depths equal."""

    option: str
    """Option of the command line, or column of a list, that states the scale."""
    reading: Reading
    """How the file was read, by the scale that may be wrong."""
    factor: float
    """What that scale is multiplied by."""

    @property
    def scale(self) -> float:
        """Numbers per metre by which the file was read; 1 of metres."""
        return self.reading.scale or 1

    @property
    def is_stated_in_file(self) -> bool:
        """Whether the file itself states the scale, so that it is hardly wrong."""
        return "(from the file)" in self.reading.source


def unit_warning(
    what: str,
    agreement: Agreement,
    readings: Mapping[str, Reading | None],
    *,
    fitted: bool = False,
) -> str | None:
    """Returns a warning if depths are a multiple of the ground truth, else None.

    Where the ratio is the same everywhere, a unit is wrong, and the option that removes it is
    named. Where it varies, no quotient explains it, and none is advised.

    Args:
        what: Name of the depths, in the plural.
        agreement: How the depths agree with the ground truth; the ratio is depth / ground truth.
        readings: How the depths were read, then how the ground truth was, by the option that states
            the scale of each. None: its scale cannot be stated.
        fitted: Whether the depths are those of a network, whose scale may be its own.

    Raises:
        InputError: There is such a multiple, and one of the scales was assumed.
    """
    if agreement.pairs < FEWEST_PAIRS:
        return None
    ratio = agreement.ratio
    times = f"{what} are {ratio:.4g} times the ground truth (median of {agreement.pairs:,} pixels)"
    if not agreement.is_unit:
        most = _OTHER_FIT if fitted else OTHER_UNIT
        if abs(math.log(ratio)) <= most:
            return None
        way_out = "; --scale-by fits each image" if fitted else ""
        return (
            f"warning: {times}, but the ratio varies by a factor of"
            f" {math.exp(agreement.spread):.2g} over the image, so that no unit or scale explains"
            f" it{way_out}"
        )
    # Either scale may be wrong: that of the depths by the ratio, that of the truth by its inverse.
    changes = [
        _OtherScale(option, reading, factor)
        for (option, reading), factor in zip(readings.items(), (ratio, 1 / ratio), strict=True)
        if reading is not None
    ]
    # The likeliest are scales of integers which the file does not state, then those that it does.
    of_integers = [change for change in changes if change.reading.scale is not None]
    unstated = [change for change in of_integers if not change.is_stated_in_file]
    within = _ROUNDED_FIT if fitted else _ROUNDED
    advice = " or ".join(
        f"{change.option} {_usual_scale(change.scale * change.factor, within):.6g}"
        f" (now {change.scale:g})"
        for change in unstated or of_integers or changes
    )
    fact = (
        f"{times}, and the ratio is the same everywhere (within a factor of"
        f" {math.exp(agreement.spread):.2f}), so a scale is probably wrong; {advice} would"
        " remove it"
    )
    assumed = [
        f"{change.option} {change.scale:g}" for change in of_integers if change.reading.assumed
    ]
    if assumed:
        raise InputError(f"{fact}, {' '.join(assumed)} keeps it")
    return f"warning: {fact}"


def _usual_scale(estimated: float, within: float) -> float:
    """The scale in use that an estimated one means; the estimated one if none is near.

    Args:
        estimated: Numbers per metre.
        within: Log ratio of the two, below which the scale in use is meant.
    """
    nearest = min(_SCALES, key=lambda usual: abs(math.log(usual / estimated)))
    return nearest if abs(math.log(nearest / estimated)) < within else estimated
