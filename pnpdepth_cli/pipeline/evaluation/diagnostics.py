"""Notes of an evaluation: what was assumed, and warnings of what looks wrong."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.pipeline.evaluation.frame_scoring import FileFacts, FrameScores, ScoredFrame
from pnpdepth_cli.pipeline.evaluation.pairing import some_names
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol

# Codes per metre in use are 1000, 256, 100, 10; a wrong one gives a quotient of two of them.
_SCALE_QUOTIENTS = (1000.0, 256.0, 100.0, 10.0, 1000.0 / 256.0)
_TOLERANCE = math.log(1.1)
_LEAK_WARNING_FRACTION = 0.01
_LISTED = 3


class FileKinds:
    """Counts the kinds of files that a run reads."""

    def __init__(self) -> None:
        self._counts: dict[str, Counter[FileFacts]] = {"prediction": Counter(), "gt": Counter()}

    def add(self, frame: ScoredFrame) -> None:
        """Counts the frame's files."""
        for side, facts in (("prediction", frame.prediction), ("gt", frame.ground_truth)):
            if facts is not None:
                self._counts[side][facts] += 1

    def most_frequent(self, side: str) -> FileFacts | None:
        """Returns the most frequent kind of file of "prediction" or "gt", None if none was read."""
        return next((facts for facts, _ in self._counts[side].most_common(1)), None)

    def notes(self) -> list[str]:
        """Returns a line for the predictions, and one for the ground truth."""
        lines = []
        for side, option in (("prediction", "--pred-scale"), ("gt", "--gt-scale")):
            kinds = self._counts[side].most_common()
            texts = [
                f"{facts.source}{f'; {option} to change' if facts.assumed_scale else ''}"
                + (f" ({count:,} files)" if len(kinds) > 1 else "")
                for facts, count in kinds[:_LISTED]
            ]
            more = len(kinds) - _LISTED
            if texts:
                lines.append(f"{side}: {', '.join(texts)}{f', {more} more kinds' * (more > 0)}")
        return lines


def diagnose(
    rows: Sequence[FrameScores], protocol: EvalProtocol, kinds: FileKinds
) -> tuple[str, ...]:
    """Returns the warnings of an evaluation, each one line."""
    scored = [row for row in rows if row.scored]
    warnings = [
        *_unscored(rows),
        _coverage(scored, protocol),
        _holes(scored),
        _fits(scored, protocol),
        _scale(scored, kinds),
        _leak(scored, protocol),
    ]
    return tuple(line for line in warnings if line)


def _unscored(rows: Sequence[FrameScores]) -> list[str]:
    missing = [row.name for row in rows if row.missing]
    failed = [row for row in rows if not row.scored and not row.missing]
    lines = [
        f"warning: {len(missing):,} of {len(rows):,} frames have no prediction:"
        f" {some_names(missing)}"
    ] * bool(missing)
    lines += [
        f"warning: frame {one_line(row.name)} was not scored: {row.error}"
        for row in failed[:_LISTED]
    ]
    more = len(failed) - _LISTED
    return [*lines, *([f"warning: {more:,} more frames were not scored"] * (more > 0))]


def _coverage(rows: Sequence[FrameScores], protocol: EvalProtocol) -> str | None:
    known = sum(row.known for row in rows)
    empty = known - sum(row.predicted for row in rows)
    if not empty:
        return None
    treatment = {
        "skip": "lowers the coverage and is in no error",
        "min": f"is scored as {protocol.min_depth:g} m",
        "max": f"is scored as {protocol.max_depth or 0:g} m",
    }.get(protocol.missing, "")
    if protocol.is_devkit:
        treatment = "was filled in from its neighbours before scoring"
    return (
        f"warning: {empty:,} pixels ({empty / known:.2%}) of the ground truth have no prediction;"
        f" what is missing {treatment}"
    )


def _holes(rows: Sequence[FrameScores]) -> str | None:
    holes = [row.name for row in rows if row.holes]
    if not holes:
        return None
    return (
        f"warning: {len(holes):,} predictions have empty rows between filled ones, which the"
        f" development kit sets to −1 m and scores (its logarithmic errors are then NaN):"
        f" {some_names(holes)}"
    )


def _fits(rows: Sequence[FrameScores], protocol: EvalProtocol) -> str | None:
    """The spread of the factors that predictions were scaled by."""
    factors = np.array([row.fit.factor for row in rows if row.fit is not None])
    if not len(factors):
        return None
    median = float(np.median(factors))
    spread = float(np.std(factors / median)) if median else math.nan
    return (
        f"scale-by {protocol.scale_by}: factor {median:.4g} (median of {len(factors):,} images),"
        f" standard deviation / median {spread:.3f}"
    )


def _scale(rows: Sequence[FrameScores], kinds: FileKinds) -> str | None:
    ratios = [row.ratio for row in rows if math.isfinite(row.ratio)]
    if not ratios:
        return None
    ratio = float(np.median(ratios))
    factors = (*_SCALE_QUOTIENTS, *(1 / factor for factor in _SCALE_QUOTIENTS))
    near = [factor for factor in factors if abs(math.log(ratio / factor)) < _TOLERANCE]
    if not near:
        return None
    factor_text = f"{near[0]:.4g}" if near[0] >= 1 else f"1/{1 / near[0]:.4g}"
    return (
        f"warning: predictions are {ratio:.4g} times the ground truth (median), about"
        f" {factor_text}: a scale is probably wrong{_scale_advice(near[0], kinds)}"
    )


def _scale_advice(factor: float, kinds: FileKinds) -> str:
    """The option that would remove the factor; of a scale that a file itself states, last."""
    sides = (("--pred-scale", "prediction", factor), ("--gt-scale", "gt", 1 / factor))
    files = [(option, kinds.most_frequent(side), by) for option, side, by in sides]
    integer = [(option, facts, by) for option, facts, by in files if facts and facts.scale]
    unstated = [entry for entry in integer if not entry[1].scale_in_file]
    advice = [
        f"{option} {(facts.scale or 1) * by:.6g} (now {facts.scale:g})"
        for option, facts, by in unstated or integer
    ]
    return f"; {' or '.join(advice)} would remove it" if advice else "; float files hold metres"


def _leak(rows: Sequence[FrameScores], protocol: EvalProtocol) -> str | None:
    checked = [row for row in rows if row.has_sparse]
    leaked, pixels = sum(row.leaked for row in checked), sum(row.pixels for row in checked)
    if not leaked or protocol.exclude_sparse:
        return None
    fraction = leaked / pixels
    sign = "warning: " if fraction >= _LEAK_WARNING_FRACTION else ""
    return (
        f"{sign}{leaked:,} of the scored pixels ({fraction:.2%}) have a point of the sparse input"
        " as ground truth, which the prediction could copy; --exclude-sparse leaves them out"
    )
