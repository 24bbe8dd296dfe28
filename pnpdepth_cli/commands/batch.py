"""`pnpdepth batch`: refines all frames of a folder or a list, except those done already."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace

from pnpdepth_cli.commands.many_frames.adapted import with_adapted_weights
from pnpdepth_cli.commands.many_frames.find_frames import BatchFrames, find_frames
from pnpdepth_cli.commands.many_frames.records import Records
from pnpdepth_cli.commands.many_frames.summary import BatchSummary, write_summary
from pnpdepth_cli.commands.requests.batch_request import BatchRequest, Listener
from pnpdepth_cli.commands.shared.pipeline import in_order
from pnpdepth_cli.commands.shared.tables import count_of, names_of_depths
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.atomic import in_turn, lock_folder, make_folder, remove_leftovers
from pnpdepth_cli.protocols import WHOLE, find_protocol

_MAX_LISTED = 5
"""Files named in messages; the rest is counted, and summary.json lists all."""
_READERS = 8
"""Threads that read records, whose time on network storage is waiting."""


def run_batch(request: BatchRequest, listener: Listener) -> BatchSummary:
    """Refines every frame that is to be done; one that fails has a record that says why.

    Args:
        request: Frames to refine, and the method.
        listener: Receives notes and the records of frames, and may stop the batch.

    Returns:
        What summary.json says of all frames.

    Raises:
        PnpDepthError: For what concerns all frames, such as a network that cannot be loaded, or a
            full disk.
    """
    # Which frames are refined, and how.
    refine = replace(request.refine, view_3d=request.html_3d)
    request = replace(request, refine=refine)
    batch = find_frames(request)
    records = Records(request)
    if request.html is not None:
        # Imported where it is used: what draws pages takes 50 ms.
        from pnpdepth_cli.commands.many_frames.batch_report import check_batch_report

        check_batch_report(request, request.html)
    for note in _notes(request, batch):
        listener.say(note)
    if not refine.overwrite:
        records.check_new(batch.chosen)
    make_folder(request.output)
    with lock_folder(request.output, request.shard):
        # A half-written file in a folder of shards may be one that another shard writes.
        if request.shard is None:
            leftovers = remove_leftovers(request.output)
            if leftovers:
                listener.say(f"removed {leftovers:,} half-written files of a run that was killed")
        # The frames of a sequence may have adapted weights, and then records of their own.
        of_frame = dict.fromkeys([frame.name for frame in batch.frames], records)
        if request.adapt:
            of_frame = with_adapted_weights(records, batch.frames, listener)
        _refine_missing(batch, of_frame, listener)
        # All that are done are summed up; the summary of the shard that ends last stays.
        with in_turn(request.output):

            def find(frame: FrameFiles) -> FrameRecord | str:
                """The record of a frame, or why there is none with its present settings."""
                return of_frame[frame.name].find(frame)

            entries = in_order(find, batch.frames, _READERS)
            results = [entry for entry in entries if isinstance(entry, FrameRecord)]
            summary = write_summary(request, batch, records.settings, results)
            if request.html is not None:
                from pnpdepth_cli.commands.many_frames.batch_report import write_batch_report

                write_batch_report(request, request.html, summary, results)
            return summary


def _refine_missing(
    batch: BatchFrames, of_frame: Mapping[str, Records], listener: Listener
) -> None:
    """Refines the chosen frames that are not done, or not with these settings and files.

    Args:
        batch: The frames.
        of_frame: The records that each frame belongs to, by its name.
        listener: Receives notes and the records of frames, and may stop the batch.
    """

    def reason(frame: FrameFiles) -> str | None:
        """Why the frame is to be refined; None if it is done."""
        return of_frame[frame.name].reason_to_refine(frame)

    reasons = [*in_order(reason, batch.chosen, _READERS)]
    listener.say(_plan(reasons))
    to_do = [frame for frame, why in zip(batch.chosen, reasons, strict=True) if why is not None]
    if not to_do:
        return
    from pnpdepth_cli.commands.many_frames.running import refine_all  # imports torch

    listener.begin(len(to_do))
    # Settings with which a frame was refined work, so that an error is of its frame alone.
    has_worked = len(to_do) < len(batch.chosen)
    # Closed at the end, also of an exception, so that threads and workers stop at once.
    with closing(refine_all(to_do, batch.frames, of_frame, has_worked, listener)) as records:
        _follow(records, listener)


def _follow(records: Iterable[FrameRecord], listener: Listener) -> None:
    """Tells the listener of each record, and of the first result how it was made.

    Args:
        records: The records of frames, each when its frame is done.
        listener: Receives the records and notes.
    """
    is_told = False
    for record in records:
        listener.frame(record)
        if not is_told and record.result is not None:
            is_told = True
            _, name_of_result = names_of_depths(record.result)
            for note in (name_of_result, *record.notes):
                listener.say(f"{record.name}: {note}")


def _notes(request: BatchRequest, batch: BatchFrames) -> Iterator[str]:
    """Yields what a person should know of the frames before they are refined, a line each."""
    # Layout, part and poses.
    frames = batch.frames
    with_gt = sum(frame.gt is not None for frame in frames)
    guessed = " (guessed; --layout names another)" if request.layout is None else ""
    count = count_of(len(frames), "frame")
    yield f"layout: {batch.layout}{guessed}: {count}, {with_gt:,} with ground truth"
    parts = sorted({str(frame.part) for frame in frames if frame.part != WHOLE})
    protocol_note = ""
    if request.protocol is not None:
        protocol_note = find_protocol(request.protocol).note
    if protocol_note:
        yield f"protocol {request.protocol}: {protocol_note}"
    elif parts and request.protocol is None:
        yield f"frames: {', '.join(parts)}; --protocol whole keeps all of them"
    if batch.poses is not None:
        yield batch.poses
    # Frames that are not refined, and files that are in no frame.
    if len(batch.chosen) < len(frames):
        yield f"chosen: {count_of(len(batch.chosen), 'frame')} of them"
    for line in batch.unmatched[:_MAX_LISTED]:
        yield f"warning: {line}"
    more = len(batch.unmatched) - _MAX_LISTED
    if more > 0:
        yield f"warning: {more:,} more files are in no frame; summary.json lists them"


def _plan(reasons: Sequence[str | None]) -> str:
    """How many frames are done, and why the others are to do, in a line.

    Args:
        reasons: Why each frame is to be refined; None for one that is done.
    """
    counts = Counter(reason for reason in reasons if reason is not None)
    frames = count_of(len(reasons), "frame")
    to_do = counts.total()
    if not to_do:
        return f"{frames}, all of them done already"
    texts = ", ".join(f"{count:,} {reason}" for reason, count in counts.items())
    return f"{frames}: {len(reasons) - to_do:,} done already, {to_do:,} to do ({texts})"
