"""`pnpdepth batch`: refines all frames of a folder or a list, except those done already."""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.lock import in_turn, locked_folder
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.remote.store import upload
from pnpdepth_cli.io.report import remove_report_leftovers
from pnpdepth_cli.pipeline.batch.frames import (
    BatchFrames,
    Task,
    find_frames,
    source_files,
    task_of,
)
from pnpdepth_cli.pipeline.batch.request import BatchRequest, SequenceOptions
from pnpdepth_cli.pipeline.batch.sequence import in_windows, note_of_poses
from pnpdepth_cli.pipeline.batch.settings import model_identity, settings_of
from pnpdepth_cli.pipeline.batch.state import BatchState, Row, remove_all_leftovers
from pnpdepth_cli.pipeline.batch.summary import CSV, JSON, Tally, profile_of, write_summaries
from pnpdepth_cli.pipeline.cluster.options import RayWorkers, ray_workers_of
from pnpdepth_cli.pipeline.ordered_pool import in_order

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.report.batch import BatchReport

_MAX_LISTED = 5
"""Files named in messages; the rest is counted, and summary.json lists all."""
_READERS = 8
"""Threads that read records, whose time on network storage is waiting."""
_PART = 256
"""Records that a thread reads at once."""


class Listener(Protocol):
    """Receives the progress of a batch."""

    def say(self, text: str) -> None:
        """Receives a note or a warning, one line."""

    def begin(self, to_do: int) -> None:
        """Called once the network is loaded, with the number of frames to do."""

    def frame(self, row: Row) -> None:
        """Called with the summary's row of each frame that is done or has failed."""


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
    request, workers = _request_of_workers(request)
    if workers is not None and request.sequence.warm_start:
        raise UsageError(
            "--warm-start refines frames in order, in one process; give each process a --shard of"
            " the windows instead of --ray"
        )
    batch = find_frames(request)
    report = _report_of(request, batch)
    for note in _notes_of(request, batch):
        listener.say(note)
    state = BatchState(request.output, model_identity(request.refine))
    with ExitStack() as stack:
        local = _opened_output(request, stack, report, listener.say)
        to_do, reasons = _to_do(request, batch, state)
        done = len(batch.chosen) - len(to_do)
        listener.say(_plan_text(len(batch.chosen), done, reasons))
        state.mark()
        if report is not None:
            report.begin()
        began, refined_frames, start = 0, 0, time.perf_counter()
        seconds = Counter[str]()
        if to_do:
            refined = _rows(request, batch, to_do, state, workers, listener, stopped)
            with closing(refined) as rows:
                for row in rows:
                    listener.frame(row)
                    began += 1
                    refined_frames += row["status"] != "failed"
                    seconds.update(row.get("seconds") or {})
        profile = profile_of(seconds, refined_frames, time.perf_counter() - start)
        with in_turn(local):  # so the summary of the shard that ends last stays
            summary = _summarise(request, batch, local, report, profile)
    return BatchOutcome(summary=summary, stopped=began < len(to_do))


def plan_batch(request: BatchRequest, say: Callable[[str], None]) -> list[Planned]:
    """Returns the frames that `run_batch` would do, and why; nothing is written."""
    request, _ = _request_of_workers(request)
    batch = find_frames(request)
    _report_of(request, batch)
    for note in _notes_of(request, batch):
        say(note)
    state = BatchState(request.output, model_identity(request.refine))
    planned = [
        Planned(name=batch.chosen[number].name, why=why)
        for number, why in _reasons(request, batch, state, check=False)
    ]
    reasons = Counter(each.why for each in planned)
    say(_plan_text(len(batch.chosen), len(batch.chosen) - len(planned), reasons))
    return planned


def _request_of_workers(request: BatchRequest) -> tuple[BatchRequest, RayWorkers | None]:
    """The request of each worker, and the Ray workers; None for this process alone."""
    workers = ray_workers_of(request.refine.network.device, request.cluster)
    if workers is None:
        return request, None
    return replace(request, refine=request.refine.with_fields(device=workers.device)), workers


def _opened_output(
    request: BatchRequest,
    stack: ExitStack,
    report: BatchReport | None,
    say: Callable[[str], None],
) -> Path:
    """The output folder, locked; of one in a store, a local folder for the summaries."""
    if isinstance(request.output, RemotePath):
        return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pnpdepth-")))

    def clean() -> None:
        leftovers = remove_all_leftovers(request.output)
        leftovers += 0 if report is None else remove_report_leftovers(report.folder)
        if leftovers:
            say(f"removed {leftovers:,} half-written files of a run that was killed")

    make_folder(request.output)
    stack.enter_context(locked_folder(request.output, request.shard, clean))
    return request.output


def _to_do(
    request: BatchRequest, batch: BatchFrames, state: BatchState
) -> tuple[list[Frame], Counter[str]]:
    """The frames that are to be done, and how many for which reason.

    OutputError if one would replace a file that no batch wrote, unless --overwrite is set.
    """
    check = not request.refine.outputs.overwrite
    if check:
        state.check_replaceable(request.output / name for name in (CSV, JSON))
    planned = list(_reasons(request, batch, state, check=check))
    return [batch.chosen[number] for number, _ in planned], Counter(why for _, why in planned)


