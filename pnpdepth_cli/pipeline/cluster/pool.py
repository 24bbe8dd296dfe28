"""A pool of Ray workers: hands out pieces, two at a time per worker, and replaces dead workers."""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pnpdepth_cli.budget import chosen_max_pixels
from pnpdepth_cli.errors import ClusterError, ModelError, PnpDepthError, UsageError
from pnpdepth_cli.io.atomic import cannot_write
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.pipeline.cluster.connection import Cluster, connected
from pnpdepth_cli.pipeline.cluster.options import Spread
from pnpdepth_cli.pipeline.cluster.pieces import Piece, Pieces, piece_size
from pnpdepth_cli.pipeline.cluster.worker import Done, Facts, Job, Start, Worker, software

_DEEP = 2
"""Pieces that a worker has: one it does, and one that waits."""
_POLL_S = 0.5
_NO_WORKER_S = 300.0
"""How long a cluster may take to start a worker, such as on a machine that it starts first."""
_FAILED_STARTS = 3


@dataclass(frozen=True, kw_only=True)
class Lost:
    """The result of an item whose worker died each time."""

    message: str
    """What is known of it."""


@dataclass(kw_only=True)
class _Hand:
    """A worker as the driver knows it."""

    number: int
    actor: Any
    calls: deque[tuple[Any, Piece | None]] = field(default_factory=deque)
    """References in their order, with the piece that each does."""
    facts: Facts | None = None
    ready: bool = False
    done: Done | None = None
    """The piece before."""
    items: int = 0
    """All it has done."""


@contextmanager
def worker_pool(
    spread: Spread,
    say: Callable[[str], None],
    *,
    inputs: Sequence[Path],
    output: Path | None = None,
) -> Iterator[WorkerPool]:
    """Yields the workers of a cluster; they end with it.

    Args:
        spread: Which workers.
        say: Receives notes.
        inputs: Files and folders that all nodes have to see.
        output: A folder that all nodes have to share; a file in it is the probe.

    Raises:
        UsageError: Ray is not installed.
        ClusterError: The cluster cannot be used.
    """
    with ExitStack() as stack:
        shared = list(inputs)
        if output is not None:
            shared.append(stack.enter_context(_probe(output.absolute())))
        cluster = stack.enter_context(connected(spread))
        say(f"Ray workers: starting {cluster.workers:,}, each with {spread.each}")
        pool = WorkerPool(cluster, spread, shared, say)
        stack.callback(pool.close)
        yield pool


@contextmanager
def _probe(folder: Path) -> Iterator[Path]:
    probe = folder / f".{secrets.token_hex(6)}"  # removed by the next run if this one is killed
    try:
        probe.touch()
    except OSError as error:
        raise cannot_write(folder, error) from error
    try:
        yield probe
    finally:
        with suppress(OSError):
            probe.unlink()


