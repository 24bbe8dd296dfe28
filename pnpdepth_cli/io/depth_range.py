"""The range of a depth file for a person, and a warning when it cannot be metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.formats import KITTI_SCALE

_SHORTEST_M, _LONGEST_M = 0.02, 1000.0
_COMMON_M = (0.2, 200.0)
_FARTHEST_INDOORS_M = 40.0
"""Below it, a map read by KITTI's scale may be a room in millimetres: 40 m are 10.2 m then."""
# Codes per metre in use, most likely first: millimetres, KITTI, TUM RGB-D, centimetres.
_COMMON_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0)


def describe_range(
    depth: NDArray[Any],
    source: str,
    *,
    assumed_scale: bool = False,
    noun: str = "points",
    option: str = "--depth-scale",
    unit: str = "m",
) -> str:
    """Returns a line such as `1,842 points, 2.1–63.4 m (16-bit PNG ÷ 256)`.

    Args:
        depth: Metres of any shape; 0 and values that are not finite are unknown.
        source: What was read.
        assumed_scale: Whether the scale is assumed. The line then names the option that changes it
            and, where KITTI's scale gives near depths only, their range if they are millimetres.
        noun: What is counted, in the plural.
        option: That option.
        unit: Of the depth.
    """
    known = _known(depth)
    hint = f"; {option} to change" if assumed_scale else ""
    if known.size == 0:
        return f"no {noun} with known depth ({source}{hint})"
    by_kitti = assumed_scale and source.endswith(f"÷ {KITTI_SCALE:g}")
    if by_kitti and float(known.max()) < _FARTHEST_INDOORS_M:
        low, high = (metres(float(end) * KITTI_SCALE / 1000) for end in (known.min(), known.max()))
        hint = f" assumed; if it holds millimetres, {option} 1000 makes it {low}–{high} m"
    count = f"{known.size:,} {noun[:-1] if known.size == 1 else noun}"
    low, high = metres(float(known.min())), metres(float(known.max()))
    extent = low if low == high else f"{low}–{high}"
    return f"{count}, {extent} {unit} ({source}{hint})"


def implausible(depth: NDArray[Any], scale: float | None = None) -> str | None:
    """Returns a warning if half of the known depths cannot be metres, else None.

    Args:
        depth: Metres of any shape; 0 and values that are not finite are unknown.
        scale: Codes per metre that integers were divided by; None for a float file.
    """
    known = _known(depth)
    if known.size == 0:
        return None
    median = float(np.median(known))
    if _SHORTEST_M <= median <= _LONGEST_M:
        return None
    fact = f"median depth {metres(median)} m is implausible, the scale is probably wrong"
    if scale is None:
        divisor = next((s for s in (1000.0, 100.0) if _is_common(median / s)), None)
        advice = (
            f"; divided by {divisor:g} it would be {metres(median / divisor)} m" if divisor else ""
        )
        return f"{fact}: a float file must hold metres{advice}"
    better = next((s for s in _COMMON_SCALES if _is_common(median * scale / s)), None)
    if better is None:
        return f"{fact}: give codes per metre with --depth-scale (now {scale:g})"
    return (
        f"{fact}: --depth-scale {better:g} (now {scale:g}) "
        f"would make it {metres(median * scale / better)} m"
    )


def metres(value: float) -> str:
    """Returns the number as a person writes it: one decimal from 1 m on, two digits below."""
    if value >= 1e6 or (0 < value < 1e-3):
        return f"{value:.1e}"
    return f"{value:,.1f}" if value >= 0.95 else f"{value:.2g}"


def _is_common(median: float) -> bool:
    return _COMMON_M[0] <= median <= _COMMON_M[1]


def _known(depth: NDArray[Any]) -> NDArray[np.float64]:
    values = np.asarray(depth, dtype=np.float64)
    return values[np.isfinite(values) & (values > 0)]
