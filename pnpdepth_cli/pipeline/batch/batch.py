"""`pnpdepth batch`: refines all frames of a folder or a list, except those done already."""

from __future__ import annotations

import sys
from array import array
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.dataset.frame_list import FrameList
from pnpdepth_cli.io.lock import in_turn, locked_folder
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.report import remove_report_leftovers
from pnpdepth_cli.pipeline.batch.frames import (
    BatchFrames,
    Task,
    find_frames,
    source_files,
    task_of,
)
from pnpdepth_cli.pipeline.batch.output_folder import opened_output
from pnpdepth_cli.pipeline.batch.profile import BatchProfile
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.run import BatchRun
from pnpdepth_cli.pipeline.batch.sequence import in_windows, note_of_poses
from pnpdepth_cli.pipeline.batch.sequence_options import SequenceOptions
from pnpdepth_cli.pipeline.batch.settings import model_identity, settings_of
from pnpdepth_cli.pipeline.batch.spread import spread_request, spread_rows
from pnpdepth_cli.pipeline.batch.state import NEW, BatchState, remove_all_leftovers
from pnpdepth_cli.pipeline.batch.summary import CSV, JSON, Tally, write_summary, write_table
from pnpdepth_cli.pipeline.refinement.method import resolve_method

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.report.batch import BatchReport

_MAX_LISTED = 5
"""Files named in messages; the rest is counted, and summary.json lists all."""


class Listener(Protocol):
    """Receives the progress of a batch."""

    def say(self, text: str) -> None:
        """Receives a note or a warning, one line."""

    def begin(self, to_do: int) -> None:
        """Called once the network is loaded, with the number of frames to do."""

    def frame(self, row: dict[str, Any]) -> None:
        """Called with the summary's row of each frame that is done or has failed.

        With workers of a cluster it has only name, status and message.
        """


@dataclass(frozen=True, kw_only=True)
class BatchOutcome:
    """How a batch ended."""

    summary: dict[str, Any]
    """The contents of summary.json without its frames."""
    stopped: bool
    """True if it was stopped before all frames were done."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A frame that is to be done."""

    name: str
    """The frame's name."""
    why: str
    """Why it is to be done, such as "new" or "other settings"."""


def run_batch(
    request: BatchRequest, listener: Listener, stopped: Callable[[], bool] = lambda: False
) -> BatchOutcome:
    """Refines every frame that is to be done; one that fails has a row that says why.

    Args:
        request: What to refine, and how.
        listener: Receives notes and the rows of frames.
        stopped: Asked before each frame; True ends the batch.

    Raises:
        PnpDepthError: For what concerns all frames, such as a network that cannot be loaded, or a
            full disk.
    """
    request, spread = spread_request(request)
    if spread is not None and request.sequence.warm_start:
        raise UsageError(
            "--warm-start refines frames in order, in one process; give each process a --shard of"
            " the windows instead of --ray"
        )
    batch = find_frames(request)
    report = _report_of(request, batch)
    for note in _notes_of(request, batch):
        listener.say(note)

    with (
        opened_output(request.output) as folder,
        locked_folder(
            folder.local, request.shard, lambda: _clean(folder.local, report, listener.say)
        ),
    ):
        state = BatchState(folder, request.shard, model_identity(request.refine))
        for note in state.notes():
            listener.say(note)
        to_do, reasons = _to_do(request, batch, state)
        done = len(batch.chosen) - len(to_do)
        listener.say(_plan_text(len(batch.chosen), done, reasons))
        began, profile = 0, BatchProfile()
        if report is not None:
            report.begin()
        if to_do:
            state.announce(to_do.names())
            run = BatchRun(
                state=state, profile=profile, say=listener.say, stopped=stopped,
                workers=request.workers, batch_size=request.batch_size,
            )  # fmt: skip
            proven = len(to_do) < len(batch.chosen)
            if spread is None:
                refined = _rows(request, batch, to_do, run, proven=proven)
            else:
                refined = spread_rows(request, spread, batch.frames, to_do, run, proven=proven)
            with closing(state), closing(refined) as rows:
                listener.begin(len(to_do))
                for row in rows:
                    began += 1
                    listener.frame(row)
        with in_turn(folder.local):  # so the summary of the shard that ends last stays
            state.read_others()
            summary = _summarise(request, batch, state, report, profile)
    return BatchOutcome(summary=summary, stopped=began < len(to_do))


