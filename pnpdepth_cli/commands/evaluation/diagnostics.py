"""Notes of an evaluation: what was assumed, and warnings of what looks wrong."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from pnpdepth_cli.commands.evaluation.frame_reading import DepthKind
from pnpdepth_cli.commands.evaluation.frame_scoring import FrameScores
from pnpdepth_cli.commands.evaluation.pairing import some_names
from pnpdepth_cli.commands.evaluation.protocols import EvalProtocol
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import one_line

# Codes per metre in use are 5000 (TUM), 1000, 256 (KITTI), 100, 10; a wrong one gives a quotient.
_SCALE_QUOTIENTS = (1000.0, 256.0, 100.0, 10.0, 1000.0 / 256.0, 5.0, 5000.0 / 256.0, 5000.0)
_TOLERANCE = math.log(1.1)
_LEAK_WARNING_FRACTION = 0.01
_LISTED = 3
_OPTIONS = {"prediction": "--pred-scale", "gt": "--gt-scale", "sparse": "--sparse-scale"}


def kinds_of(rows: Sequence[FrameScores]) -> dict[str, list[tuple[DepthKind, int]]]:
    """Returns the kinds of files of "prediction", "gt" and "sparse" with counts, frequent first."""
    return {
        side: Counter(row.kinds[side] for row in rows if side in row.kinds).most_common()
        for side in _OPTIONS
    }


def kind_notes(rows: Sequence[FrameScores]) -> list[str]:
    """Returns a line for the predictions, and one for the ground truth."""
    lines = []
    for side in ("prediction", "gt"):
        kinds = kinds_of(rows)[side]
        texts = [
            kind.source
            + (f"; {_OPTIONS[side]} to change" if kind.assumed else "")
            + (f" ({count:,} files)" if len(kinds) > 1 else "")
            for kind, count in kinds[:_LISTED]
        ]
        more = len(kinds) - _LISTED
        if texts:
            lines.append(f"{side}: {', '.join(texts)}{f', {more} more kinds' * (more > 0)}")
    return lines


def warnings_of(rows: Sequence[FrameScores], protocol: EvalProtocol) -> list[str]:
    """Returns the warnings of an evaluation, each one line.

    Raises:
        InputError: If a scale that was assumed is wrong by a factor between those in use.
    """
    scored = [row for row in rows if row.scored]
    return [
        *_unscored(rows),
        *_coverage(scored, protocol),
        *_holes(scored),
        *_fits(scored, protocol),
        *_scale("predictions", [row.ratio for row in scored], rows),
        *_scale("sparse points", [row.sparse_ratio for row in scored], rows),
        *_leak(scored, protocol),
    ]


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


def _coverage(rows: Sequence[FrameScores], protocol: EvalProtocol) -> list[str]:
    known = sum(row.known for row in rows)
    empty = known - sum(row.predicted for row in rows)
    if not empty:
        return []
    treatment = {
        "skip": "lowers the coverage and is in no error",
        "min": f"is scored as {protocol.min_depth:g} m",
        "max": f"is scored as {protocol.max_depth or 0:g} m",
    }.get(protocol.missing, "")
    if protocol.is_devkit:
        treatment = "was filled in from its neighbours before scoring"
    return [
        f"warning: {empty:,} pixels ({empty / known:.2%}) of the ground truth have no prediction;"
        f" what is missing {treatment}"
    ]


def _holes(rows: Sequence[FrameScores]) -> list[str]:
    holes = [row.name for row in rows if math.isnan(row.values.get("log_mae", 0.0))]
    return [
        f"warning: {len(holes):,} predictions have empty rows between filled ones, which the"
        f" development kit sets to −1 m and scores (its logarithmic errors are then NaN):"
        f" {some_names(holes)}"
    ] * bool(holes)


def _fits(rows: Sequence[FrameScores], protocol: EvalProtocol) -> list[str]:
    """The spread of the factors that predictions were scaled by."""
    factors = np.array([row.fit.factor for row in rows if row.fit is not None])
    if not len(factors):
        return []
    median = float(np.median(factors))
    spread = float(np.std(factors / median)) if median else math.nan
    return [
        f"scale-by {protocol.scale_by}: factor {median:.4g} (median of {len(factors):,} images),"
        f" standard deviation / median {spread:.3f}"
    ]


def _scale(what: str, ratios: Sequence[float], rows: Sequence[FrameScores]) -> list[str]:
    """A warning if depths are a multiple of the ground truth that wrong codes per metre explain."""
    known = [ratio for ratio in ratios if math.isfinite(ratio)]
    ratio = float(np.median(known)) if known else 1.0
    quotients = (*_SCALE_QUOTIENTS, *(1 / factor for factor in _SCALE_QUOTIENTS))
    near = [factor for factor in quotients if abs(math.log(ratio / factor)) < _TOLERANCE]
    if not near:
        return []
    factor = near[0]
    sides = {"prediction" if what == "predictions" else "sparse": factor, "gt": 1 / factor}
    kinds = {side: found[0][0] for side, found in kinds_of(rows).items() if found}
    integer = [(side, kinds[side], by) for side, by in sides.items()
               if side in kinds and kinds[side].scale]  # fmt: skip
    unstated = [each for each in integer if "(from the file)" not in each[1].source]
    advice = " or ".join(
        f"{_OPTIONS[side]} {(kind.scale or 1) * by:.6g} (now {kind.scale:g})"
        for side, kind, by in unstated or integer
    )
    text = f"{factor:.4g}" if factor >= 1 else f"1/{1 / factor:.4g}"
    fact = (
        f"{what} are {ratio:.4g} times the ground truth (median), about {text}: a scale is"
        f" probably wrong; {f'{advice} would remove it' if advice else 'float files hold metres'}"
    )
    if assumed := [(side, kind) for side, kind, _ in integer if kind.assumed]:
        stated = " ".join(f"{_OPTIONS[side]} {kind.scale:g}" for side, kind in assumed)
        raise InputError(f"{fact}, {stated} keeps it")
    return [f"warning: {fact}"]


def _leak(rows: Sequence[FrameScores], protocol: EvalProtocol) -> list[str]:
    checked = [row for row in rows if row.leaked is not None]
    leaked, pixels = sum(row.leaked or 0 for row in checked), sum(row.pixels for row in checked)
    if not leaked or protocol.exclude_sparse:
        return []
    fraction = leaked / pixels
    sign = "warning: " if fraction >= _LEAK_WARNING_FRACTION else ""
    return [
        f"{sign}{leaked:,} of the scored pixels ({fraction:.2%}) have a point of the sparse input"
        " as ground truth, which the prediction could copy; --exclude-sparse leaves them out"
    ]
