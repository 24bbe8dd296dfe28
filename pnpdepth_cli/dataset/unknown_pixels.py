"""Which pixels of a network's depth map are unknown, by its numbers alone.

What the numbers mean is not known: depth, disparity or logarithms. So what counts is what no such
map has at surfaces: numbers that are not finite, marks such as 0 and −1, codes at the end of their
type, and one extreme value for many pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.range_ends import far_end, near_end, repeated_ends

Map = NDArray[np.float32]
"""(H, W), or (N,) of some pixels."""

SAVE_RAW = "save the raw array as NPY (numpy.save), or as a 16-bit PNG"
"""The way out of messages on files that hold pictures instead of numbers."""
STEPS_OF_8_BITS = 256
"""Different numbers that 8 bits have."""
_FILLED = 0.005
"""Fraction of the pixels; so many zeros in the middle of a range stand for unknown."""
_MORE_ZEROS = 3
"""Times as many as any other number, for the same."""


def without_unknown(codes: NDArray[Any], scale: float | None) -> tuple[Map, list[str]]:
    """Returns numbers (H, W) as float32, NaN where unknown; and lines that count unknown pixels.

    Args:
        codes: (H, W) numbers as stored.
        scale: Codes per unit that the file states. None: it states none.
    """
    # A float64 beyond float32 becomes infinite, and with that unknown.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        values = np.array(codes if scale is None else codes / scale, dtype=np.float32)
    unknown = _Unknown(values)
    unknown.add(~np.isfinite(values), "NaN or infinite")
    # A picture of 8 bits is clipped at its ends; other numbers have codes, marks and far planes.
    if _is_8_bit(codes):
        _add_8_bit_ends(unknown, codes)
    else:
        _add_ends_of_codes(unknown, codes)
        _add_marks(unknown, values)
        _add_ends(unknown, values)
    values[unknown.mask] = np.nan
    return values, unknown.notes


class _Unknown:
    """Which pixels of a map are unknown, and a line on each reason."""

    def __init__(self, values: Map) -> None:
        """No pixel of the map (H, W) is unknown at first."""
        self._values = values
        self.mask = np.zeros(values.shape, bool)
        self.notes = list[str]()

    @property
    def known(self) -> Map:
        """The numbers (N,) of the pixels that are not unknown."""
        return self._values[~self.mask]

    def add(self, pixels: NDArray[np.bool_], what: str) -> None:
        """Adds pixels, and a line that counts those that are new.

        Args:
            pixels: (H, W) true for the pixels.
            what: What they hold, as a sentence ends.
        """
        new = pixels & ~self.mask
        count = int(np.count_nonzero(new))
        if count:
            verb = "is" if count == 1 else "are"
            self.notes.append(f"{count:,} of {new.size:,} pixels {verb} {what}; taken as unknown")
            self.mask |= new


def _add_8_bit_ends(unknown: _Unknown, codes: NDArray[Any]) -> None:
    """Adds 0 and 255, at which a picture of depth is clipped, and a warning that it has steps.

    Args:
        unknown: The unknown pixels, to which these are added.
        codes: (H, W) numbers as they are stored.
    """
    lowest = codes == 0
    highest = codes == STEPS_OF_8_BITS - 1
    levels = len(np.unique(codes[np.isfinite(codes)]))
    unknown.notes.append(
        f"warning: 8 bits have 256 steps, of which {levels} are used;"
        f" {np.count_nonzero(lowest):,} of {codes.size:,} pixels are 0 and"
        f" {np.count_nonzero(highest):,} are 255, where it is clipped, and taken as unknown;"
        f" better {SAVE_RAW}"
    )
    unknown.mask |= lowest | highest


def _add_ends_of_codes(unknown: _Unknown, codes: NDArray[Any]) -> None:
    """Adds the largest code of an integer type, and the smallest below 0: no sensor measures them.

    Floats have none.

    Args:
        unknown: The unknown pixels, to which these are added.
        codes: (H, W) numbers as they are stored.
    """
    if codes.dtype.kind not in "iu":
        return
    limits = np.iinfo(codes.dtype)
    unknown.add(codes == limits.max, f"{limits.max}, the largest code")
    if limits.min < 0:
        unknown.add(codes == limits.min, f"{limits.min}, the smallest code")


def _add_marks(unknown: _Unknown, values: Map) -> None:
    """Adds the pixels that hold a mark of unknown depth: the only number below 0, and 0.

    0 is no mark where known numbers are of both signs, as logarithms are, unless it is far more
    frequent than any other.

    Args:
        unknown: The unknown pixels, to which these are added.
        values: (H, W) numbers by their scale.
    """
    known = unknown.known
    below_zero = np.unique(known[known < 0])
    if len(below_zero) == 1 and known.max(initial=0) > 0:
        unknown.add(values == below_zero[0], f"{below_zero[0]:.6g}, the only number below 0")
    # What is known without that number: between both signs, 0 must be frequent to be a mark.
    known = unknown.known
    zeros = int(np.count_nonzero(known == 0))
    if zeros and known.min() < 0 < known.max():
        _, counts = np.unique(known[known != 0], return_counts=True)
        fewest_of_mark = max(_FILLED * values.size, _MORE_ZEROS * int(counts.max()))
        if zeros < fewest_of_mark:
            return
    unknown.add(values == 0, "0")


def _add_ends(unknown: _Unknown, values: Map) -> None:
    """Adds the pixels of extreme values that many share: the sky, a far plane, a clip.

    Args:
        unknown: The unknown pixels, to which these are added.
        values: (H, W) numbers by their scale.
    """
    # Many about one value far from all others, with mixtures of the two at the edges. The numbers
    # may be depth or 1/depth, so the sky may be at either end.
    known = unknown.known.astype(np.float64)
    if known.min(initial=np.inf) > 0:
        is_known = ~unknown.mask
        for end, bound in (
            (far_end(known), "98 % of the others are at most"),
            (near_end(known), "98 % of the others are at least"),
        ):
            pixels = np.zeros(values.shape, bool)
            pixels[is_known] = end.is_no_surface
            unknown.add(pixels, f"about {end.value:.6g}, where {bound} {end.reach:.4g}")
    # Many of exactly one value.
    for value, _ in repeated_ends(unknown.known):
        name = "smallest" if value <= float(unknown.known.min()) else "largest"
        unknown.add(values == np.float32(value), f"{value:.6g} exactly, the {name} value")


def _is_8_bit(codes: NDArray[Any]) -> bool:
    """Whether the numbers are whole and go from 0 or more to 255, as of 8 bits, of any type."""
    if codes.dtype == np.uint8:
        return True
    finite = codes[np.isfinite(codes)] if codes.dtype.kind == "f" else codes
    if not finite.size or finite.min() < 0 or finite.max() != STEPS_OF_8_BITS - 1:
        return False
    return bool((np.rint(finite) == finite).all())
