"""What the user asks of an evaluation. Imports neither numpy nor torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pnpdepth_cli import choices
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.settings import option


def parse_thresholds(text: str) -> tuple[float, float, float]:
    """Returns the thresholds of δ1…δ3 from one number, which is raised to powers, or from three."""
    try:
        first, *others = (float(word) for word in text.split(","))
        second, third = others or (first**2, first**3)
    except (ValueError, OverflowError):
        raise UsageError(
            f"--delta {text!r} is neither one number such as 1.25 nor three numbers"
        ) from None
    return first, second, third


def parse_names(text: str) -> tuple[str, ...]:
    """Returns the names in a text such as `rmse,mae`."""
    return tuple(dict.fromkeys(text.split(",")))


def parse_depth_limits(text: str) -> tuple[float, float]:
    """Returns the two depths of a text such as `10,30`."""
    try:
        near, far = (float(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"--by-depth {text!r} is not two depths such as 10,30") from None
    return near, far


@dataclass(frozen=True, kw_only=True)
class ScoringRules:
    """Fields of the protocol that the user sets otherwise; None leaves the protocol's."""

    min_depth: float | None = option(None, "Score ground truth above M metres.", metavar="M")
    max_depth: float | None = option(None, "Score ground truth below M metres.", metavar="M")
    clip: bool | None = option(None, "Clip predictions to these bounds.", flag="--clip/--no-clip")
    crop: str | None = option(
        None, "none, nyu, eigen, garg, or a rectangle.", metavar="NAME|X,Y,W,H"
    )
    mask: Path | None = option(None, "Mask image, or folder with a mask per frame.")
    average: str | None = option(
        None,
        "Mean over images, or over all pixels of all images.",
        choices=choices.AVERAGES,
    )
    thresholds: tuple[float, float, float] | None = option(
        None,
        "Thresholds of δ1…δ3: D, D², D³, or D1, D2, D3. The paper's KITTI rows use 1.01."
        "  [default: 1.25]",
        flag="--delta",
        metavar="D|D1,D2,D3",
        parse=parse_thresholds,
    )
    missing: str | None = option(
        None,
        "Empty predictions: not scored, scored as --min-depth or --max-depth, or an error."
        "  [default: the protocol's]",
        choices=choices.MISSING,
    )
    scale_by: str | None = option(
        None,
        "Scale each image to its ground truth, for relative predictions.  [default: none]",
        choices=choices.SCALINGS,
    )
    prediction_kind: str | None = option(
        None,
        "What predictions are.  [default: depth]",
        flag="--pred-kind",
        choices=choices.PREDICTION_KINDS,
    )
    more_measures: tuple[str, ...] | None = option(
        None,
        f"More measures, for dense ground truth: {', '.join(choices.MEASURES)}.",
        flag="--measures",
        metavar="KEY,…",
        parse=parse_names,
    )
    depth_limits: tuple[float, float] | None = option(
        None,
        "Also errors of pixels nearer than NEAR metres, farther than FAR, and between, by their"
        " true depth.",
        flag="--by-depth",
        metavar="NEAR,FAR",
        parse=parse_depth_limits,
    )
    resize: str | None = option(
        None, "Resize predictions to the size of the ground truth.", choices=choices.RESIZES
    )
    prediction_crop: str | None = option(
        None,
        "Part of the frame that predictions show, such as the 1216×352 of KITTI's benchmark.",
        flag="--pred-crop",
        metavar="kb|X,Y,W,H",
    )
    exclude_sparse: bool | None = option(None, "Leave out pixels with a sparse point.")

    def changes(self) -> dict[str, Any]:
        """Returns all rules by their names in a protocol."""
        return {field.name: getattr(self, field.name) for field in fields(ScoringRules)}


@dataclass(frozen=True, kw_only=True)
class EvalRequest(ScoringRules):
    """What to score, and how."""

    prediction: Path
    """A depth file, or a folder of them."""
    ground_truth: Path
    """A depth file, a folder of them, or a data set of a known layout."""
    protocol: str = option(
        "paper",
        "Preset of the rules.",
        choices=choices.PROTOCOLS,
        show_default=True,
    )
    pred_scale: float | None = option(None, "Integer predictions hold metres × S.", metavar="S")
    gt_scale: float | None = option(None, "Integer ground truth holds metres × S.", metavar="S")
    sparse: Path | None = option(
        None,
        "Sparse depth the networks had: points that are part of the ground truth are reported.",
        metavar="FILE|FOLDER",
    )
    sparse_scale: float | None = option(
        None, "Integer --sparse files hold metres × S.", metavar="S"
    )
    channel: str | None = option(
        None, "EXR channel or NPZ array that holds the depth.", metavar="NAME"
    )
    grouped: bool = True
    """False if every frame counts as independent."""
    workers: int = option(
        2, "Number of frames read at once.", metavar="N", least=1, show_default=True
    )

    def __post_init__(self) -> None:
        for name in ("pred_scale", "gt_scale", "sparse_scale"):
            scale = getattr(self, name)
            if scale is not None and not (math.isfinite(scale) and scale > 0):
                flag = f"--{name.replace('_', '-')}"
                raise UsageError(f"{flag} must be a finite number above 0, got {scale:g}")
