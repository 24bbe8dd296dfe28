"""The network of a batch, resolved on its first frames."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.pipeline.batch.frames import Task, deciding, registering, task_of
from pnpdepth_cli.pipeline.batch.groups import FrameGroups
from pnpdepth_cli.pipeline.batch.reading import read_task
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.load_refiner import load_refiner
from pnpdepth_cli.pipeline.refinement.refiner import Refiner


@contextlib.contextmanager
def opened_groups(
    refiner: Refiner | None, batch_size: int | None, say: Callable[[str], None]
) -> Iterator[FrameGroups | None]:
    """Yields the network, open for any number of frames; None for None."""
    if refiner is None:
        yield None
        return
    with refiner.opened() as opened:
        yield FrameGroups(refiner, opened, batch_size, say)


def resolve_refiner(
    request: BatchRequest, frames: Sequence[Frame], say: Callable[[str], None]
) -> Refiner | None:
    """Returns the network with its definition resolved on the first frame that can be read.

    Args:
        request: The batch.
        frames: All frames, also those that are done or of another shard, so that every run
            decides the same.
        say: Receives what was decided.

    Returns:
        None if no frame can be read.
    """
    for number, frame in enumerate(frames):
        task = task_of(request, frame)
        first = readable(task)
        if first is not None:
            more = [task_of(request, other) for other in deciding(frames, number)]
            many = [task_of(request, other) for other in registering(frames, number)]
            return refiner_on(task, first, more, many, say)
    return None


def readable(task: Task) -> Inputs | None:
    """Returns the frame's contents; None if it cannot be read, which is reported later.

    Raises:
        UsageError: An option is wrong, for all frames.
    """
    try:
        return read_task(task)[0]
    except UsageError:
        raise
    except Exception:
        return None


def refiner_on(
    task: Task,
    first: Inputs,
    others: Sequence[Task],
    many: Sequence[Task],
    say: Callable[[str], None],
) -> Refiner:
    """Returns the network with its definition resolved on this frame.

    Args:
        task: The first frame that can be read.
        first: Its contents.
        others: More frames, on which the candidates are compared where the method is chosen, and
            the input ranges where the network does not state its own.
        many: Frames that decide how images are moved into the frame of the points.
        say: Receives what was decided.
    """
    for note in first.notes:
        say(f"{task.name}: {note}")

    @functools.cache
    def more() -> list[Inputs]:
        return [inputs for inputs in map(readable, others) if inputs is not None]

    refiner = load_refiner(task.request, first, more)
    for note in refiner.network.notes:
        say(note)
    if first.registration == "auto":
        refiner = _with_registration(refiner, map(readable, many), say)
    if refiner.method.is_default:
        names = " and ".join(member.network.definition.name for member in refiner.members)
        say(f"method: the default, with {names}")
        return refiner
    s = refiner.settings
    say(
        f"network: {refiner.network.definition.name} cut at {refiner.layer}, {s.iterations}"
        f" updates of z ({s.update}, {s.loss}, step {s.lr})"
    )
    return refiner


def _with_registration(
    refiner: Refiner, frames: Iterable[Inputs | None], say: Callable[[str], None]
) -> Refiner:
    """The refiner with the registration that the images of these frames share."""
    refiner = refiner.with_registration_of(inputs for inputs in frames if inputs is not None)
    for (height, width), registration in refiner.registrations.items():
        if registration is not None:
            say(
                f"images of {width}×{height} are moved into the frame of the points by"
                f" {registration}; --registration off leaves them"
            )
    return refiner
