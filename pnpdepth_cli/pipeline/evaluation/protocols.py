"""Published evaluation protocols: which pixels are scored, how, and how frames are averaged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.choices import (
    AVERAGES,
    MEASURE_GROUPS,
    MISSING,
    PREDICTION_KINDS,
    RESIZES,
    SCALINGS,
)
from pnpdepth_cli.core.metrics import DELTA_THRESHOLDS, MEASURES, Measure
from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.pipeline.evaluation.kitti_devkit import DEVKIT_MEASURES
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasureGroup

KITTI_DEVKIT = "kitti-devkit"

# (top, bottom, left, right) as fractions of the height and the width, cut to whole pixels.
# Garg et al. 2016 for KITTI; and what Godard et al. (monodepth, utils/evaluate_kitti.py) found by
# trial to reproduce Eigen et al. 2014. Nearly all later evaluations use these two.
_CROP_FRACTIONS = {
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),
    "eigen": (0.3324324, 0.91351351, 0.0359477, 0.96405229),
}
# Eigen et al. 2014 for NYU Depth v2: rows 45 to 470, columns 41 to 600 of 480x640 pixels.
_NYU_SIZE = (480, 640)
_NYU_WINDOW = (45, 471, 41, 601)
# What networks for KITTI's benchmark see of a frame: 352x1216 pixels at the bottom, centred (BTS,
# Lee et al. 2019, `do_kb_crop`).
_KB_SIZE = (352, 1216)
CROPS = ("none", "nyu", *_CROP_FRACTIONS)

Window = tuple[int, int, int, int]
"""(top, bottom, left, right) in pixels; bottom and right are just outside."""


@dataclass(frozen=True, kw_only=True)
class EvalProtocol:
    """How predictions are scored."""

    name: str
    """One of PROTOCOLS."""
    scale: float = 256.0
    """Codes per metre of integer files that neither the file nor the user states."""
    min_depth: float = 0.0
    """Ground truth is scored above it, metres."""
    max_depth: float | None = None
    """Ground truth is scored below it, metres; None for no bound."""
    clip: bool = False
    """True to clip predictions to these bounds."""
    crop: str = "none"
    """One of CROPS, or X,Y,WIDTH,HEIGHT in pixels."""
    mask: Path | None = None
    """An image, or a folder of one per frame, whose pixels above 0 are scored."""
    average: str = "per-image"
    """Of the frames' measures, or "pooled" over the pixels of all frames."""
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS
    """Of δ1, δ2 and δ3."""
    exclude_sparse: bool = False
    """True not to score pixels with a sparse point."""
    missing: str = "skip"
    """What becomes of empty predictions: not scored, clamped to a bound and scored, or an error."""
    prediction_kind: str = "depth"
    """What predictions are, one of PREDICTION_KINDS."""
    scale_by: str = "none"
    """How the prediction of each image is scaled to its ground truth, one of SCALINGS."""
    prediction_crop: str | None = None
    """Part of the ground truth's frame that predictions show: "kb", or X,Y,WIDTH,HEIGHT; None for
    all of it. The rest counts as empty."""
    groups: tuple[str, ...] = ()
    """Additional measures, names of MEASURE_GROUPS."""
    resize: str | None = None
    """How a prediction of another size is resized to the ground truth's; None refuses it."""

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
        return (
            *base,
            *(measure for group in self.measure_groups for measure in group.measures),
        )

    @property
    def measure_groups(self) -> tuple[MeasureGroup, ...]:
        """The groups of additional measures."""
        return tuple(MEASURE_GROUPS[name] for name in self.groups)

    def window(self, size: tuple[int, int]) -> Window:
        """Returns the rows and columns that are scored of a frame of `size` (H, W) pixels.

        Raises:
            SizeError: If the crop does not fit the frame.
        """
        height, width = size
        if self.crop == "none":
            return 0, height, 0, width
        if self.crop in _CROP_FRACTIONS:
            top, bottom, left, right = _CROP_FRACTIONS[self.crop]
            return int(top * height), int(bottom * height), int(left * width), int(right * width)
        if self.crop == "nyu":
            if size != _NYU_SIZE:
                raise SizeError(
                    f"crop nyu is for frames of 640×480 but this one is {width}×{height};"
                    " --crop none, or give X,Y,WIDTH,HEIGHT"
                )
            return _NYU_WINDOW
        x, y, w, h = _rectangle(self.crop)
        if x + w > width or y + h > height:
            raise SizeError(f"crop {self.crop} does not lie in a frame of {width}×{height}")
        return y, y + h, x, x + w

    def prediction_window(self, size: tuple[int, int]) -> Window:
        """Returns the rows and columns of a frame of `size` (H, W) pixels that predictions show.

        Raises:
            SizeError: If the crop does not fit the frame.
        """
        height, width = size
        if self.prediction_crop is None:
            return 0, height, 0, width
        if self.prediction_crop == "kb":
            h, w = _KB_SIZE
            x, y = (width - w) // 2, height - h
        else:
            x, y, w, h = _rectangle(self.prediction_crop)
        if min(x, y) < 0 or x + w > width or y + h > height:
            raise SizeError(
                f"--pred-crop {self.prediction_crop} does not lie in a frame of {width}×{height}"
            )
        return y, y + h, x, x + w

    def scoring(self) -> dict[str, Any]:
        """Returns what decides the figures; equal for two evaluations that can be compared."""
        rules = asdict(self)
        for field_of_reading in _OF_READING:
            rules.pop(field_of_reading)
        return rules | {
            "thresholds": list(self.thresholds),
            "definitions": KITTI_DEVKIT if self.is_devkit else "usual",
            "mask": None if self.mask is None else str(self.mask),
        }

    def describe(self) -> str:
        """Returns one line, such as `eigen: ground truth in 0.001–80 m, crop eigen, …`."""
        published = PROTOCOLS[self.name]
        own = replace(
            published,
            mask=self.mask,
            exclude_sparse=self.exclude_sparse,
            resize=self.resize,
            prediction_crop=self.prediction_crop,
            groups=self.groups,
            prediction_kind=self.prediction_kind,
        )
        return ", ".join(
            (f"{self.name}{'' if self == own else ' (changed)'}: {self._range()}", *self._rest())
        )

    def _range(self) -> str:
        if self.max_depth is None:
            bounds = f" above {self.min_depth:g} m" if self.min_depth else ""
        else:
            bounds = f" in {self.min_depth:g}–{self.max_depth:g} m"
        return f"all known ground truth{bounds}"

    def _rest(self) -> list[str]:
        parts = [f"crop {self.crop}" if self.crop != "none" else "no crop"]
        parts += ["predictions clipped to the same range"] if self.clip else []
        parts += [f"mask {self.mask}"] if self.mask else []
        parts += ["without the pixels of sparse points"] if self.exclude_sparse else []
        parts += [f"predictions resized ({self.resize})"] if self.resize else []
        parts += [f"predictions of crop {self.prediction_crop}"] if self.prediction_crop else []
        parts += ["predictions are disparity"] if self.prediction_kind == "disparity" else []
        parts += [f"each image scaled by {self.scale_by}"] if self.scale_by != "none" else []
        parts += [_MISSING_TEXTS[self.missing]] if self.missing != "skip" else []
        if self.is_devkit:
            parts.append("missing predictions filled in, errors as its program prints them")
        else:
            limits = ", ".join(f"{limit:.6g}" for limit in self.thresholds)
            parts.append(f"δ below {limits}")
        averaged = "the images" if self.average == "per-image" else "all pixels together"
        return [*parts, f"mean over {averaged}"]


