"""A bag as the source of a batch: its frames are written beside the output folder first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.bags.bag import is_bag
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.sparse.options import BagOptions


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

    Args:
        request: Of the batch.
        options: Which messages make a frame.
        say: Receives notes.
        may_write: False refuses a bag whose frames are not written yet.

    Raises:
        UsageError: Options of a bag are given for another source.
    """
    if not is_bag(request.source):
        if options != BagOptions():
            raise UsageError(f"{request.source} is no bag, so --bag does not apply")
        return request
    from pnpdepth_cli.pipeline.sparse.frames import (
        POSES,
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
    sequence, poses = request.sequence, folder / POSES
    if sequence.accumulate and sequence.poses is None and poses.is_file():
        sequence = replace(sequence, poses=poses)
    return replace(request, source=folder, sequence=sequence)
