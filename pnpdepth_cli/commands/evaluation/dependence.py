"""Which frames are independent of each other: sequences, and blocks of a single sequence.

Errors of neighbouring frames of a video are alike, so n frames say less than n independent ones.
Resampling whole clusters of frames accounts for that.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MIN_CLUSTERS = 5
"""Fewer give no interval: with lognormal errors (σ 0.5) even a studentised one misses too often."""

BLOCK_BIAS = 0.1
"""Fraction of the variance of a mean that blocks of a single sequence may miss."""

MAX_BLOCKS = 10
"""Most blocks of a single sequence. Few long blocks stay independent also where the correlation is
not that of a first-order autoregression, at a small loss of power (Ibragimov and Müller 2010)."""

_FRAME_NUMBER = re.compile(r"(?:^|[_\-/])\d+(?:_image_\d+)?$")


@dataclass(frozen=True, kw_only=True)
class Clusters:
    """A partition of the frames into clusters that count as independent."""

    ids: NDArray[np.int64]
    """(N,) the cluster of each frame, from 0 to count − 1."""
    unit: str
    """What a cluster is, in the plural: "frames", "groups of frames", "blocks of 6 frames"."""

    @property
    def count(self) -> int:
        """How many clusters there are."""
        return int(self.ids.max()) + 1

    def describe(self) -> str:
        """Returns text such as `12 groups of frames`."""
        return f"{self.count:,} {self.unit}"


def groups_by_name(names: Sequence[str]) -> list[str]:
    """Returns the sequence of each frame: its name before the frame number, or else its folder.

    `drive_0002_sync_0000000008_image_02` is of `drive_0002_sync`, and `office/0012` of `office`.
    Unless all names end in a number, only folders make groups.
    """
    stems = [_FRAME_NUMBER.sub("", name) for name in names]
    if all(stem != name for stem, name in zip(stems, names, strict=True)):
        return stems
    return [name.rpartition("/")[0] for name in names]


def find_clusters(groups: Sequence[str], series: Floats, *, grouped: bool = True) -> Clusters:
    """Returns the groups; for a single group with correlated errors, blocks of it.

    Args:
        groups: The sequence of each of N frames.
        series: (N, M) what is averaged, in the order of the frames; its autocorrelation decides
            the length of the blocks. NaN columns are ignored.
        grouped: False makes every frame a cluster.
    """
    names = list(dict.fromkeys(groups))
    frames = len(groups)
    if grouped and 1 < len(names) < frames:
        return Clusters(
            ids=np.array([names.index(group) for group in groups]), unit="groups of frames"
        )
    length = block_length(series) if grouped and len(names) == 1 else 1
    if length == 1:
        return Clusters(ids=np.arange(frames), unit="frames")
    blocks = max(1, min(MAX_BLOCKS, frames // length))
    return Clusters(
        ids=np.arange(frames) * blocks // frames,
        unit=f"blocks of about {round(frames / blocks):,} consecutive frames of one sequence,"
        " as their errors are correlated",
    )


def block_length(series: Floats) -> int:
    """Returns the length of blocks whose means are nearly independent; 1 if frames already are.

    Blocks of length L of a first-order autoregression with lag-1 correlation ρ understate the
    variance of the mean by the fraction 2ρ/(1 − ρ²)/L for large L, which is kept at BLOCK_BIAS.
    ρ is the median over the columns, corrected for its bias (Kendall 1954); a correlation below its
    standard error counts as none.

    Args:
        series: (N, M) in order of time.
    """
    frames = len(series)
    if frames < MIN_CLUSTERS:
        return 1
    centred = series - series.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        lag_one = (centred[1:] * centred[:-1]).sum(axis=0) / (centred**2).sum(axis=0)
        correlation = float(np.nanmedian(lag_one))
    if math.isnan(correlation) or correlation <= 1 / math.sqrt(frames):
        return 1
    correlation = min(correlation + (1 + 3 * correlation) / frames, 0.99)
    return min(frames, math.ceil(2 * correlation / (1 - correlation**2) / BLOCK_BIAS))
