"""`pnpdepth batch`: all frames of a folder or a list, refined; what is done already stays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.lock import in_turn, locked_folder
from pnpdepth_cli.io.report import remove_report_leftovers
from pnpdepth_cli.pipeline.batch.frames import (
    BatchFrames,
    BatchRequest,
    find_frames,
    source_files,
    task_of,
)
from pnpdepth_cli.pipeline.batch.profile import BatchProfile
from pnpdepth_cli.pipeline.batch.settings import model_identity, settings_of
from pnpdepth_cli.pipeline.batch.state import NEW, BatchState, remove_all_leftovers
from pnpdepth_cli.pipeline.batch.summary import CSV, JSON, Tally, write_summary, write_table
from pnpdepth_cli.pipeline.ordered_pool import in_order

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.report.batch import BatchReport

_NAMED = 5
"""So many of a list of files are named, the rest is counted; summary.json has all."""


class Listener(Protocol):
    """Who is told how a batch goes on."""

    def say(self, text: str) -> None:
        """Something a person should know."""

    def begin(self, to_do: int) -> None:
        """So many frames are to be done; the network is loaded."""

    def frame(self, row: dict[str, Any]) -> None:
        """One of them is done, or has failed: its row of the summary."""


@dataclass(frozen=True, kw_only=True)
class BatchOutcome:
    """summary: what summary.json holds but the frames. stopped: before all frames were done."""

    summary: dict[str, Any]
    stopped: bool


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A frame that is to be done, and why."""

    name: str
    why: str


def run_batch(
    request: BatchRequest, listener: Listener, stopped: Callable[[], bool] = lambda: False
) -> BatchOutcome:
    """Every frame that is to be done is on disk, or has a row that says why not.

    stopped() is asked before each frame. Raises the errors of `pnpdepth_cli.errors`: not what is
    wrong with one frame, but with all, such as a network that cannot be loaded, or a full disk.
    """
    found = find_frames(request)
    report = _report_of(request, found)
    for text in _said_of(request, found):
        listener.say(text)
    make_folder(request.output)

    def clean() -> None:
        leftovers = remove_all_leftovers(request.output)
        leftovers += 0 if report is None else remove_report_leftovers(report.folder)
        if leftovers:
            listener.say(f"removed {leftovers:,} half-written files of a run that was killed")

    with locked_folder(request.output, request.shard, clean):
        state = BatchState(request.output, request.shard, model_identity(request.refine))
        for note in state.notes():
            listener.say(note)
        to_do, reasons = _to_do(request, found, state)
        done = len(found.chosen) - len(to_do)
        listener.say(_plan_text(len(found.chosen), done, reasons))
        began, profile = 0, BatchProfile()
        if report is not None:
            report.begin()
        if to_do:
            made = _rows(request, found, to_do, state, listener, stopped, profile)
            with closing(made if report is None else _drawn(report, made)) as rows:
                listener.begin(len(to_do))
                for row in rows:
                    began += 1
                    listener.frame(row)
        with in_turn(request.output):  # so the shard that ends last has the last word
            state.read_others()
            summary = _summarise(request, found, state, report, profile)
    return BatchOutcome(summary=summary, stopped=began < len(to_do))


def plan_batch(request: BatchRequest, say: Callable[[str], None]) -> list[Planned]:
    """The frames that `run_batch` would do, and why; nothing is written."""
    found = find_frames(request)
    _report_of(request, found)
    for text in _said_of(request, found):
        say(text)
    state = BatchState(request.output, request.shard, model_identity(request.refine))
    planned = []
    for frame in found.chosen:
        why = state.why_to_do(task_of(request, frame))
        if why is not None:
            planned.append(Planned(name=frame.name, why=why))
    reasons = Counter(each.why for each in planned)
    say(_plan_text(len(found.chosen), len(found.chosen) - len(planned), reasons))
    return planned


def _to_do(
    request: BatchRequest, found: BatchFrames, state: BatchState
) -> tuple[list[Frame], Counter[str]]:
    """The frames that are to be done, and how often for which reason.

    OutputError if one would replace a file that is not a batch's, unless that is allowed.
    """
    frames, reasons = [], Counter[str]()
    if state.fresh and not request.refine.outputs.overwrite:
        state.check_foreign(request.output / name for name in (CSV, JSON))
    for frame in found.chosen:
        task = task_of(request, frame)
        why = state.why_to_do(task)
        if why is None:
            continue
        if why == NEW and not request.refine.outputs.overwrite:
            state.check_foreign(task.outputs.paths())
        frames.append(frame)
        reasons[why] += 1
    return frames, reasons


