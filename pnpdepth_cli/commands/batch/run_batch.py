"""`pnpdepth batch`: refines all frames of a folder or a list, except those done already."""

from __future__ import annotations

import functools
import itertools
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import NamedTuple, Protocol, TypeVar

from pnpdepth_cli.commands.batch.batch_request import BatchRequest, ray_workers_of
from pnpdepth_cli.commands.batch.find_frames import Task, find_frames, source_files, task_of
from pnpdepth_cli.commands.batch.records import (
    Records,
    model_identity,
    remove_all_leftovers,
    settings_of,
)
from pnpdepth_cli.commands.batch.sequence import note_of_poses, sequences_of
from pnpdepth_cli.commands.batch.summary import TEXT, BatchSummary, Tally, write_summaries
from pnpdepth_cli.commands.ordered_pool import in_order
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.atomic import in_turn, lock_folder, make_folder
from pnpdepth_cli.protocols import WHOLE, find_protocol

Result = TypeVar("Result")
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

    def frame(self, record: FrameRecord) -> None:
        """Called with the record of each frame that is done or has failed."""


class BatchOutcome(NamedTuple):
    """What summary.json says of all frames, and whether the batch was stopped early."""

    summary: BatchSummary
    stopped: bool


def run_batch(
    request: BatchRequest, listener: Listener, stopped: Callable[[], bool] = lambda: False
) -> BatchOutcome:
    """Refines every frame that is to be done; one that fails has a record that says why.

    Args:
        request: Frames to refine, and the method.
        listener: Receives notes and the records of frames.
        stopped: Asked before each frame; True ends the batch.

    Raises:
        PnpDepthError: For what concerns all frames, such as a network that cannot be loaded, or a
            full disk.
    """
    batch = _Batch(request, listener.say)
    request = batch.request
    if not request.refine.outputs.overwrite:
        batch.records.check_new(task_of(request, frame) for frame in batch.found.chosen)
    with ExitStack() as stack:
        batch.open_output(stack)
        batch.adapt(stopped)
        to_do = [frame for frame, _ in batch.to_do()]
        began = 0
        if to_do:
            with closing(batch.refine(to_do, listener, stopped)) as records:
                for record in records:
                    listener.frame(record)
                    began += 1
        with in_turn(request.output):  # so the summary of the shard that ends last stays
            summary = batch.summarise()
    for note in summary.unsure:
        listener.say(f"warning: {note}")
    return BatchOutcome(summary=summary, stopped=began < len(to_do))


class _Part(NamedTuple):
    """How some frames of a batch are refined, and what the output folder holds of them."""

    request: BatchRequest
    records: Records
    frames: Sequence[FrameFiles]


