"""Refines the frames of a batch that are to be done, in this process or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence

from pnpdepth_cli.commands.many_frames.in_process import open_method, refine_frames
from pnpdepth_cli.commands.many_frames.ray_workers import refine_on_workers
from pnpdepth_cli.commands.many_frames.records import Records
from pnpdepth_cli.commands.requests.batch_request import Listener
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord

DECIDING = 16
"""Number of frames that decide together how images are moved to the points."""


def refine_all(
    to_do: Sequence[FrameFiles],
    frames: Sequence[FrameFiles],
    of_frame: Mapping[str, Records],
    has_worked: bool,
    listener: Listener,
) -> Generator[FrameRecord, None, None]:
    """Refines and writes frames; yields the record of each.

    Args:
        to_do: The frames to refine.
        frames: All frames of the batch. What neither user nor network states is found on some of
            them, so that it is the same in every run and shard.
        of_frame: The records that each frame belongs to, by its name. Frames with the same records
            are refined with the same weights.
        has_worked: Whether a frame was refined with these settings before.
        listener: Receives notes, and may stop the batch.

    Raises:
        StorageError: When nothing more can be written.
        ModelError: For an error of the network before any frame was refined.
        UsageError: For an error of the settings before any frame was refined.
        DeviceError: The cluster cannot be used.
    """
    for records in dict.fromkeys(of_frame[frame.name] for frame in to_do):
        # The frames that are refined alike, and those on which is found what nobody states.
        to_do_alike = [frame for frame in to_do if of_frame[frame.name] is records]
        all_alike = [frame for frame in frames if of_frame[frame.name] is records]
        deciding = [all_alike[place] for place in spread(len(all_alike))]
        if records.request.ray is not None:
            yield from refine_on_workers(deciding, to_do_alike, records, has_worked, listener)
        else:
            with open_method(records.request, deciding) as method:
                yield from refine_frames(to_do_alike, method, records, has_worked, listener.stopped)
        if listener.stopped():
            return


def spread(count: int) -> list[int]:
    """Returns at most `DECIDING` numbers from 0 to count − 1, evenly spaced, with both ends."""
    last = count - 1
    return sorted({step * last // (DECIDING - 1) for step in range(DECIDING)})
