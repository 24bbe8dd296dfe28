"""The network of a batch, resolved on its first frames."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.pipeline.batch.frames import Task, reference_frames, registering, task_of
from pnpdepth_cli.pipeline.batch.reading import read_frame
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.refine import load_refiner


@dataclass(frozen=True, kw_only=True)
class References:
    """The frames that decide for all frames of a batch."""

    first: Frame
    """The first one that can be read."""
    others: tuple[Frame, ...]
    """More frames, for input ranges where the network states none."""
    registering: tuple[Frame, ...]
    """Frames that decide how images are moved into the frame of the points."""


def references_of(request: BatchRequest, frames: Sequence[Frame]) -> References | None:
    """Returns the frames that decide, of all frames, so that every run and shard decides the same.

    Returns:
        None if no frame can be read.
    """
    for number, frame in enumerate(frames):
        if _readable(task_of(request, frame)) is not None:
            return References(
                first=frame,
                others=tuple(reference_frames(frames, number)),
                registering=tuple(registering(frames, number)),
            )
    return None


def load_batch_refiner(
    request: BatchRequest, references: References, say: Callable[[str], None]
) -> Refiner:
    """Returns the network with its definition resolved on the frames that decide.

    Args:
        request: The batch.
        references: Of `references_of`.
        say: Receives what was decided.
    """
    task = task_of(request, references.first)
    first = read_frame(task)
    for note in first.notes:
        say(f"{task.name}: {note}")

    def readable(frames: Iterable[Frame]) -> Iterable[Inputs]:
        read = (_readable(task_of(request, frame)) for frame in frames)
        return (inputs for inputs in read if inputs is not None)

    refiner = load_refiner(
        task.request, first, functools.cache(lambda: [*readable(references.others)])
    )
    for note in refiner.network.notes:
        say(note)
    if first.register == "auto":
        refiner.share_registration(readable(references.registering))
        for (height, width), registration in refiner.registrations.items():
            if registration is not None:
                say(
                    f"images of {width}×{height} are moved into the frame of the points by"
                    f" {registration}; --registration off leaves them"
                )
    if refiner.is_default:
        names = " and ".join(member.network.definition.name for member in refiner.members)
        say(f"method: the default, with {names}")
    else:
        s = refiner.settings
        say(
            f"network: {refiner.network.definition.name} cut at {refiner.layer}, {s.iterations}"
            f" updates of z ({s.update}, {s.loss}, step {s.lr})"
        )
    return refiner


def _readable(task: Task) -> Inputs | None:
    """The frame's contents; None if it cannot be read, which is reported later.

    UsageError if an option is wrong, for all frames.
    """
    try:
        return read_frame(task)
    except UsageError:
        raise
    except Exception:
        return None
