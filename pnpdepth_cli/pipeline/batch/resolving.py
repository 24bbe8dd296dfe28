"""The network of a batch, resolved on its first frames."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence

from pnpdepth_cli.errors import PnpDepthError, UsageError
from pnpdepth_cli.pipeline.batch.frames import Task, compared
from pnpdepth_cli.pipeline.batch.groups import FrameGroups
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refinement.load_refiner import load_refiner
from pnpdepth_cli.pipeline.refinement.method import resolve_method
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


def resolve_refiner(tasks: Iterable[Task], say: Callable[[str], None]) -> Refiner | None:
    """Returns the network with its definition resolved on the first frame that can be read.

    Args:
        tasks: Of all frames, also those that are done or of another shard, so that every run
            decides the same.
        say: Receives what was decided.

    Returns:
        None if no frame can be read.
    """
    remaining = iter(tasks)
    for task in remaining:
        first = readable(task)
        if first is not None:
            chosen = resolve_method(task.request).chosen
            others = list(remaining) if chosen else []
            return refiner_on(task, first, [others[i] for i in compared(len(others))], say)
    return None


def readable(task: Task) -> Inputs | None:
    """Returns the frame's contents; None if it cannot be read, which is reported later.

    Raises:
        UsageError: An option is wrong, for all frames.
    """
    try:
        return read_inputs(task.request)
    except UsageError:
        raise
    except Exception:
        return None


def refiner_on(
    task: Task, first: Inputs, others: Sequence[Task], say: Callable[[str], None]
) -> Refiner:
    """Returns the network with its definition resolved on this frame.

    Args:
        task: The first frame that can be read.
        first: Its contents.
        others: More frames that candidates are compared on, where the method is chosen.
        say: Receives what was decided.
    """
    for note in first.notes:
        say(f"{task.name}: {note}")
    refiner = load_refiner(task.request, first)
    for note in refiner.network.notes:
        say(note)
    if refiner.method.chosen:
        return _with_shortlist(refiner, others, first, say)
    s = refiner.settings
    say(
        f"network: {refiner.network.definition.name} cut at {refiner.layer}, {s.iterations}"
        f" updates of z ({s.update}, {s.loss}, step {s.lr})"
    )
    return refiner


def _with_shortlist(
    refiner: Refiner, others: Sequence[Task], first: Inputs, say: Callable[[str], None]
) -> Refiner:
    """The refiner with the candidates that are best on these frames."""
    frames = [first]
    for other in others:
        with contextlib.suppress(PnpDepthError):  # it is read again later, which reports its error
            frames.append(read_inputs(other.request))
    refiner = refiner.with_shortlist_of(frames)
    assert refiner.competition is not None
    names = "; ".join(str(candidate) for candidate in refiner.competition.shortlist or ())
    say(f"choice: best on {len(frames)} frames, and to be checked on each: {names}")
    return refiner