def _rows(
    request: BatchRequest,
    found: BatchFrames,
    to_do: list[Frame],
    state: BatchState,
    listener: Listener,
    stopped: Callable[[], bool],
    profile: BatchProfile,
) -> Generator[dict[str, Any], None, None]:
    """A row for each frame as it is done; the network is loaded before the first is asked for."""
    # They import torch, which a run with nothing to do can do without.
    from pnpdepth_cli.pipeline.batch.running import run_tasks, settle_refiner

    refiner = settle_refiner((task_of(request, frame) for frame in found.frames), listener.say)
    return run_tasks(
        (task_of(request, frame) for frame in to_do),
        refiner,
        state,
        workers=request.workers,
        batch_size=request.batch_size,
        proven=len(to_do) < len(found.chosen),
        stopped=stopped,
        say=listener.say,
        profile=profile,
    )


def _report_of(request: BatchRequest, found: BatchFrames) -> BatchReport | None:
    """The report that is asked for. OutputError if it cannot, or may not, be written there."""
    if request.html is None:
        return None
    from pnpdepth_cli.pipeline.report.batch import BatchReport

    report = BatchReport(folder=request.html, output=request.output, workers=request.workers)
    files = (path for frame in found.frames for path in source_files(frame))
    inputs = [request.source, *(files if request.html.exists() else ())]
    report.check(inputs, overwrite=request.refine.outputs.overwrite)
    return report


def _drawn(
    report: BatchReport, rows: Generator[dict[str, Any], None, None]
) -> Generator[dict[str, Any], None, None]:
    """The rows, after the report's pictures of their frames are on disk."""
    with closing(rows):
        yield from in_order(report.drawn, rows, report.workers)


def _summarise(
    request: BatchRequest,
    found: BatchFrames,
    state: BatchState,
    report: BatchReport | None,
    profile: BatchProfile,
) -> dict[str, Any]:
    """summary.csv, summary.json and the report are on disk; returns the summary's head."""

    def rows() -> Iterator[dict[str, Any]]:
        for frame in found.frames:
            line = state.result_of(task_of(request, frame))
            if line is not None:
                yield line["row"]

    tally = Tally()

    def counted() -> Iterator[dict[str, Any]]:
        for row in rows():
            tally.add(row)
            yield row

    write_table(request.output / CSV, counted())
    known = sum(tally.counts.values())
    summary = {
        "command": "batch",
        "source": str(request.source),
        "output": str(request.output),
        "layout": found.layout,
        "settings": settings_of(request.refine, state.model),
        "counts": {
            "frames": len(found.frames),
            **tally.counts,
            "pending": len(found.frames) - known,
            "with_warnings": tally.warned,
        },
        "mean": tally.mean(),
        "unmatched": [str(each) for each in found.unmatched],
    }
    if request.profile:
        summary["profile"] = profile.summary()
    write_summary(request.output / JSON, summary, rows())
    if report is not None:
        report.write(summary, rows)
    return summary


def _said_of(request: BatchRequest, found: BatchFrames) -> Iterator[str]:
    """What was assumed, and which files are in no frame."""
    truths = sum(frame.gt is not None for frame in found.frames)
    guessed = " (guessed; --layout names another)" if request.layout is None else ""
    yield (
        f"layout: {found.layout}{guessed}: {_count(len(found.frames), 'frame')},"
        f" {truths:,} with ground truth"
    )
    cut = sorted({f.protocol.name for f in found.frames if f.protocol.halved or f.protocol.crop})
    if cut and request.protocol is None:
        yield f"protocol: {', '.join(cut)} cuts the frames; --protocol whole keeps all of them"
    if request.limit is not None:
        yield f"limit: the first {request.limit:,} of them"
    if request.shard is not None:
        number, of = request.shard
        yield f"shard {number}/{of}: {_count(len(found.chosen), 'frame')} of them"
    for each in found.unmatched[:_NAMED]:
        yield f"warning: {each}"
    if len(found.unmatched) > _NAMED:
        yield (
            f"warning: {len(found.unmatched) - _NAMED:,} more files are in no frame; summary.json"
            " lists them"
        )


def _plan_text(frames: int, done: int, reasons: Counter[str]) -> str:
    kinds = Counter[str]()
    for why, count in reasons.items():
        kinds[why.split(":")[0]] += count
    because = ", ".join(f"{count:,} {kind}" for kind, count in kinds.items())
    if not kinds:
        return f"{_count(frames, 'frame')}, all of them done already"
    return f"{_count(frames, 'frame')}: {done:,} done already, {frames - done:,} to do ({because})"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
