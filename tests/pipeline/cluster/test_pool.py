"""How pieces are handed out and errors are treated, with calls that run at once instead of Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from pnpdepth_cli.errors import ClusterError, ModelError, StorageError
from pnpdepth_cli.pipeline.cluster.connection import Cluster
from pnpdepth_cli.pipeline.cluster.options import ClusterOptions, spread_of
from pnpdepth_cli.pipeline.cluster.pool import Lost, WorkerPool
from pnpdepth_cli.pipeline.cluster.worker import Done, Facts, Job, Work, Worker, software


class RayError(Exception):
    """A worker or its node died."""


class RayTaskError(RayError):
    """A call raised `cause`."""

    def __init__(self, cause: Exception) -> None:
        super().__init__(str(cause))
        self.cause = cause


class Reference:
    """A call, which runs when its result is wanted."""

    def __init__(self, actor: Actor, function: Callable[..., Any], arguments: Any) -> None:
        self.actor, self.function, self.arguments = actor, function, arguments


class Actor(Worker):
    """A worker in this process, whose state it leaves alone."""

    def __init__(self) -> None:
        self._open = ExitStack()
        self._work = None
        self.dead = False

    def facts(self) -> Facts:
        return Facts(node="here", pid=0, versions=software(), unseen=())

    def __getattribute__(self, name: str) -> Any:
        attribute = super().__getattribute__(name)
        if name not in ("facts", "open", "run", "call"):
            return attribute
        return SimpleNamespace(remote=lambda *arguments: Reference(self, attribute, arguments))


class Calls:
    """Ray's functions."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def remote(self, worker: type) -> Any:
        return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=lambda start: Actor()))

    def put(self, value: Any) -> Any:
        return value

    def kill(self, actor: Actor) -> None:
        actor.dead = True

    def wait(self, references: list[Any], *, num_returns: int, timeout: float) -> Any:
        return references[:num_returns], references[num_returns:]

    def get(self, reference: Reference) -> Any:
        if reference.actor.dead:
            raise RayError("dead")
        try:
            return reference.function(*reference.arguments)
        except SystemExit:
            reference.actor.dead = True
            raise RayError("exited") from None
        except Exception as error:
            raise RayTaskError(error) from None


@dataclass
class DoublingJob:
    """Doubles numbers; some kill the worker, some raise."""

    deadly: Sequence[int] = ()
    raising: Sequence[int] = ()
    error: Callable[[str], Exception] = ModelError

    @contextmanager
    def opened(self) -> Iterator[Work]:
        def work(items: Sequence[int], checked: bool, finish: bool) -> Done:
            if set(items) & set(self.deadly):
                raise SystemExit
            if set(items) & set(self.raising) and not checked:
                raise self.error("bad settings")
            failed = [item if item in self.raising else 2 * item for item in items]
            return Done(results=failed)

        yield work


@dataclass
class LaggingJob:
    """Doubles numbers, the last three of which it keeps for the next call; some kill the worker."""

    deadly: Sequence[int] = ()

    @contextmanager
    def opened(self) -> Iterator[Work]:
        kept: list[int] = []

        def work(items: Sequence[int], checked: bool, finish: bool) -> Done:
            kept.extend(items)
            ready = kept[: len(kept) if finish else -3]
            del kept[: len(ready)]
            if set(ready) & set(self.deadly):
                raise SystemExit
            return Done(results=[2 * item for item in ready], seconds=0.1)

        yield work


def pool_of(workers: int, messages: list[str], retries: int = 2) -> WorkerPool:
    spread = spread_of("cpu", ClusterOptions(ray="auto", retries=retries))
    assert spread is not None
    calls: Any = Calls()
    return WorkerPool(
        Cluster(ray=calls, workers=workers, resources={}), spread, (), messages.append
    )


def results(job: Job, count: int, **options: Any) -> tuple[dict[int, Any], list[str]]:
    messages: list[str] = []
    pairs = [
        pair for part in pool_of(3, messages).results(job, range(count), **options) for pair in part
    ]
    assert len(pairs) == len(dict(pairs)), "an item was done twice"
    return dict(pairs), messages


def test_every_item_has_its_result() -> None:
    begun: list[int] = []
    pairs, messages = results(DoublingJob(), 40, begin=begun.extend)
    assert pairs == {item: 2 * item for item in range(40)}
    assert sorted(begun) == list(range(40))
    assert messages == []


def test_an_item_that_kills_its_workers_is_lost_and_no_other() -> None:
    pairs, messages = results(DoublingJob(deadly=[17]), 40)
    lost = pairs.pop(17)
    assert isinstance(lost, Lost)
    assert lost.message.startswith("its worker died 3 times")
    assert pairs == {item: 2 * item for item in range(40) if item != 17}
    assert 3 <= len(messages) <= 9
    assert "another is started" in messages[0]


def test_results_that_come_with_a_later_call_are_of_their_items() -> None:
    assert results(LaggingJob(), 200)[0] == {item: 2 * item for item in range(200)}


def test_an_item_that_kills_its_workers_in_a_later_call_is_lost_and_no_other() -> None:
    pairs, messages = results(LaggingJob(deadly=[77]), 200)
    assert isinstance(pairs.pop(77), Lost)
    assert pairs == {item: 2 * item for item in range(200) if item != 77}
    assert 3 <= len(messages) <= 9


def test_an_error_of_the_settings_ends_the_run_if_nothing_was_done_before() -> None:
    with pytest.raises(ModelError, match="bad settings"):
        results(DoublingJob(raising=range(40)), 40)


def test_the_same_error_is_of_its_item_alone_once_others_succeeded() -> None:
    expected = {item: 2 * item for item in range(9)} | {4: 4}
    assert results(DoublingJob(raising=[4]), 9)[0] == expected
    assert results(DoublingJob(raising=[0, 1]), 2, proven=True)[0] == {0: 0, 1: 1}


def test_a_full_disk_ends_the_run_whatever_succeeded() -> None:
    with pytest.raises(StorageError, match="bad settings"):
        results(DoublingJob(raising=[5], error=StorageError), 9)


def test_workers_that_die_at_once_end_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def exits(worker: Actor) -> Facts:
        raise SystemExit

    monkeypatch.setattr(Actor, "facts", exits)
    with pytest.raises(ClusterError, match="workers die when they start"):
        results(DoublingJob(), 9)


def test_nothing_is_handed_out_once_stopped() -> None:
    begun: list[int] = []
    pairs, _ = results(DoublingJob(), 1000, begin=begun.extend, stopped=lambda: len(begun) > 3)
    assert 3 < len(pairs) < 1000
    assert sorted(pairs) == sorted(begun)
