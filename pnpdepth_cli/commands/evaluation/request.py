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
    """Returns the thresholds of δ1…δ3: a number and its powers. Raises UsageError for a text."""
    try:
        first = float(text)
        return first, first**2, first**3
    except (ValueError, OverflowError):
        raise UsageError(f"--delta {text!r} is no number such as 1.25") from None


def parse_names(text: str) -> tuple[str, ...]:
    """Returns the names in a text such as `rmse,mae`."""
    return tuple(dict.fromkeys(text.split(",")))


@dataclass(frozen=True, kw_only=True)
class ScoringRules:
    """Fields of the protocol that the user sets otherwise; None leaves the protocol's."""

    max_depth: float | None = option(None, "Score ground truth below M metres.", metavar="M")
    thresholds: tuple[float, float, float] | None = option(
        None,
        "Thresholds of δ1…δ3 are D, D², D³. The paper's KITTI rows use 1.01.  [default: 1.25]",
        flag="--delta",
        metavar="D",
        parse=parse_thresholds,
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
        metavar="NEAR FAR",
    )
    resize: str | None = option(
        None, "Resize predictions to the size of the ground truth.", choices=choices.RESIZES
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

    def __post_init__(self) -> None:
        for name in ("pred_scale", "gt_scale"):
            scale = getattr(self, name)
            if scale is not None and not (math.isfinite(scale) and scale > 0):
                flag = f"--{name.replace('_', '-')}"
                raise UsageError(f"{flag} must be a finite number above 0, got {scale:g}")