_IN_MILLIMETRES = tuple(
    replace(m, shown_unit="mm", shown_factor=1000.0, decimals=1) if m.key in ("rmse", "mae") else m
    for m in MEASURES
)

_OF_READING = ("name", "scale", "resize", "mask", "prediction_kind", "prediction_crop", "groups")
"""Fields that say how files are read, not how they are scored."""

_MISSING_TEXTS = {
    "min": "empty predictions scored as the lower bound",
    "max": "empty predictions scored as the upper bound",
    "fail": "no empty predictions",
}
# The reference codes (monodepth2's evaluate_depth.py, BTS's eval) clamp predictions with
# `pred[pred < min_depth] = min_depth`, which scores empty ones (0, NaN) as the lower bound.
_EIGEN_RANGE: dict[str, Any] = {
    "min_depth": 1e-3,
    "max_depth": 80.0,
    "clip": True,
    "missing": "min",
}

PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        # Ma and Karaman's evaluation, which the paper's follows: no bounds, no crop.
        EvalProtocol(name="paper"),
        # Eigen et al. 2014 with the bounds of later tables (BTS, AdaBins): 0.001 to 10 m.
        EvalProtocol(
            name="nyu-eigen",
            scale=1000.0,
            min_depth=1e-3,
            max_depth=10.0,
            clip=True,
            crop="nyu",
            missing="min",
        ),
        # The completion benchmark's measures in its units, with nothing filled in.
        EvalProtocol(name="kitti"),
        EvalProtocol(name=KITTI_DEVKIT),
        EvalProtocol(name="eigen", crop="eigen", **_EIGEN_RANGE),
        EvalProtocol(name="garg", crop="garg", **_EIGEN_RANGE),
    )
}