class WorkerPool:
    """Workers of a connected cluster; use `worker_pool`."""

    def __init__(
        self, cluster: Cluster, spread: Spread, shared: Sequence[Path], say: Callable[[str], None]
    ) -> None:
        self._cluster, self._ray, self._say = cluster, cluster.ray, say
        self._retries = spread.options.retries
        self._start = Start(
            folder=str(Path.cwd()),
            shared=tuple(shared),
            threads=spread.options.cpus_per_worker,
            max_pixels=chosen_max_pixels(),
        )
        self._job: Job | None = None
        self._job_reference: Any = None
        self._started = self._failed_starts = 0
        self._last_ready = time.monotonic()
        self._hands = [self._new_hand() for _ in range(cluster.workers)]

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Returns what the function returns on the first worker that is ready.

        Raises:
            PnpDepthError: What it raises.
            ClusterError: The worker died.
        """
        while not any(hand.facts for hand in self._hands):
            list(self._finished(Pieces((), 0)))
        hand = next(hand for hand in self._hands if hand.facts)
        try:
            return self._ray.get(hand.actor.call.remote(function, *arguments))
        except self._ray.exceptions.RayTaskError as error:
            raise _own_error(error) from None
        except self._ray.exceptions.RayError as error:
            raise ClusterError(f"the first worker died: {_reason(error)}; run again") from None

    def results(
        self,
        job: Job,
        items: Sequence[Any],
        *,
        begin: Callable[[Sequence[Any]], None] = lambda items: None,
        stopped: Callable[[], bool] = lambda: False,
        proven: bool = False,
    ) -> Iterator[list[tuple[Any, Any]]]:
        """Yields the items of each piece with their results, or Lost, as pieces are done.

        Args:
            job: What is done with each item.
            items: Sent to the workers.
            begin: Called with items before they are handed out.
            stopped: True if nothing more is to be handed out.
            proven: Whether an item succeeded before, so that errors are of single items.

        Raises:
            PnpDepthError: What concerns all items.
            ClusterError: No worker can be started.
        """
        self._job, self._job_reference = job, self._ray.put(job)
        for hand in self._hands:
            hand.ready, hand.done = False, None
            if hand.facts:
                self._open(hand)
        pieces = Pieces(items, self._retries)
        self._unproven: list[tuple[Piece, PnpDepthError]] = []
        self._proven = proven
        try:
            while True:
                if stopped():
                    pieces.drop()
                self._hand_out(pieces, begin)
                if not len(pieces) and not self._busy():
                    if not self._unproven or stopped():
                        return
                    raise self._unproven[0][1]
                yield from self._finished(pieces)
        finally:
            self._job = None

    def figures(self) -> list[dict[str, Any]]:
        """Returns for each living worker its node, process number, items and the job's figures."""
        return [
            {
                "node": hand.facts.node,
                "pid": hand.facts.pid,
                "items": hand.items,
                **(hand.done.figures if hand.done else {}),
            }
            for hand in self._hands
            if hand.facts is not None
        ]

    def close(self) -> None:
        """Ends all workers, whatever they do."""
        for hand in self._hands:
            self._kill(hand)

    def _new_hand(self) -> _Hand:
        self._started += 1
        remote = self._ray.remote(Worker)
        options = {"scheduling_strategy": "SPREAD", "max_restarts": 0, **self._cluster.resources}
        hand = _Hand(number=self._started, actor=remote.options(**options).remote(self._start))
        hand.calls.append((hand.actor.facts.remote(), None))
        return hand

    def _open(self, hand: _Hand) -> None:
        hand.calls.append((hand.actor.open.remote(self._job_reference), None))

    def _busy(self) -> bool:
        return any(piece is not None for hand in self._hands for _, piece in hand.calls)

    def _hand_out(self, pieces: Pieces, begin: Callable[[Sequence[Any]], None]) -> None:
        for _ in range(_DEEP):
            for hand in self._hands:
                if hand.ready and len(hand.calls) < _DEEP:
                    piece = pieces.take(self._size_for(hand, len(pieces)))
                    if piece is None:
                        return
                    begin(piece.items)
                    checked = piece.checked or self._proven
                    reference = hand.actor.run.remote(piece.items, checked)
                    hand.calls.append((reference, piece))

    def _size_for(self, hand: _Hand, left: int) -> int:
        done = hand.done
        pace = None if done is None else done.seconds / max(1, len(done.results))
        return piece_size(left, len(self._hands), pace, 1 if done is None else done.multiple)

    def _finished(self, pieces: Pieces) -> Iterator[list[tuple[Any, Any]]]:
        """Waits for calls to end, and yields the items of pieces among them."""
        waiting = {hand.calls[0][0]: hand for hand in self._hands if hand.calls}
        if not waiting:
            return
        ended, _ = self._ray.wait(list(waiting), num_returns=1, timeout=_POLL_S)
        ended += self._ray.wait(list(waiting), num_returns=len(waiting), timeout=0)[0]
        self._check_start()
        for reference in dict.fromkeys(ended):
            hand = waiting[reference]
            try:
                result = self._ray.get(reference)
            except self._ray.exceptions.RayTaskError as error:
                self._failed(hand, _own_error(error))
            except self._ray.exceptions.RayError as error:
                yield from self._replace(hand, pieces, _reason(error))
            else:
                yield from self._take(hand, result, pieces)

    def _take(self, hand: _Hand, result: Any, pieces: Pieces) -> Iterator[list[tuple[Any, Any]]]:
        _, piece = hand.calls.popleft()
        if isinstance(result, Facts):
            _check(result)
            hand.facts = result
            if self._job is not None:
                self._open(hand)
        elif piece is None:
            hand.ready, self._failed_starts = True, 0
        else:
            hand.done, hand.items = result, hand.items + len(piece.items)
            for note in result.notes:
                if hand.number == 1 or note.startswith("warning"):
                    self._say(note)
            if result.proves:
                self._prove(pieces)
            yield list(zip(piece.items, result.results, strict=True))

    def _prove(self, pieces: Pieces) -> None:
        """The settings are good, so pieces that failed by them fail by themselves."""
        self._proven = True
        for piece, _ in self._unproven:
            pieces.put_back(Piece(items=piece.items, kills=piece.kills, checked=True))
        self._unproven.clear()

    def _failed(self, hand: _Hand, error: PnpDepthError) -> None:
        _, piece = hand.calls.popleft()
        of_settings = isinstance(error, ModelError) or type(error) is UsageError
        if piece is None or not of_settings:
            raise error
        self._unproven.append((piece, error))

    def _replace(self, hand: _Hand, pieces: Pieces, reason: str) -> Iterator[list[tuple[Any, Any]]]:
        """Starts another worker; hands out again what the dead one had."""
        self._kill(hand)
        had = [piece for _, piece in hand.calls if piece is not None]
        for piece in reversed(had[1:]):
            pieces.put_back(piece)
        where = f" on {hand.facts.node}" if hand.facts else ""
        self._failed_starts += not had
        if self._failed_starts >= _FAILED_STARTS:
            raise ClusterError(f"workers die when they start{where}: {reason}")
        self._say(f"warning: worker {hand.number}{where} died ({reason}); another is started")
        self._hands[self._hands.index(hand)] = self._new_hand()
        if had:
            item = pieces.lost(had[0])
            if item is not None:
                yield [(item, Lost(message=f"its worker died {self._retries + 1} times: {reason}"))]

    def _check_start(self) -> None:
        """Raises ClusterError if no worker has been ready for long."""
        if any(hand.ready or hand.facts for hand in self._hands):
            self._last_ready = time.monotonic()
        if time.monotonic() - self._last_ready > _NO_WORKER_S:
            raise ClusterError(
                f"no worker has started for {_NO_WORKER_S:.0f} s; check the cluster with `ray"
                " status`, and run the same command to continue"
            )

    def _kill(self, hand: _Hand) -> None:
        with suppress(Exception):
            self._ray.kill(hand.actor)


