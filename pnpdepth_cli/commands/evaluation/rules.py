"""The rules of an evaluation: a published protocol with what the user changes, and its crops."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from pnpdepth_cli import choices
from pnpdepth_cli.commands.evaluation.kitti_devkit import DEVKIT_MEASURES
from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.measures import MEASURES, Measure, by_depth
from pnpdepth_cli.protocols import KITTI_DEVKIT, Protocol, find_protocol

# (top, bottom, left, right) as fractions of the height and the width, cut to whole pixels.
# Garg et al. 2016 for KITTI; and what Godard et al. (monodepth, utils/evaluate_kitti.py) found by
# trial to reproduce Eigen et al. 2014. Nearly all later evaluations use these two.
_CROP_FRACTIONS = {
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),
    "eigen": (0.3324324, 0.91351351, 0.0359477, 0.96405229),
}
# Eigen et al. 2014 for NYU Depth v2: rows 45 to 470, columns 41 to 600 of 480x640 pixels.
_NYU_SIZE = (480, 640)
_NYU_WINDOW = (41, 45, 560, 426)


@dataclass(frozen=True, kw_only=True)
class EvalProtocol(Protocol):
    """A protocol with what the user changes, and how the files are read."""

    exclude_sparse: bool = False
    prediction_kind: str = "depth"
    scale_by: str = "none"
    more_measures: tuple[str, ...] = ()
    depth_limits: tuple[float, float] | None = None
    resize: str | None = None

    @property
    def is_devkit(self) -> bool:
        """True if the development kit's definitions replace those of core.metrics."""
        return self.name == KITTI_DEVKIT

    @property
    def measures(self) -> tuple[Measure, ...]:
        """The measures in order, and how tables show them."""
        if self.is_devkit:
            return DEVKIT_MEASURES
        base = _IN_MILLIMETRES if self.name == "kitti" else MEASURES
        of_parts = () if self.depth_limits is None else by_depth(*self.depth_limits)
        return (*base, *of_parts, *(choices.MEASURES[key] for key in self.more_measures))

    def scoring(self) -> dict[str, Any]:
        """Returns what decides the figures; equal for two evaluations that can be compared."""
        rules = {name: value for name, value in asdict(self).items() if name not in _OF_READING}
        return rules | {
            "thresholds": list(self.thresholds),
            "definitions": KITTI_DEVKIT if self.is_devkit else "usual",
        }

    def describe(self) -> str:
        """Returns one line, such as `eigen: ground truth in 0.001–80 m, crop eigen, …`."""
        reading = {name: getattr(self, name) for name in (*_OF_READING, "exclude_sparse")}
        own = replace(published(self.name), **reading)
        bounds = f" above {self.min_depth:g} m" if self.min_depth else ""
        if self.max_depth is not None:
            bounds = f" in {self.min_depth:g}–{self.max_depth:g} m"
        limits = ", ".join(f"{limit:.6g}" for limit in self.thresholds)
        parts = {
            f"{self.name}{'' if self == own else ' (changed)'}: all known ground truth{bounds}": 1,
            "no crop" if self.crop == "none" else f"crop {self.crop}": True,
            "predictions clipped to the same range": self.clip,
            "without the pixels of sparse points": self.exclude_sparse,
            f"predictions resized ({self.resize})": self.resize,
            "predictions are disparity": self.prediction_kind == "disparity",
            f"each image scaled by {self.scale_by}": self.scale_by != "none",
            "empty predictions scored as the lower bound": self.missing == "min",
            "missing predictions filled in, errors as its program prints them": self.is_devkit,
            f"δ below {limits}": not self.is_devkit,
            "mean over the images": True,
        }
        return ", ".join(text for text, applies in parts.items() if applies)


_IN_MILLIMETRES = tuple(
    replace(m, shown_unit="mm", shown_factor=1000.0, decimals=1) if m.key in ("rmse", "mae") else m
    for m in MEASURES
)

_OF_READING = (
    *("name", "note", "part", "sample", "seed", "foreground"),
    *("scale", "resize", "prediction_kind"),
    *("more_measures", "depth_limits"),
)
"""Fields that say how files are read and what is measured, not which pixels are scored and how."""

_NOT_OF_DEVKIT = {
    "thresholds": "--delta",
    "more_measures": "--measures",
    "depth_limits": "--by-depth",
}


def published(name: str) -> EvalProtocol:
    """Returns the protocol of this name. Raises UsageError if there is none."""
    row = find_protocol(name)
    return EvalProtocol(**{f.name: getattr(row, f.name) for f in fields(row)})


def choose_protocol(name: str, **changes: Any) -> EvalProtocol:
    """Returns the protocol of this name with the fields that the user changes.

    None leaves a field as it is.

    Raises:
        UsageError: For an unknown name or a setting out of its range.
    """
    changed = {field: value for field, value in changes.items() if value is not None}
    own = published(name)
    for field, option in _NOT_OF_DEVKIT.items() if own.is_devkit else ():
        if changed.get(field, getattr(own, field)) != getattr(own, field):
            raise UsageError(
                f"{option} does not apply to {name}: it has its own measures, and no δ"
            )
    protocol = replace(own, **changed)
    low, high = protocol.min_depth, protocol.max_depth
    for key in protocol.more_measures:
        _ = choices.MEASURES[key]
    near, far = protocol.depth_limits or (1.0, 2.0)
    if not (0 < near < far and math.isfinite(far)):
        raise UsageError(f"--by-depth must be two rising depths in metres, got {near:g} {far:g}")
    if high is not None and not (math.isfinite(high) and high > low):
        raise UsageError(f"--max-depth must be metres above {low:g}, got {high:g}")
    if not all(math.isfinite(limit) and limit > 1 for limit in protocol.thresholds):
        raise UsageError("--delta must be above 1: δ counts ratios below it")
    return protocol


def crop_window(crop: str, size: tuple[int, ...]) -> tuple[slice, slice]:
    """Returns the rows and columns of a frame of `size` (H, W) pixels that lie in a crop.

    Raises:
        SizeError: If the crop does not fit the frame.
    """
    height, width = size
    if crop in _CROP_FRACTIONS:
        top, bottom, left, right = _CROP_FRACTIONS[crop]
        rows, columns = (
            (int(top * height), int(bottom * height)),
            (int(left * width), int(right * width)),
        )
        return slice(*rows), slice(*columns)
    if crop == "none":
        return slice(0, height), slice(0, width)
    if size != _NYU_SIZE:
        raise SizeError(
            f"crop nyu is for frames of 640×480 but this one is {width}×{height}; --protocol paper"
            " scores any size"
        )
    x, y, w, h = _NYU_WINDOW
    return slice(y, y + h), slice(x, x + w)