def _clean(folder: Path, report: BatchReport | None, say: Callable[[str], None]) -> None:
    """Removes what a killed run left half-written."""
    leftovers = remove_all_leftovers(folder)
    leftovers += 0 if report is None else remove_report_leftovers(report.folder)
    if leftovers:
        say(f"removed {leftovers:,} half-written files of a run that was killed")


def plan_batch(request: BatchRequest, say: Callable[[str], None]) -> list[Planned]:
    """Returns the frames that `run_batch` would do, and why; nothing is written."""
    request, _ = spread_request(request)
    batch = find_frames(request)
    _report_of(request, batch)
    for note in _notes_of(request, batch):
        say(note)
    planned = []
    with opened_output(request.output, create=False) as folder:
        state = BatchState(folder, request.shard, model_identity(request.refine))
        for frame in batch.chosen:
            why = state.why_to_do(task_of(request, frame))
            if why is not None:
                planned.append(Planned(name=frame.name, why=why))
    reasons = Counter(each.why for each in planned)
    say(_plan_text(len(batch.chosen), len(batch.chosen) - len(planned), reasons))
    return planned


def _to_do(
    request: BatchRequest, batch: BatchFrames, state: BatchState
) -> tuple[FrameList, Counter[str]]:
    """The frames that are to be done, and how many for which reason.

    OutputError if one would replace a file that no batch wrote, unless --overwrite is set.
    """
    numbers, reasons = array("q"), Counter[str]()
    if state.fresh and not request.refine.outputs.overwrite:
        state.check_foreign(request.output / name for name in (CSV, JSON))
    for number, frame in enumerate(batch.chosen):
        task = task_of(request, frame)
        why = state.why_to_do(task)
        if why is None:
            continue
        if why == NEW and not request.refine.outputs.overwrite:
            state.check_foreign(task.outputs.paths())
        numbers.append(number)
        reasons[why] += 1
    return batch.chosen.taken(numbers), reasons


def _rows(
    request: BatchRequest, batch: BatchFrames, to_do: FrameList, run: BatchRun, *, proven: bool
) -> Generator[dict[str, Any], None, None]:
    """A row for each frame as it is done; the network is loaded before the first is taken."""
    # these import torch, which a run with nothing to do does not need
    from pnpdepth_cli.pipeline.batch.resolving import opened_groups, resolve_refiner
    from pnpdepth_cli.pipeline.batch.running import run_tasks

    refiner = resolve_refiner(request, batch.frames, run.say)
    tasks = _tasks(request, batch, to_do)

    def rows() -> Generator[dict[str, Any], None, None]:
        with opened_groups(refiner, run.batch_size, run.say) as groups:
            yield from run_tasks(tasks, groups, run, proven=proven)

    return rows()


def _tasks(request: BatchRequest, batch: BatchFrames, to_do: FrameList) -> Iterator[Task]:
    """The frames to refine in their order, and within windows those that they begin with."""
    if not request.sequence.warm_start:
        yield from (task_of(request, frame) for frame in to_do)
        return
    by_name = {frame.name: frame for frame in batch.frames}
    for wanted in in_windows(to_do):
        names = {frame.name for frame in wanted}
        for each in wanted[-1].window:
            task = task_of(request, by_name[each.name])
            yield replace(task, written=task.name in names)


