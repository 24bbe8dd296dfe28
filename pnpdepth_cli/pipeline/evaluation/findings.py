"""What a person should be told of an evaluation: what was assumed, and what looks wrong."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.pipeline.evaluation.frame_scoring import FileFacts, FrameScores, ScoredFrame
from pnpdepth_cli.pipeline.evaluation.pairing import some_names
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol

# Codes per metre in use are 1000, 256, 100, 10, and their quotients are what mistaking one makes.
_ROUND_FACTORS = (1000.0, 256.0, 100.0, 10.0, 1000.0 / 256.0)
_NEAR = math.log(1.1)
_LEAK_WORTH_A_WARNING = 0.01
_LISTED = 3


class FileKinds:
    """What the files of a run are, counted as they come."""

    def __init__(self) -> None:
        self._counted: dict[str, Counter[FileFacts]] = {"prediction": Counter(), "gt": Counter()}

    def add(self, frame: ScoredFrame) -> None:
        """The frame's files are counted."""
        for side, facts in (("prediction", frame.prediction), ("gt", frame.truth)):
            if facts is not None:
                self._counted[side][facts] += 1

    def usual(self, side: str) -> FileFacts | None:
        """The most frequent kind of file of a side, None if there was none."""
        return next((facts for facts, _ in self._counted[side].most_common(1)), None)

    def notes(self) -> list[str]:
        """A line for each side."""
        lines = []
        for side, option in (("prediction", "--pred-scale"), ("gt", "--gt-scale")):
            kinds = self._counted[side].most_common()
            said = [
                f"{facts.source}{f'; {option} to change' if facts.assumed_scale else ''}"
                + (f" ({count:,} files)" if len(kinds) > 1 else "")
                for facts, count in kinds[:_LISTED]
            ]
            more = len(kinds) - _LISTED
            if said:
                lines.append(f"{side}: {', '.join(said)}{f', {more} more kinds' * (more > 0)}")
        return lines


def findings(
    rows: Sequence[FrameScores], protocol: EvalProtocol, kinds: FileKinds
) -> tuple[str, ...]:
    """The warnings, each one line."""
    good = [row for row in rows if row.scored]
    found = [
        *_unscored(rows),
        _coverage(good, protocol),
        _holes(good),
        _factor(good, kinds),
        _leak(good, protocol),
    ]
    return tuple(line for line in found if line)


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


def _coverage(good: Sequence[FrameScores], protocol: EvalProtocol) -> str | None:
    known = sum(row.known for row in good)
    lost = known - sum(row.pixels for row in good)
    if not lost:
        return None
    what = (
        "was filled in from its neighbours before scoring"
        if protocol.is_devkit
        else "is in the coverage, not in the errors"
    )
    return (
        f"warning: {lost:,} pixels ({lost / known:.2%}) of the truth have no prediction; what is"
        f" missing {what}"
    )


def _holes(good: Sequence[FrameScores]) -> str | None:
    holes = [row.name for row in good if row.holes]
    if not holes:
        return None
    return (
        f"warning: {len(holes):,} predictions have empty rows between others, which the development"
        f" kit leaves at −1 m and scores so (its logarithmic errors are then no number):"
        f" {some_names(holes)}"
    )


def _factor(good: Sequence[FrameScores], kinds: FileKinds) -> str | None:
    ratios = [row.ratio for row in good if math.isfinite(row.ratio)]
    if not ratios:
        return None
    ratio = float(np.median(ratios))
    factors = (*_ROUND_FACTORS, *(1 / factor for factor in _ROUND_FACTORS))
    near = [factor for factor in factors if abs(math.log(ratio / factor)) < _NEAR]
    if not near:
        return None
    said = f"{near[0]:.4g}" if near[0] >= 1 else f"1/{1 / near[0]:.4g}"
    return (
        f"warning: predictions are {ratio:.4g} times the truth (median), about {said}: a scale is"
        f" probably wrong{_scale_advice(near[0], kinds)}"
    )


def _scale_advice(factor: float, kinds: FileKinds) -> str:
    """Which option would take the factor away; that of a scale in a file itself comes last."""
    sides = (("--pred-scale", "prediction", factor), ("--gt-scale", "gt", 1 / factor))
    found = [(option, kinds.usual(side), by) for option, side, by in sides]
    integer = [(option, facts, by) for option, facts, by in found if facts and facts.scale]
    doubtful = [entry for entry in integer if not entry[1].scale_in_file]
    advice = [
        f"{option} {(facts.scale or 1) * by:.6g} (now {facts.scale:g})"
        for option, facts, by in doubtful or integer
    ]
    return f"; {' or '.join(advice)} would take it away" if advice else "; float files hold metres"


def _leak(good: Sequence[FrameScores], protocol: EvalProtocol) -> str | None:
    checked = [row for row in good if row.has_sparse]
    given, pixels = sum(row.given for row in checked), sum(row.pixels for row in checked)
    if not given or protocol.exclude_sparse:
        return None
    share = given / pixels
    sign = "warning: " if share >= _LEAK_WORTH_A_WARNING else ""
    return (
        f"{sign}{given:,} of the scored pixels ({share:.2%}) hold a value of the sparse input as"
        " truth, which the prediction could copy; --exclude-sparse leaves such pixels out"
    )