def _check(facts: Facts) -> None:
    """Raises ClusterError if the worker's node differs from this one."""
    for name, here in software().items():
        there = facts.versions.get(name)
        if there != here:
            raise ClusterError(
                f"node {facts.node} has {name} {there}, and here it is {here}; install the same"
                " version on all nodes"
            )
    for path in facts.unseen:
        what = "the output folder" if path.name.startswith(".") else str(path)
        raise ClusterError(
            f"node {facts.node} does not see {what}; name a folder that all nodes share"
        )


def _own_error(error: Any) -> PnpDepthError:
    cause = error.cause
    if isinstance(cause, PnpDepthError):
        return cause
    raise cause if isinstance(cause, Exception) else error


def _reason(error: Exception) -> str:
    """What Ray says of a worker's death, in a few words."""
    text = one_line(str(error))
    if "error raised in its creation task" in text:
        return str(error).strip().splitlines()[-1][:200]
    if "No module named 'pnpdepth_cli'" in text:
        return "pnpdepth is not installed on its node; install the same version on all nodes"
    if "out of memory" in text.lower() or "OOM" in text.split("Some common causes")[0]:
        return "out of memory"
    if "node" in text.lower() and "died" in text.split("Worker exit type")[0].lower():
        return "its node is gone"
    return "its process ended unexpectedly"
