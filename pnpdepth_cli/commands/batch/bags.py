"""A bag as the source of a batch: its frames are written beside the output folder first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pnpdepth_cli.commands.batch.request import BatchRequest
from pnpdepth_cli.commands.sparse.options import BagOptions
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.bags import is_bag


def unpacked(
    request: BatchRequest,
    options: BagOptions,
    say: Callable[[str], None],
    *,
    may_write: bool = True,
) -> BatchRequest:
    """Returns the request with the frames of its bag as source; any other request as it is.

    The frames are in OUTPUT_frames, and stay there for the next run. Their poses are used where
    points are accumulated and no others are given.

    Raises:
        UsageError: Options of a bag are given for another source, or the frames are not written
            yet and may not be.
    """
    if not is_bag(request.source):
        if options != BagOptions():
            raise UsageError(f"{request.source} is no bag; leave out --topics and --tolerance")
        return request
    from pnpdepth_cli.commands.sparse.frames import (
        POSES_FILE,
        FramesRequest,
        write_frames,
        written_before,
    )

    folder = request.output.with_name(f"{request.output.name}_frames")
    frames = FramesRequest(
        bag=request.source, output=folder, options=options, limit=request.limit, overwrite=True
    )
    if not written_before(frames):
        if not may_write:
            raise UsageError(f"--dry-run writes nothing; run `pnpdepth frames {request.source}`")
        record = write_frames(frames, say)
        say(f"bag: wrote {record['frames']:,} frames to {folder}")
    sequence, poses = request.sequence, folder / POSES_FILE
    if sequence.accumulate and sequence.poses is None and poses.is_file():
        sequence = replace(sequence, poses=poses)
    return replace(request, source=folder, sequence=sequence)