def _report_of(request: BatchRequest, batch: BatchFrames) -> BatchReport | None:
    """The report, if one is wanted. OutputError if it cannot or may not be written there."""
    if request.html is None:
        return None
    if isinstance(request.output, RemotePath) or isinstance(request.html, RemotePath):
        raise UsageError("--html needs local folders; give a local -o and a local report folder")
    from pnpdepth_cli.pipeline.report.batch import BatchReport

    report = BatchReport(
        folder=request.html,
        output=request.output,
        view_3d=request.html_3d,
        colors=request.refine.outputs.colors,
    )
    files = (path for frame in batch.frames for path in source_files(frame))
    inputs = [request.source, *(files if request.html.exists() else ())]
    report.check(inputs, overwrite=request.refine.outputs.overwrite)
    return report


def _summarise(
    request: BatchRequest,
    batch: BatchFrames,
    state: BatchState,
    report: BatchReport | None,
    profile: BatchProfile,
) -> dict[str, Any]:
    """Writes summary.csv, summary.json and the report; returns the summary without its frames."""

    digests = [sys.intern(state.settings(task_of(request, frame))) for frame in batch.frames]

    def rows() -> Iterator[dict[str, Any]]:
        for name, digest in zip(batch.frames.names(), digests, strict=True):
            line = state.result_of(name, digest)
            if line is not None:
                yield line["row"]

    tally = Tally()
    for row in rows():
        tally.add(row)
    write_table(state.folder.local / CSV, rows(), tally.baseline_names)
    known, method = sum(tally.counts.values()), resolve_method(request.refine)
    summary = {
        "command": "batch",
        "source": str(request.source),
        "output": str(request.output),
        "layout": batch.layout,
        "method": {"kind": "chosen" if method.chosen else "fixed", "why": method.why},
        "settings": settings_of(request.refine, state.model),
        "counts": {
            "frames": len(batch.frames),
            **tally.counts,
            "pending": len(batch.frames) - known,
            "with_warnings": tally.warned,
        },
        "unit": tally.unit,
        "mean": tally.mean(),
        "linear": tally.mean_linear(),
        "baselines": tally.mean_baselines(),
        "unmatched": [str(each) for each in batch.unmatched],
    }
    if request.sequence != SequenceOptions():
        summary["sequence"] = plain(asdict(request.sequence))
    if request.profile:
        summary["profile"] = profile.summary()
    write_summary(state.folder.local / JSON, summary, rows())
    state.folder.publish([CSV, JSON])
    if report is not None:
        report.write(summary, rows)
    return summary


def _notes_of(request: BatchRequest, batch: BatchFrames) -> Iterator[str]:
    """What was assumed, and warnings of files that are in no frame."""
    patterns = list(batch.frames.patterns())
    with_gt = batch.frames.count_of("gt")
    guessed = " (guessed; --layout names another)" if request.layout is None else ""
    yield (
        f"layout: {batch.layout}{guessed}: {_count(len(batch.frames), 'frame')},"
        f" {with_gt:,} with ground truth"
    )
    cut = sorted({f.protocol.name for f in patterns if f.protocol.halved or f.protocol.crop})
    if cut and request.protocol is None:
        yield f"protocol: {', '.join(cut)} cuts the frames; --protocol whole keeps all of them"
    poses = note_of_poses(patterns)
    if poses is not None:
        yield poses
    if request.limit is not None:
        yield f"limit: the first {request.limit:,} of them"
    if request.shard is not None:
        number, of = request.shard
        yield f"shard {number}/{of}: {_count(len(batch.chosen), 'frame')} of them"
    for each in batch.unmatched[:_MAX_LISTED]:
        yield f"warning: {each}"
    if len(batch.unmatched) > _MAX_LISTED:
        more = len(batch.unmatched) - _MAX_LISTED
        yield f"warning: {more:,} more files are in no frame; summary.json lists them"


def _plan_text(frames: int, done: int, reasons: Counter[str]) -> str:
    kinds = Counter[str]()
    for why, count in reasons.items():
        kinds[why.split(":")[0]] += count
    reason_text = ", ".join(f"{count:,} {kind}" for kind, count in kinds.items())
    if not kinds:
        return f"{_count(frames, 'frame')}, all of them done already"
    return (
        f"{_count(frames, 'frame')}: {done:,} done already, {frames - done:,} to do ({reason_text})"
    )


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
