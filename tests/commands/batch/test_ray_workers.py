"""How frames are handed out and errors are treated, with calls that run at once instead of Ray."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pnpdepth_cli.commands.batch.batch_request import LOCAL, parse_address
from pnpdepth_cli.commands.batch.ray_workers import (
    check_node,
    connect_workers,
    ray_workers_of,
    reason_of,
    refine_on_actors,
    software,
)
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import ClusterError, ModelError, StorageError, UsageError

Refine = Callable[[Sequence[int], bool], list[FrameRecord]]


class RayError(Exception):
    """A worker or its node died."""


class RayTaskError(RayError):
    """A call raised `cause`."""

    def __init__(self, cause: Exception) -> None:
        super().__init__(str(cause))
        self.cause = cause


class Calls:
    """Ray's functions; a call runs when its result is wanted."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def wait(self, references: list[Any], *, timeout: float | None) -> Any:
        return references[:1], references[1:]

    def get(self, reference: Callable[[], Any]) -> Any:
        try:
            return reference()
        except SystemExit:
            raise RayError("exited") from None
        except Exception as error:
            raise RayTaskError(error) from None


def dies() -> None:
    raise SystemExit


def results(
    refine: Refine,
    count: int,
    *,
    worked: bool = False,
    starts: Callable[[], None] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[dict[int, FrameRecord], list[str]]:
    """The record of each frame, which is a number, and the messages."""
    messages: list[str] = []
    to_do: Any = range(count)
    ready = SimpleNamespace(options=lambda **_: SimpleNamespace(remote=lambda: lambda: starts()))
    refining = SimpleNamespace(remote=lambda *given: lambda: (refine(*given), ["note"]))
    records = list(
        refine_on_actors(
            Calls(), [SimpleNamespace(ready=ready, refine=refining) for _ in range(3)], to_do,
            worked=worked, say=messages.append, stopped=stopped,
            lost=lambda frame, why: record_of(frame, "failed", why),
        )
    )  # fmt: skip
    by_frame = {int(record.name): record for record in records}
    assert len(records) == len(by_frame), "a frame was reported twice"
    return by_frame, messages


def record_of(frame: Any, status: Any = "done", message: str | None = None) -> FrameRecord:
    return FrameRecord(name=str(frame), status=status, message=message)


def records_of(frames: Sequence[int], failed: Sequence[int] = ()) -> list[FrameRecord]:
    return [record_of(frame, "failed" if frame in failed else "done") for frame in frames]


def test_a_frame_that_kills_its_workers_is_lost_and_no_other_and_a_note_is_said_once() -> None:
    records, messages = results(
        lambda frames, _: dies() if 17 in frames else records_of(frames), 40
    )
    assert (records.pop(17).message or "").startswith("its worker died 3 times")
    assert sorted(records) == [number for number in range(40) if number != 17]
    assert {record.status for record in records.values()} == {"done"}
    assert sum("Ray starts another one" in text for text in messages) == 4
    assert messages.count("note") == 1


def raising(bad: Sequence[int], error: Exception) -> Refine:
    def refine(frames: Sequence[int], worked: bool) -> list[FrameRecord]:
        if set(frames) & set(bad) and (not worked or isinstance(error, StorageError)):
            raise error
        return records_of(frames, failed=bad)

    return refine


def test_an_error_of_the_settings_is_of_its_frame_alone_once_others_succeeded() -> None:
    with pytest.raises(ModelError, match="bad"):
        results(raising(range(40), ModelError("bad")), 40)
    for worked, bad in ((False, [4]), (True, range(9))):
        records, _ = results(raising(bad, ModelError("bad")), 9, worked=worked)
        failed = [number for number in sorted(records) if records[number].status == "failed"]
        assert failed == list(bad)
    with pytest.raises(StorageError, match="full"):
        results(raising([5], StorageError("full")), 9, worked=True)


def test_nothing_is_handed_out_once_stopped() -> None:
    begun: list[int] = []

    def refine(frames: Sequence[int], worked: bool) -> list[FrameRecord]:
        begun.extend(frames)
        return records_of(frames)

    records, _ = results(refine, 1000, stopped=lambda: len(begun) > 3)
    assert 3 < len(records) < 1000
    assert sorted(records) == sorted(begun)


def test_workers_that_do_not_start_end_the_run() -> None:
    with pytest.raises(ClusterError, match="a worker died 100 times"):
        results(raising((), OSError()), 1, starts=dies)


def test_a_node_must_have_the_versions_of_the_driver_and_see_its_files(tmp_path: Path) -> None:
    check_node(software(), [tmp_path])
    with pytest.raises(ClusterError, match=r"has torch .*, and the driver has 1\.0; install"):
        check_node({"torch": "1.0"}, [])
    for path, name in ((Path("frames"), "frames"), (Path("o/.batch.lock"), "the output folder")):
        with pytest.raises(ClusterError, match=f"does not see {name}; name a folder"):
            check_node({}, [path])


def test_the_death_of_a_worker_is_one_line_of_what_ray_says() -> None:
    creation = "The actor died because of an error raised in its creation task,\nImportError: no\n"
    assert reason_of(RuntimeError(creation)) == "ImportError: no"
    assert reason_of(RuntimeError("The actor died: OOM.\nand more")) == "The actor died: OOM."


def connect(address: str) -> None:
    workers = ray_workers_of("cpu", address)
    assert workers is not None
    with connect_workers(workers):
        raise AssertionError("there is no cluster")


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"--ray needs Ray: pip install 'pnpdepth\[ray\]'"):
        connect(LOCAL)


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_where_nothing_answers_is_an_error_at_once(scheme: str) -> None:
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        with pytest.raises(ClusterError, match=r"cannot be used: Connection refused; check the"):
            connect(f"{scheme}127.0.0.1:{port}")


def test_addresses_of_clusters_and_what_is_none() -> None:
    for text in ("auto", "local", "host:6379", "ray://host:10001", "[::1]:6379"):
        assert parse_address(text) == text
    for text in ("frames/", "out", "ray://host", "a/b:1"):
        with pytest.raises(UsageError, match="is no address of a Ray cluster"):
            parse_address(text)


@pytest.mark.parametrize(
    ("device", "ray", "expected"),
    [
        ("cuda:1", None, None),
        ("cuda:0,cuda:2", None, (LOCAL, "cuda", (0, 2))),
        ("all", None, (LOCAL, "cuda", ())),
        ("cpu", "auto", ("auto", "cpu", ())),
        ("cuda:0,cuda:0", None, "name each GPU once"),
        ("cuda,cuda", None, "name each GPU once"),
        ("cpu,cuda:0", None, "workers run on cpu, cuda"),
        ("mps,mps", None, "workers run on cpu, cuda"),
        ("cuda:0,cuda:1", "auto", "take --device cuda"),
    ],
)
def test_which_devices_are_workers(device: str, ray: str | None, expected: Any) -> None:
    if isinstance(expected, str):
        with pytest.raises(UsageError, match=expected):
            ray_workers_of(device, ray)
        return
    workers = ray_workers_of(device, ray)
    assert (workers and (workers.address, workers.device, workers.indices)) == expected