def _reasons(
    request: BatchRequest, batch: BatchFrames, state: BatchState, *, check: bool
) -> Iterator[tuple[int, str]]:
    """The numbers of the frames that are to be done, and why.

    OutputError, if `check`, where one would replace a file that no batch wrote.
    """

    def of_part(start: int) -> list[tuple[int, str]]:
        reasons = []
        for number in range(start, min(start + _PART, len(batch.chosen))):
            task = task_of(request, batch.chosen[number])
            why = state.reason_to_refine(task)
            if why is not None:
                if check:
                    state.check_replaceable(task.outputs.paths(), task.record)
                reasons.append((number, why))
        return reasons

    for part in in_order(of_part, range(0, len(batch.chosen), _PART), _READERS):
        yield from part


def _rows(
    request: BatchRequest,
    batch: BatchFrames,
    to_do: list[Frame],
    state: BatchState,
    workers: RayWorkers | None,
    listener: Listener,
    stopped: Callable[[], bool],
) -> Generator[Row, None, None]:
    """A row for each frame as it is done, in this process or on Ray workers."""
    # these import torch, which a run with nothing to do does not need
    from pnpdepth_cli.pipeline.batch.ray_workers import rows_of_workers
    from pnpdepth_cli.pipeline.batch.resolving import load_batch_refiner, references_of
    from pnpdepth_cli.pipeline.batch.running import opened_network, refine_tasks

    references = references_of(request, batch.frames)
    worked = len(to_do) < len(batch.chosen)
    if workers is not None:
        listener.begin(len(to_do))
        yield from rows_of_workers(
            request, workers, references, to_do, state,
            settings_worked=worked, say=listener.say, stopped=stopped,
        )  # fmt: skip
        return
    refiner = None
    if references is not None:
        refiner = load_batch_refiner(request, references, listener.say)
    listener.begin(len(to_do))
    with opened_network(refiner, request.batch_size, listener.say) as network:
        yield from refine_tasks(
            _tasks(request, batch, to_do), network, state,
            threads=request.workers, settings_worked=worked, stopped=stopped,
        )  # fmt: skip


def _tasks(request: BatchRequest, batch: BatchFrames, to_do: list[Frame]) -> Iterator[Task]:
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
    local: Path,
    report: BatchReport | None,
    profile: dict[str, Any],
) -> dict[str, Any]:
    """Writes summary.csv, summary.json and the report; returns the summary without its frames."""
    model, tally = model_identity(request.refine), Tally()
    with tempfile.TemporaryFile("w+", dir=local, encoding="utf-8") as file:
        for row in _known_rows(request, batch, BatchState(request.output, model)):
            try:
                tally.add(row)
            except (AttributeError, KeyError, TypeError) as error:
                raise FileFormatError(
                    f"the record of frame {row['name']} in {request.output} is damaged; remove it,"
                    " and run again"
                ) from error
            file.write(json.dumps(row) + "\n")
        summary = _head_of(request, batch, model, tally)
        if request.profile:
            summary["profile"] = profile

        def rows() -> Iterator[Row]:
            file.seek(0)
            return map(json.loads, file)

        write_summaries(local, summary, rows(), tally.baseline_names)
        if report is not None:
            report.write(summary, rows)
    if isinstance(request.output, RemotePath):
        for name in (CSV, JSON):
            upload(local / name, request.output / name)
    return summary


def _known_rows(request: BatchRequest, batch: BatchFrames, state: BatchState) -> Iterator[Row]:
    """The rows of all frames that are done, or have failed, with the present settings."""

    def of_part(start: int) -> list[Row | None]:
        part = batch.frames[start : start + _PART]
        return [state.row(task_of(request, frame)) for frame in part]

    for part in in_order(of_part, range(0, len(batch.frames), _PART), _READERS):
        yield from (row for row in part if row is not None)


def _head_of(
    request: BatchRequest, batch: BatchFrames, model: dict[str, Any], tally: Tally
) -> dict[str, Any]:
    """The summary without its frames."""
    known, fixed_by = sum(tally.counts.values()), request.refine.method.fixed_by
    head = {
        "command": "batch",
        "source": str(request.source),
        "output": str(request.output),
        "layout": batch.layout,
        "method": {"kind": "fixed" if fixed_by else "default", "reason": fixed_by or "default"},
        "settings": settings_of(request.refine, model),
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
        head["sequence"] = plain(asdict(request.sequence))
    return head


def _notes_of(request: BatchRequest, batch: BatchFrames) -> Iterator[str]:
    """What was assumed, and warnings of files that are in no frame."""
    frames = batch.frames
    with_gt = sum(frame.gt is not None for frame in frames)
    guessed = " (guessed; --layout names another)" if request.layout is None else ""
    yield (
        f"layout: {batch.layout}{guessed}: {_count(len(frames), 'frame')},"
        f" {with_gt:,} with ground truth"
    )
    cut = sorted({f.protocol.name for f in frames if f.protocol.halved or f.protocol.crop})
    if cut and request.protocol is None:
        yield f"protocol: {', '.join(cut)} cuts the frames; --protocol whole keeps all of them"
    poses = note_of_poses(frames)
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
