"""The runs that `pnpdepth compare` reads: scores of frames, as `eval` or `batch` saved them."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import one_line, read_json
from pnpdepth_cli.measures import AFTER, BEFORE, GT, MEASURES, Measure
from pnpdepth_cli.settings import OF_UPDATES

Rows = list[list[int | float | None]]
"""A row for each frame, with a value for each key; None for a value that the frame lacks."""

_SUMMARY = "summary.json"
"""The file in a batch's folder that holds its scores."""
_RULES_OF_BATCHES = EvalRequest(prediction=Path(), ground_truth=Path()).scoring
"""How batches score, whose summaries do not say it: as `eval` does by default."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """The scores of one run, as a file holds them."""

    name: str
    """Name of the batch's folder, or of the file without its ending."""
    path: str
    """The run as the user named it: a file or a folder, which may end in `:before`."""
    measures: list[Measure]
    """Measures that all frames have."""
    scoring: dict[str, object]
    """The rules that decide the scores, as `EvalRequest.scoring` has them."""
    frames: dict[str, FrameRecord]
    """The scored frames by name. Their errors of stage "after" are those that are compared."""
    varied: dict[str, str]
    """Options that `batch --vary` varied, with their values; empty for other runs."""

    def rows(self, names: Sequence[str], keys: Sequence[str], stage: str = AFTER) -> Rows:
        """Returns the scores of these frames, in this order: a row a frame, a column a key.

        A score that a frame lacks is None.

        Args:
            names: Names of frames of the run.
            keys: Keys of measures, or of the counts beside them.
            stage: Stage of the refinement whose depth was scored: "before" or "after".
        """
        scores = [self.frames[name].errors[GT].get(stage, {}) for name in names]
        return [[of_frame.get(key) for key in keys] for of_frame in scores]


def read_run(text: str) -> Run:
    """Returns the run that a user named.

    Args:
        text: Path of a file that `eval --json` or `batch` wrote, or of a batch's folder. With
            `:before` behind it, the depth before the refinement takes the place of the result.

    Raises:
        InputError: The file cannot be read, or holds no scores.
    """
    # The file, and which side of the refinement.
    path = Path(text)
    stage = AFTER
    if text.endswith(f":{BEFORE}") and not path.exists():
        path = Path(text.removesuffix(f":{BEFORE}"))
        stage = BEFORE
    if path.is_dir():
        path /= _SUMMARY
    # A batch is named as its folder, also where that is given as "." or by a link.
    name = path.stem
    if path.name == _SUMMARY:
        name = Path(os.path.realpath(path)).parent.name
    if stage == BEFORE:
        name = f"{name}:{BEFORE}"
    # The frames with scores, and the measures that all of them have.
    content = read_json(path)
    try:
        records = [FrameRecord.from_json(entry, path) for entry in content.get("frames") or ()]
        scored = [frame for frame in records if frame.status != "failed" and GT in frame.errors]
        scores = [frame.errors[GT][stage] for frame in scored]
        if not scores:
            raise InputError(f"{path}: no frame has scores; refine or evaluate with ground truth")
        measures = [_read_measure(entry) for entry in content.get("measures", ())] or MEASURES
        return Run(
            name=name,
            path=text,
            measures=[
                measure
                for measure in measures
                if all(measure.key in of_frame for of_frame in scores)
            ],
            scoring=dict(content.get("scoring") or _RULES_OF_BATCHES),
            frames={
                frame.name: replace(frame, errors={GT: frame.errors[GT] | {AFTER: of_frame}})
                for frame, of_frame in zip(scored, scores, strict=True)
            },
            varied={str(key): str(value) for key, value in content.get("varied", {}).items()},
        )
    # Another program's JSON may hold anything in the place of what is looked for above.
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path} does not hold scores as pnpdepth writes them ({one_line(repr(error))}); give"
            " what eval --json printed, or the summary of a batch with ground truth"
        ) from error


def _read_measure(entry: Mapping[str, Any]) -> Measure:
    """The measure of an entry that `Measure.to_json` wrote.

    Raises:
        TypeError, ValueError, KeyError: The entry has other fields than a measure, or tables cannot
            show it.
    """
    measure = Measure(**entry)
    # Its heading and a value are made as tables do it, so that a wrong field fails here.
    if not (isinstance(measure.key, str) and measure.heading and measure.text(1.0)):
        raise ValueError(f"{measure.key!r} is no measure")
    return measure


def without_repeats(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Returns the runs without those that repeat an earlier one, and a note on each repeated one.

    Some options have no effect on a run without updates of z, but studies of earlier versions have
    a run for each of their values. Such runs are returned without these options, and are one if
    their scores are the same as well.
    """
    different = list[Run]()
    repeats = defaultdict[str, list[str]](list)  # paths of runs, by that of the run they repeat
    for run in runs:
        # A run with updates of z repeats none.
        if run.varied.get("iterations") != "0":
            different.append(run)
            continue
        effective = {name: text for name, text in run.varied.items() if name not in OF_UPDATES}
        run_of_effect = replace(run, varied=effective)
        original = next(
            (earlier for earlier in different if _is_repeat(run_of_effect, earlier)), None
        )
        if original is None:
            different.append(run_of_effect)
        else:
            repeats[original.path].append(run.path)
    notes = [
        f"listed once, as {path}: {', '.join(repeating)} gave the same result, since z is not"
        " updated"
        for path, repeating in repeats.items()
    ]
    return different, notes


def _is_repeat(run: Run, earlier: Run) -> bool:
    """Whether a run has the varied values, the frames and the scores of an earlier one."""
    if run.varied != earlier.varied or run.frames.keys() != earlier.frames.keys():
        return False
    return all(
        record.errors[GT] == earlier.frames[name].errors[GT] for name, record in run.frames.items()
    )
