"""What the user asks of an evaluation, and the rules that follow. Imports no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from pnpdepth_cli import choices
from pnpdepth_cli.dataset.frame_files import inverse_factor
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.measures import (
    DEVKIT_MEASURES,
    OF_SIGMA,
    Measure,
    by_depth,
    choose_measures,
    parse_keys,
    with_thresholds,
)
from pnpdepth_cli.protocols import KITTI_DEVKIT, Protocol, find_protocol
from pnpdepth_cli.settings import option

WITHOUT_SPARSE = "; without the pixels of sparse points"
"""What titles of tables say where the pixels of input points are excluded."""
_DELTA = 1.25
"""D of the usual thresholds D, D², D³ of δ1…δ3 (Eigen et al. 2014)."""


@dataclass(frozen=True, kw_only=True)
class EvalRequest:
    """What to score, and how; None leaves what the protocol says.

    Raises:
        UsageError: For an unknown protocol, or a setting out of its range.
    """

    prediction: Path
    """A depth file, or a folder of them."""
    ground_truth: Path
    """A depth file, a folder of them, or a data set of a known layout."""
    protocol: str = option("paper", "Preset of the rules.", choices=choices.PROTOCOLS)
    max_depth: float | None = option(None, "Score ground truth below M metres.", metavar="M")
    delta: float = option(
        _DELTA,
        "Thresholds of δ1…δ3 are D, D², D³. The paper's KITTI rows use 1.01.",
        metavar="D",
        show_default=True,
    )
    scale_by: str = option(
        "none",
        "Scale each image to its ground truth, for relative predictions. affine-disparity takes"
        " disparity.",
        choices=choices.SCALINGS,
    )
    depth_limits: tuple[float, float] | None = option(
        None,
        "Also errors of pixels nearer than NEAR metres, farther than FAR, and between, by their"
        " true depth.",
        flag="--by-depth",
        metavar="NEAR FAR",
    )
    resize: bool = option(False, "Resize predictions to the size of the ground truth, bilinearly.")
    exclude_sparse: bool = option(False, "Leave out pixels with a sparse point.")

    pred_scale: float | None = option(None, "Predictions hold metres × S.", metavar="S")
    gt_scale: float | None = option(None, "Ground truth holds metres × S.", metavar="S")
    gt_kind: str | None = option(
        None,
        "What ground truth holds: inverse, 1/z; or disparity:B in pixels, with B = baseline in"
        " metres × focal length in pixels.  [default: depth z]",
        metavar="KIND",
    )
    gt_range: bool = option(
        False, "Ground truth is the distance from the camera, not depth z; needs the camera."
    )
    columns: tuple[str, ...] | None = option(
        None,
        "Measures of the tables, in this order, such as rmse,mae,delta1. Only if named, for dense"
        f" ground truth: {', '.join(choices.MEASURES)}.",
        metavar="KEY,…",
        type=parse_keys,
    )

    def __post_init__(self) -> None:
        """Raises UsageError for an unknown protocol or measure, or a setting out of its range."""
        for flag, value, bound in (
            ("--pred-scale", self.pred_scale, 0.0),
            ("--gt-scale", self.gt_scale, 0.0),
            ("--max-depth", self.max_depth, self.rules.min_depth),
            ("--delta", self.delta, 1.0),
        ):
            if value is not None and not (math.isfinite(value) and value > bound):
                raise UsageError(f"{flag} must be a finite number above {bound:g}, got {value:g}")
        inverse_factor("--gt-kind", self.gt_kind)
        if self.depth_limits is not None:
            near, far = self.depth_limits
            if not (0 < near < far and math.isfinite(far)):
                raise UsageError(
                    f"--by-depth must be two rising depths in metres: {near:g} {far:g}"
                )
        if self.is_devkit and (self.delta != _DELTA or self.depth_limits):
            raise UsageError(
                f"--delta and --by-depth do not apply to {KITTI_DEVKIT}, which has its own measures"
            )
        if self.columns is not None:
            # An unknown key is refused with the names of all that there are.
            on_request = () if self.is_devkit else choices.MEASURES.values()
            choose_measures((*self.measures, *on_request, *OF_SIGMA), self.columns)

    @cached_property
    def rules(self) -> Protocol:
        """The protocol with what the user changes of it."""
        protocol = find_protocol(self.protocol)
        return replace(
            protocol,
            max_depth=protocol.max_depth if self.max_depth is None else self.max_depth,
            exclude_sparse=protocol.exclude_sparse or self.exclude_sparse,
        )

    @property
    def _thresholds(self) -> list[float]:
        """The thresholds of δ1, δ2 and δ3."""
        return [self.delta, self.delta**2, self.delta**3]

    @property
    def is_devkit(self) -> bool:
        """True if the development kit's definitions replace the usual ones."""
        return self.protocol == KITTI_DEVKIT

    @cached_property
    def measures(self) -> tuple[Measure, ...]:
        """What is measured, in the order of tables, and how they show it.

        The usual measures come first, then those by depth, then those that are only computed where
        `columns` names them.
        """
        if self.is_devkit:
            return DEVKIT_MEASURES
        usual = with_thresholds(self._thresholds)
        of_depths = () if self.depth_limits is None else by_depth(usual, *self.depth_limits)
        if self.protocol == "kitti":  # whose tables have millimetres
            usual = tuple(
                replace(measure, shown_unit="mm", shown_factor=1000.0, decimals=1)
                if measure.key in ("rmse", "mae")
                else measure
                for measure in usual
            )
        on_request = [
            choices.MEASURES[key] for key in self.columns or () if key in choices.MEASURES
        ]
        return (*usual, *of_depths, *on_request)

    @property
    def scoring(self) -> dict[str, object]:
        """All rules on which scores depend, by their names.

        `pnpdepth compare` refuses runs whose rules differ.
        """
        rules = self.rules
        return {
            "min_depth": rules.min_depth,
            "max_depth": rules.max_depth,
            "clip": rules.clip,
            "crop": rules.crop,
            # A pixel without prediction is 0, which clipping makes the least depth; else it is not
            # scored, unless the development kit's definitions fill it in.
            "missing": "min" if rules.clip else "skip",
            "exclude_sparse": rules.exclude_sparse,
            "thresholds": self._thresholds,
            "scale_by": self.scale_by,
            "definitions": KITTI_DEVKIT if self.is_devkit else "usual",
        }

    def describe(self) -> str:
        """Returns one line, such as `eigen: min_depth 0.001, max_depth 80, crop eigen, …`."""
        is_changed = self.rules != find_protocol(self.protocol) or self.delta != _DELTA
        name = f"{self.protocol} (changed)" if is_changed else self.protocol
        texts = [
            f"{rule} {value}"
            for rule, value in self.scoring.items()
            if value not in (None, False, "none")  # a rule that is off
        ]
        return f"{name}: {', '.join(texts)}; mean over the images"