class _Batch:
    """The frames of a batch, and what its output folder holds of them.

    Args:
        request: Frames to refine, and the method.
        say: Receives what was assumed, and warnings of files that are in no frame.
    """

    def __init__(self, request: BatchRequest, say: Callable[[str], None]) -> None:
        refine = request.refine
        self.workers = ray_workers_of(refine.network.device, request.cluster)
        if self.workers is not None:
            refine = refine.with_fields(device=self.workers.device)
        if request.html_3d:
            refine = refine.with_fields(view_3d=True)
        self.request = request = replace(request, refine=refine)
        self._say, self.found = say, find_frames(request)
        self.model = model_identity(request.refine)
        self._check_report()
        for note in self._notes():
            say(note)
        self.records = Records(request.output, self.model)
        self._whole = _Part(request, self.records, self.found.frames)
        self._parts: dict[str, _Part] = {}  # of frames with adapted weights, by name

    def adapt(self, stopped: Callable[[], bool] | None) -> None:
        """Lets weights learn from the points of each sequence, where that is asked for."""
        if not self.request.adapt:
            return
        from pnpdepth_cli.commands.batch.adapted import with_adapted_weights

        for name, indices in sequences_of(self.found.frames).items():
            frames = [self.found.frames[index] for index in indices]
            request = with_adapted_weights(
                self.request, self.model, name, frames, self._say, stopped
            )
            if request is not self.request:
                records = Records(request.output, model_identity(request.refine))
                part = _Part(request, records, frames)
                self._parts |= dict.fromkeys([frame.name for frame in frames], part)

    def _part(self, frame: FrameFiles) -> _Part:
        return self._parts.get(frame.name, self._whole)

    def _task(self, frame: FrameFiles) -> Task:
        return task_of(self._part(frame).request, frame)

    def _check_report(self) -> None:
        """OutputError if a report is wanted where it cannot or may not be written."""
        request = self.request
        if request.html is None:
            return
        from pnpdepth_cli.commands.report.batch_report import check_batch_report

        files = (path for frame in self.found.frames for path in source_files(frame))
        check_batch_report(request, request.html, files)

    def _notes(self) -> Iterator[str]:
        request, frames, unmatched = self.request, self.found.frames, self.found.unmatched
        with_gt = sum(frame.gt is not None for frame in frames)
        guessed = " (guessed; --layout names another)" if request.layout is None else ""
        count = _count(len(frames), "frame")
        yield f"layout: {self.found.layout}{guessed}: {count}, {with_gt:,} with ground truth"
        cut = sorted({str(frame.part) for frame in frames if frame.part != WHOLE})
        if request.protocol is not None and (note := find_protocol(request.protocol).note):
            yield f"protocol {request.protocol}: {note}"
        elif cut and request.protocol is None:
            yield f"frames: {', '.join(cut)}; --protocol whole keeps all of them"
        if poses := note_of_poses(frames):
            yield poses
        if len(self.found.chosen) < len(frames):
            yield f"chosen: {_count(len(self.found.chosen), 'frame')} of them"
        for frame, why in self.found.refused:
            yield f"failed: {frame.name}: {why}"
        for each in unmatched[:_MAX_LISTED]:
            yield f"warning: {each}"
        if (more := len(unmatched) - _MAX_LISTED) > 0:
            yield f"warning: {more:,} more files are in no frame; summary.json lists them"

    def open_output(self, stack: ExitStack) -> None:
        """Makes the output folder, and locks it until the stack is left."""
        output = self.request.output
        make_folder(output)
        stack.enter_context(lock_folder(output, self.request.shard))
        if self.request.shard is None and (leftovers := remove_all_leftovers(output)):
            self._say(f"removed {leftovers:,} half-written files of a run that was killed")

    def to_do(self) -> list[tuple[FrameFiles, str]]:
        """Returns the frames that are to be done, and why, and says how many."""
        chosen = self.found.chosen
        reasons = _read_in_parts(
            lambda frame: self._part(frame).records.reason_to_refine(self._task(frame)), chosen
        )
        to_do = [(frame, why) for frame, why in zip(chosen, reasons, strict=True) if why]
        kinds = Counter(why.split(":")[0] for _, why in to_do)
        counts = ", ".join(f"{count:,} {kind}" for kind, count in kinds.items())
        frames, done = _count(len(chosen), "frame"), len(chosen) - len(to_do)
        if to_do:
            self._say(f"{frames}: {done:,} done already, {len(to_do):,} to do ({counts})")
        else:
            self._say(f"{frames}, all of them done already")
        return to_do

    def refine(
        self, to_do: list[FrameFiles], listener: Listener, stopped: Callable[[], bool]
    ) -> Generator[FrameRecord, None, None]:
        """Refines frames in this process or on Ray workers; yields the record of each."""
        # these import torch, which a run with nothing to do does not need
        from pnpdepth_cli.commands.batch import running

        begin = functools.cache(lambda: listener.begin(len(to_do)))
        worked = len(to_do) < len(self.found.chosen)
        for number, ((request, records, frames), wanted) in enumerate(self._by_part(to_do)):
            if number and stopped():
                return
            references = running.references_of(request, frames)
            if references is None:
                begin()
                yield from running.fail_unreadable(map(self._task, wanted), records)
            elif self.workers is not None:
                from pnpdepth_cli.commands.batch.ray_workers import refine_on_workers

                begin()
                yield from refine_on_workers(
                    request, self.workers, references, wanted, records,
                    settings_worked=worked, say=listener.say, stopped=stopped,
                )  # fmt: skip
            else:
                with running.open_method(request, references, listener.say) as method:
                    begin()
                    yield from running.refine_tasks(
                        map(self._task, wanted), method, records,
                        settings_worked=worked, stopped=stopped,
                    )  # fmt: skip

    def _by_part(self, to_do: list[FrameFiles]) -> list[tuple[_Part, list[FrameFiles]]]:
        """The frames to refine, by how they are refined."""
        parts: dict[int, tuple[_Part, list[FrameFiles]]] = {}
        for frame in to_do:
            part = self._part(frame)
            parts.setdefault(id(part.records), (part, []))[1].append(frame)
        return list(parts.values())

    def summarise(self) -> BatchSummary:
        """Writes the summaries and the report, and returns the summary."""
        request, tally = self.request, Tally()
        refused = (
            FrameRecord(name=frame.name, group=frame.group, status="failed", message=why)
            for frame, why in self.found.refused
        )
        known = _read_in_parts(
            lambda frame: self._part(frame).records.record_of(self._task(frame)), self.found.frames
        )
        with tempfile.TemporaryFile("w+", dir=request.output, **TEXT) as file:
            for record in filter(None, itertools.chain(refused, known)):
                tally.add(record)
                file.write(json.dumps(record.to_json(), ensure_ascii=False, allow_nan=False) + "\n")
            summary = self._summary(tally)

            def records() -> Iterator[FrameRecord]:
                file.seek(0)
                return (FrameRecord.from_json(json.loads(line), request.output) for line in file)

            write_summaries(request.output, summary, file, records)
            if request.html is not None:
                from pnpdepth_cli.commands.report.batch_report import write_batch_report

                write_batch_report(request, request.html, summary, records)
        return summary

    def _summary(self, tally: Tally) -> BatchSummary:
        """What is said of all frames together."""
        request, found = self.request, self.found
        frames = len(found.frames) + len(found.refused)
        ended = sum(tally.counts[kind] for kind in ("done", "diverged", "failed"))
        return BatchSummary(
            source=str(request.source),
            output=str(request.output),
            layout=found.layout,
            fixed_by=request.refine.method.fixed_by,
            settings=settings_of(request.refine, self.model),
            counts={"frames": frames, **tally.counts, "pending": frames - ended},
            unit=tally.unit,
            columns=request.columns,
            notes=tally.notes(),
            errors=tally.errors(),
            weights=tally.weights,
            warnings=tally.warnings,
            unsure=list(tally.unsure),
            unmatched=[str(each) for each in found.unmatched],
            varied=dict(request.varied),
            sequence={
                "accumulate": request.sequence.accumulate,
                "poses": str(request.sequence.poses) if request.sequence.poses else None,
            },
        )


def _read_in_parts(
    work: Callable[[FrameFiles], Result], frames: Sequence[FrameFiles]
) -> Iterator[Result]:
    """Yields the result of each frame in order, computed by threads that take many at once."""
    starts = range(0, len(frames), _PART)
    parts = in_order(lambda n: [work(frame) for frame in frames[n : n + _PART]], starts, _READERS)
    return (each for part in parts for each in part)


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
