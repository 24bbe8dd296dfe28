"""Two depths of one frame: how their order and their ratio agree, and what follows.

Of a unit or a scale that is wrong, the ratio of the two is the same everywhere. Of a kind that is
wrong, such as disparity, their order is reversed. A median alone tells neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

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
"""Log ratio of a prediction, up to which a network's own scale explains it."""
_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0, 4000.0, 6553.5, 39.3701, 3.28084)
"""Numbers per metre in use. Millimetres, KITTI, TUM, cm, dm, m, 0.25 mm, Replica, inches, feet."""
_ROUNDED = 0.05
"""Log ratio to the nearest of these, which is then meant."""
_ROUNDED_FIT = 0.15
"""The same of the depth of a network, which is biased."""


def check_order(what: str, first: NDArray[np.floating], second: NDArray[np.floating]) -> str | None:
    """Returns what reads a depth whose order is reversed in another one of the frame, else None.

    Args:
        what: Both depths, as a sentence begins.
        first: The depth that may be disparity, not above 0 where unknown.
        second: The other depth in metres.
    """
    found = compare_depths(first, second)
    if not found.is_reversed:
        return None
    inverse = np.divide(1.0, second, out=np.zeros(second.shape), where=second > 0)
    product = compare_depths(first, inverse)  # first · second
    fact = (
        f"{what} have opposite orders (rank correlation {found.rank:.2f} of {found.pairs:,}"
        " pixels): larger values are nearer in one of them, as of disparity and 1/depth"
    )
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


def unit_warning(
    what: str, found: Agreement, readings: Mapping[str, Reading | None], *, fitted: bool = False
) -> str | None:
    """Returns a warning if depths are a multiple of the ground truth.

    Where the ratio is the same everywhere, a unit is wrong, and the option that removes it is
    named. Where it varies, no quotient explains it, and none is advised.

    Args:
        what: The depths, in the plural.
        found: Agreement of the depths with the ground truth.
        readings: How the depths were read, then the ground truth, by the option of the scale.
        fitted: Whether the depths are those of a network, whose scale may be its own.

    Raises:
        InputError: There is such a multiple, and one of the scales was assumed.
    """
    if found.pairs < FEWEST_PAIRS:
        return None
    times = (
        f"{what} are {found.ratio:.4g} times the ground truth (median of {found.pairs:,} pixels)"
    )
    if not found.is_unit:
        most = _OTHER_FIT if fitted else OTHER_UNIT
        if abs(math.log(found.ratio)) <= most:
            return None
        way_out = "; --scale-by fits each image" if fitted else ""
        return (
            f"warning: {times}, but the ratio varies by a factor of {math.exp(found.spread):.2g}"
            f" over the image, so that no unit or scale explains it{way_out}"
        )
    # A scale of integers, of which the file itself is sure or not, by which the ratio becomes 1.
    within = _ROUNDED_FIT if fitted else _ROUNDED
    sides = zip(readings.items(), (found.ratio, 1 / found.ratio), strict=True)
    stored = [(option, read, by) for (option, read), by in sides if read is not None]
    integer = [side for side in stored if side[1].scale is not None]
    unstated = [side for side in integer if "(from the file)" not in side[1].source]
    advice = " or ".join(
        f"{option} {_common((read.scale or 1) * by, within):.6g} (now {read.scale or 1:g})"
        for option, read, by in unstated or integer or stored
    )
    fact = (
        f"{times}, and the ratio is the same everywhere (within a factor of"
        f" {math.exp(found.spread):.2f}), so a scale is probably wrong; {advice} would"
        " remove it"
    )
    assumed = [f"{option} {read.scale:g}" for option, read, _ in integer if read.assumed]
    if assumed:
        raise InputError(f"{fact}, {' '.join(assumed)} keeps it")
    return f"warning: {fact}"


def _common(scale: float, within: float) -> float:
    """The scale in use that is meant by one that was estimated; else that one."""
    nearest = min(_SCALES, key=lambda usual: abs(math.log(usual / scale)))
    return nearest if abs(math.log(nearest / scale)) < within else scale
