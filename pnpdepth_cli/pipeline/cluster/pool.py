"""A pool of Ray workers: hands out pieces, two at a time, and replaces dead workers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.budget import chosen_max_pixels
from pnpdepth_cli.errors import ClusterError, ModelError, PnpDepthError, UsageError
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.pipeline.cluster.connection import Cluster, connected
from pnpdepth_cli.pipeline.cluster.failures import check_facts, own_error, reason_of
from pnpdepth_cli.pipeline.cluster.member import Member
from pnpdepth_cli.pipeline.cluster.options import Spread
from pnpdepth_cli.pipeline.cluster.pieces import Piece, Pieces, piece_size
from pnpdepth_cli.pipeline.cluster.probe import probe_in
from pnpdepth_cli.pipeline.cluster.worker import Facts, Job, Start, Worker

_DEEP = 2
"""Pieces that a worker has: one it does, and one that waits."""
_POLL_S = 0.5
_NO_WORKER_S = 300.0
"""How long a cluster may take to start a worker, such as on a machine that it starts first."""
_FAILED_STARTS = 3
_CLOSE_S = 5.0


@dataclass(frozen=True, kw_only=True)
class Lost:
    """The result of an item whose worker died each time."""

    message: str
    """What is known of it."""


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
        if output is not None and not isinstance(output, RemotePath):
            shared.append(stack.enter_context(probe_in(output.absolute())))
        cluster = stack.enter_context(connected(spread))
        say(f"Ray workers: starting {cluster.workers:,}, each with {spread.each}")
        pool = WorkerPool(cluster, spread, shared, say)
        stack.callback(pool.close)
        yield pool


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
        self._members = [self._new_member() for _ in range(cluster.workers)]

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Returns what the function returns on the first worker that is ready.

        Raises:
            PnpDepthError: What it raises.
            ClusterError: The worker died.
        """
        while not any(member.facts for member in self._members):
            list(self._finished(Pieces((), 0)))
        member = next(member for member in self._members if member.facts)
        try:
            return self._ray.get(member.actor.call.remote(function, *arguments))
        except self._ray.exceptions.RayTaskError as error:
            raise own_error(error) from None
        except self._ray.exceptions.RayError as error:
            raise ClusterError(f"the first worker died: {reason_of(error)}; run again") from None

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
        for member in self._members:
            member.ready, member.done = False, None
            member.finished, member.seconds = 0, 0.0
            if member.facts:
                self._open(member)
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
                "node": member.facts.node,
                "pid": member.facts.pid,
                "items": member.items,
                **(member.done.figures if member.done else {}),
            }
            for member in self._members
            if member.facts is not None
        ]

    def close(self) -> None:
        """Ends all workers, whatever they do."""
        idle = [member for member in self._members if member.facts and not member.calls]
        with suppress(Exception):
            closing = [member.actor.close.remote() for member in idle]
            self._ray.wait(closing, num_returns=len(closing), timeout=_CLOSE_S)
        for member in self._members:
            self._kill(member)

    def _new_member(self) -> Member:
        self._started += 1
        remote = self._ray.remote(Worker)
        options = {"scheduling_strategy": "SPREAD", "max_restarts": 0, **self._cluster.resources}
        member = Member(number=self._started, actor=remote.options(**options).remote(self._start))
        member.calls.append((member.actor.facts.remote(), None))
        return member

    def _open(self, member: Member) -> None:
        member.calls.append((member.actor.open.remote(self._job_reference), None))

    def _busy(self) -> bool:
        return any(
            member.unfinished or any(piece is not None for _, piece in member.calls)
            for member in self._members
        )

    def _hand_out(self, pieces: Pieces, begin: Callable[[Sequence[Any]], None]) -> None:
        for _ in range(_DEEP):
            for member in self._members:
                if not member.ready or len(member.calls) >= _DEEP:
                    continue
                piece = pieces.take(self._size_for(member, len(pieces)))
                if member.streams and (piece is None or piece.alone):
                    self._run(member, Piece(items=(), checked=True), finish=True)
                if piece is not None:
                    begin(piece.items)
                    piece = replace(piece, checked=piece.checked or self._proven)
                    self._run(member, piece, finish=piece.alone or not piece.checked)

    def _run(self, member: Member, piece: Piece, *, finish: bool) -> None:
        reference = member.actor.run.remote(piece.items, piece.checked, finish)
        member.calls.append((reference, piece))
        member.streams = not finish

    def _size_for(self, member: Member, left: int) -> int:
        pace = member.seconds / member.finished if member.finished else None
        multiple = 1 if member.done is None else member.done.multiple
        return piece_size(left, len(self._members), pace, multiple)

    def _finished(self, pieces: Pieces) -> Iterator[list[tuple[Any, Any]]]:
        """Waits for calls to end, and yields the items of pieces among them."""
        waiting = {member.calls[0][0]: member for member in self._members if member.calls}
        if not waiting:
            return
        ended, _ = self._ray.wait(list(waiting), num_returns=1, timeout=_POLL_S)
        ended += self._ray.wait(list(waiting), num_returns=len(waiting), timeout=0)[0]
        self._check_start()
        for reference in dict.fromkeys(ended):
            member = waiting[reference]
            try:
                result = self._ray.get(reference)
            except self._ray.exceptions.RayTaskError as error:
                self._failed(member, own_error(error))
            except self._ray.exceptions.RayError as error:
                yield from self._replace(member, pieces, reason_of(error))
            else:
                yield from self._take(member, result, pieces)

    def _take(self, member: Member, result: Any, pieces: Pieces) -> Iterator[list[tuple[Any, Any]]]:
        _, piece = member.calls.popleft()
        if isinstance(result, Facts):
            check_facts(result)
            member.facts = result
            if self._job is not None:
                self._open(member)
        elif piece is None:
            member.ready, self._failed_starts = True, 0
        else:
            count = len(result.results)
            begun = [*member.unfinished, *piece.items]
            member.done, member.unfinished = result, begun[count:]
            member.items, member.finished = member.items + count, member.finished + count
            member.seconds += result.seconds
            for note in result.notes:
                if member.number == 1 or note.startswith("warning"):
                    self._say(note)
            if result.proves:
                self._prove(pieces)
            yield list(zip(begun[:count], result.results, strict=True))

    def _prove(self, pieces: Pieces) -> None:
        """The settings are good, so pieces that failed by them fail by themselves."""
        self._proven = True
        for piece, _ in self._unproven:
            pieces.put_back(replace(piece, checked=True))
        self._unproven.clear()

    def _failed(self, member: Member, error: PnpDepthError) -> None:
        _, piece = member.calls.popleft()
        of_settings = isinstance(error, ModelError) or type(error) is UsageError
        if piece is None or piece.checked or not of_settings:
            raise error
        self._unproven.append((piece, error))

    def _replace(
        self, member: Member, pieces: Pieces, reason: str
    ) -> Iterator[list[tuple[Any, Any]]]:
        """Starts another worker; hands out again what the dead one had."""
        self._kill(member)
        had = [piece for _, piece in member.calls if piece is not None]
        for piece in reversed(had[1:]):
            if piece.items:
                pieces.put_back(piece)
        where = f" on {member.facts.node}" if member.facts else ""
        self._failed_starts += not had
        if self._failed_starts >= _FAILED_STARTS:
            raise ClusterError(f"workers die when they start{where}: {reason}")
        self._say(f"warning: worker {member.number}{where} died ({reason}); another is started")
        self._members[self._members.index(member)] = self._new_member()
        if had:
            begun = (*member.unfinished, *had[0].items)
            item = pieces.lost(replace(had[0], items=begun)) if begun else None
            if item is not None:
                yield [(item, Lost(message=f"its worker died {self._retries + 1} times: {reason}"))]

    def _check_start(self) -> None:
        """Raises ClusterError if no worker has been ready for long."""
        if any(member.ready or member.facts for member in self._members):
            self._last_ready = time.monotonic()
        if time.monotonic() - self._last_ready > _NO_WORKER_S:
            raise ClusterError(
                f"no worker has started for {_NO_WORKER_S:.0f} s; check the cluster with `ray"
                " status`, and run the same command to continue"
            )

    def _kill(self, member: Member) -> None:
        with suppress(Exception):
            self._ray.kill(member.actor)
