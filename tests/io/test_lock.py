from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from pnpdepth_cli.errors import OutputError, StorageError
from pnpdepth_cli.io import atomic
from pnpdepth_cli.io.atomic import in_turn, lock_folder


@pytest.fixture(autouse=True)
def no_long_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic, "_TRIED_S", 0.05)


def test_one_run_at_a_time_and_after_it_another_also_after_an_error(tmp_path: Path) -> None:
    calls: list[int] = []

    def held(number: int) -> None:
        with lock_folder(tmp_path):
            calls.append(number)
            with pytest.raises(OutputError), lock_folder(tmp_path):
                pytest.fail("two at once")
            raise ZeroDivisionError

    for number in (1, 2):
        with pytest.raises(ZeroDivisionError):
            held(number)
    assert calls == [1, 2]


def test_shards_run_together_but_not_twice_nor_beside_a_whole_run(tmp_path: Path) -> None:
    with lock_folder(tmp_path, (1, 3)), lock_folder(tmp_path, (3, 3)):
        for shard in ((1, 3), (3, 3), None):
            with pytest.raises(OutputError), lock_folder(tmp_path, shard):
                pass
        with lock_folder(tmp_path, (2, 3)):
            pass
    with lock_folder(tmp_path), pytest.raises(OutputError), lock_folder(tmp_path, (1, 2)):
        pass


def test_a_folder_that_is_not_there_cannot_be_locked(tmp_path: Path) -> None:
    with pytest.raises(StorageError), lock_folder(tmp_path / "no"):
        pass


def test_in_turn_one_waits_for_the_other(tmp_path: Path) -> None:
    order: list[str] = []
    inside = threading.Event()

    def first() -> None:
        with in_turn(tmp_path):
            inside.set()
            time.sleep(0.05)
            order.append("first")

    thread = threading.Thread(target=first)
    thread.start()
    inside.wait()
    with in_turn(tmp_path):
        order.append("second")
    thread.join()
    assert order == ["first", "second"]
