"""`pnpdepth batch`: refines all frames of a folder or a list, except those done already."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace

from pnpdepth_cli.commands.many_frames.adapted import with_adapted_weights
from pnpdepth_cli.commands.many_frames.find_frames import BatchFrames, find_frames
from pnpdepth_cli.commands.many_frames.records import Records
from pnpdepth_cli.commands.many_frames.summary import BatchSummary, write_summary
from pnpdepth_cli.commands.requests.batch_request import BatchRequest, Listener
from pnpdepth_cli.commands.shared.pipeline import in_order
from pnpdepth_cli.commands.shared.tables import count_of, names_of_depths
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
    found = find_frames(request)
    own = Records(request)
    if request.html is not None:
        # Imported where it is used: what draws pages takes 50 ms.
        from pnpdepth_cli.commands.many_frames.batch_report import check_batch_report

        check_batch_report(request, request.html)
    for note in _notes(request, found):
        listener.say(note)
    if not refine.overwrite:
        own.check_new(found.chosen)
    make_folder(request.output)
    with lock_folder(request.output, request.shard):
        if request.shard is None and (leftovers := remove_leftovers(request.output)):
            listener.say(f"removed {leftovers:,} half-written files of a run that was killed")
        # Those that are not done are refined; the frames of a sequence may have adapted weights.
        of_frame = dict.fromkeys([frame.name for frame in found.frames], own)
        if request.adapt:
            of_frame = with_adapted_weights(own, found.frames, listener)
        asked = in_order(lambda f: of_frame[f.name].reason_to_refine(f), found.chosen, _READERS)
        reasons = [*asked]
        to_do = [frame for frame, why in zip(found.chosen, reasons, strict=True) if why]
        listener.say(_plan(reasons))
        if to_do:
            from pnpdepth_cli.commands.many_frames.running import refine_all  # imports torch

            listener.begin(len(to_do))
            worked = len(to_do) < len(found.chosen)
            refining = refine_all(to_do, found.frames, of_frame, worked, listener)
            with closing(refining) as records:
                _follow(records, listener)
        # All that are done are summed up; the summary of the shard that ends last stays.
        with in_turn(request.output):
            known = in_order(lambda f: of_frame[f.name].find(f), found.frames, _READERS)
            results = [record for record in known if isinstance(record, FrameRecord)]
            summary = write_summary(request, found, own.settings, results)
            if request.html is not None:
                from pnpdepth_cli.commands.many_frames.batch_report import write_batch_report

                write_batch_report(request, request.html, summary, results)
            return summary


def _follow(records: Iterable[FrameRecord], listener: Listener) -> None:
    """Tells the listener of each record, and of the first result how it was made."""
    told = False
    for record in records:
        listener.frame(record)
        if not told and record.result is not None:
            told = True
            for note in (names_of_depths(record.result)[1], *record.notes):
                listener.say(f"{record.name}: {note}")


def _notes(request: BatchRequest, found: BatchFrames) -> Iterator[str]:
    """What a person should know of the frames before they are refined."""
    frames, unmatched = found.frames, found.unmatched
    with_gt = sum(frame.gt is not None for frame in frames)
    guessed = " (guessed; --layout names another)" if request.layout is None else ""
    count = count_of(len(frames), "frame")
    yield f"layout: {found.layout}{guessed}: {count}, {with_gt:,} with ground truth"
    cut = sorted({str(frame.part) for frame in frames if frame.part != WHOLE})
    if request.protocol is not None and (note := find_protocol(request.protocol).note):
        yield f"protocol {request.protocol}: {note}"
    elif cut and request.protocol is None:
        yield f"frames: {', '.join(cut)}; --protocol whole keeps all of them"
    if found.poses is not None:
        yield found.poses
    if len(found.chosen) < len(frames):
        yield f"chosen: {count_of(len(found.chosen), 'frame')} of them"
    for line in unmatched[:_MAX_LISTED]:
        yield f"warning: {line}"
    if (more := len(unmatched) - _MAX_LISTED) > 0:
        yield f"warning: {more:,} more files are in no frame; summary.json lists them"


def _plan(reasons: Sequence[str | None]) -> str:
    """How many of the frames are done, and why others are to do, given the reason of each."""
    kinds = Counter(filter(None, reasons))
    frames = count_of(len(reasons), "frame")
    to_do = kinds.total()
    if not to_do:
        return f"{frames}, all of them done already"
    counts = ", ".join(f"{count:,} {kind}" for kind, count in kinds.items())
    return f"{frames}: {len(reasons) - to_do:,} done already, {to_do:,} to do ({counts})"
