"""How frames are handed out and errors are treated, with calls that run at once instead of Ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pnpdepth_cli.commands.batch.ray_workers import (
    check_node,
    reason_of,
    rows_of_actors,
    software,
)
from pnpdepth_cli.errors import ClusterError, ModelError, StorageError

CAUSES = "Some common causes include: (1) the process was killed by the OOM killer"
Refine = Callable[[Sequence[int], bool], list[dict[str, Any]]]


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


def actor(refine: Refine, starts: Callable[[], None] = lambda: None) -> Any:
    ready = SimpleNamespace(remote=lambda: lambda: starts())
    return SimpleNamespace(
        ready=SimpleNamespace(options=lambda **_: ready),
        refine=SimpleNamespace(remote=lambda *arguments: lambda: (refine(*arguments), ["note"])),
    )


def results(
    refine: Refine,
    count: int,
    *,
    worked: bool = False,
    starts: Callable[[], None] = lambda: None,
    **options: Any,
) -> tuple[dict[Any, Any], list[str]]:
    """The result of each frame, which is a number, and the messages."""
    messages: list[str] = []
    to_do: Any = range(count)
    given = list(
        rows_of_actors(
            Calls(), [actor(refine, starts) for _ in range(3)], to_do,
            worked=worked, say=messages.append,
            lost=lambda frame, why: {"name": frame, "status": "failed", "message": why},
            **{"stopped": lambda: False, "retries": 2} | options,
        )
    )  # fmt: skip
    by_frame = {row["name"]: row for row in given}
    assert len(given) == len(by_frame), "a frame was reported twice"
    return by_frame, messages


def rows_of(frames: Sequence[int], failed: Sequence[int] = ()) -> list[dict[str, Any]]:
    return [{"name": f, "status": "failed" if f in failed else "done"} for f in frames]


def test_every_frame_has_its_row_and_a_note_is_said_once() -> None:
    rows, messages = results(lambda frames, worked: rows_of(frames), 40)
    assert sorted(rows) == list(range(40))
    assert messages == ["note"]


def test_a_frame_that_kills_its_workers_is_lost_and_no_other() -> None:
    def refine(frames: Sequence[int], worked: bool) -> list[dict[str, Any]]:
        if 17 in frames:
            raise SystemExit
        return rows_of(frames)

    rows, messages = results(refine, 40)
    assert rows.pop(17)["message"].startswith("its worker died 3 times")
    assert {row["status"] for row in rows.values()} == {"done"}
    assert sum("Ray starts another one" in text for text in messages) == 4


def raising(bad: Sequence[int], error: Exception) -> Refine:
    def refine(frames: Sequence[int], worked: bool) -> list[dict[str, Any]]:
        if set(frames) & set(bad) and (not worked or isinstance(error, StorageError)):
            raise error
        return rows_of(frames, failed=bad)

    return refine


def test_an_error_of_the_settings_is_of_its_frame_alone_once_others_succeeded() -> None:
    with pytest.raises(ModelError, match="bad"):
        results(raising(range(40), ModelError("bad")), 40)
    for worked, bad in ((False, [4]), (True, range(9))):
        rows, _ = results(raising(bad, ModelError("bad")), 9, worked=worked)
        assert [name for name in sorted(rows) if rows[name]["status"] == "failed"] == list(bad)


def test_a_full_disk_ends_the_run_whatever_succeeded() -> None:
    with pytest.raises(StorageError, match="full"):
        results(raising([5], StorageError("full")), 9, worked=True)


def test_nothing_is_handed_out_once_stopped() -> None:
    begun: list[int] = []

    def refine(frames: Sequence[int], worked: bool) -> list[dict[str, Any]]:
        begun.extend(frames)
        return rows_of(frames)

    rows, _ = results(refine, 1000, stopped=lambda: len(begun) > 3)
    assert 3 < len(rows) < 1000
    assert sorted(rows) == sorted(begun)


def test_workers_that_do_not_start_end_the_run() -> None:
    def dies() -> None:
        raise SystemExit

    with pytest.raises(ClusterError, match="a worker died 100 times"):
        results(raising((), OSError()), 1, starts=dies)


def test_a_node_must_have_the_versions_of_the_driver_and_see_its_files(tmp_path: Path) -> None:
    check_node(software(), [tmp_path])
    with pytest.raises(ClusterError, match=r"has torch .*, and the driver has 1\.0; install"):
        check_node({"torch": "1.0"}, [])
    for path, name in ((Path("frames"), "frames"), (Path("o/.batch.lock"), "the output folder")):
        with pytest.raises(ClusterError, match=f"does not see {name}; name a folder"):
            check_node({}, [path])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "The actor died because of an error raised in its creation task,\n"
            "ModuleNotFoundError: No module named 'torch'\n",
            "ModuleNotFoundError: No module named 'torch'",
        ),
        ("ModuleNotFoundError: No module named 'pnpdepth_cli'", "pnpdepth is not installed on"),
        ("The actor died because its node has died. Node Id: 5", "its node is gone"),
        ("Task was killed due to the node running low on memory (OOM).", "out of memory"),
        (f"Worker exit type: SYSTEM_ERROR. {CAUSES}", "its process ended unexpectedly"),
    ],
)
def test_the_death_of_a_worker_in_a_few_words(text: str, reason: str) -> None:
    assert reason_of(RuntimeError(text)).startswith(reason)