def choose_protocol(name: str, **changes: Any) -> EvalProtocol:
    """Returns the protocol of this name with the fields that the user changes.

    Args:
        name: One of PROTOCOLS.
        **changes: Fields of EvalProtocol; None leaves a field as it is.

    Raises:
        UsageError: For an unknown name or a setting out of its range.
    """
    if name not in PROTOCOLS:
        raise UsageError(f"no protocol {name!r}; there are {', '.join(PROTOCOLS)}")
    changed = {field: value for field, value in changes.items() if value is not None}
    published = PROTOCOLS[name]
    if published.is_devkit:
        for field, option in (
            ("average", "--average"),
            ("thresholds", "--delta"),
            ("missing", "--missing"),
            ("groups", "--measures"),
        ):
            if changed.get(field, getattr(published, field)) != getattr(published, field):
                raise UsageError(
                    f"{option} does not apply to {name}: it has its own measures, no δ, averages"
                    " over the images, and fills in missing predictions"
                )
    if changed.get("min_depth") == 0 and published.missing == "min":
        changed.setdefault("missing", "skip")  # there is no bound to score empty predictions as
    protocol = replace(published, **changed)
    _check(protocol)
    return protocol


def _check(protocol: EvalProtocol) -> None:
    low, high = protocol.min_depth, protocol.max_depth
    if not (math.isfinite(low) and low >= 0):
        raise UsageError(f"--min-depth {low:g} is no depth; give metres, 0 or more")
    if high is not None and not (math.isfinite(high) and high > low):
        raise UsageError(f"--max-depth {high:g} is not above --min-depth {low:g}; give metres")
    if protocol.average not in AVERAGES:
        raise UsageError(f"average {protocol.average!r} is not one of {', '.join(AVERAGES)}")
    if protocol.resize not in (None, *RESIZES):
        raise UsageError(f"resize {protocol.resize!r} is not one of {', '.join(RESIZES)}")
    if not all(math.isfinite(limit) and limit > 1 for limit in protocol.thresholds):
        raise UsageError("--delta must be above 1: δ counts ratios below it")
    for name in protocol.groups:
        _ = MEASURE_GROUPS[name]
    if protocol.groups and protocol.average == "pooled":
        raise UsageError("--measures are of each image; --average pooled does not apply to them")
    for option, value, names in (
        ("--missing", protocol.missing, MISSING),
        ("--scale-by", protocol.scale_by, SCALINGS),
        ("--pred-kind", protocol.prediction_kind, PREDICTION_KINDS),
    ):
        if value not in names:
            raise UsageError(f"{option} {value!r} is not one of {', '.join(names)}")
    if protocol.missing == "min" and protocol.min_depth == 0:
        raise UsageError("--missing min scores empty predictions as --min-depth; set it above 0")
    if protocol.missing == "max" and protocol.max_depth is None:
        raise UsageError("--missing max scores empty predictions as --max-depth; set it")
    if protocol.crop not in CROPS:
        _rectangle(protocol.crop)
    if protocol.prediction_crop not in (None, "kb"):
        _rectangle(protocol.prediction_crop, names=("kb",))


def _rectangle(text: str, names: Sequence[str] = CROPS) -> tuple[int, int, int, int]:
    try:
        x, y, width, height = (int(word) for word in text.split(","))
    except ValueError:
        x, y, width, height = -1, -1, 0, 0
    if min(x, y) < 0 or min(width, height) < 1:
        raise UsageError(f"crop {text!r} is neither X,Y,WIDTH,HEIGHT nor one of {', '.join(names)}")
    return x, y, width, height
