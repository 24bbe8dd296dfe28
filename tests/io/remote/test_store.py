from __future__ import annotations

import errno
import threading
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import FileFormatError, InputError, PnpDepthError, StorageError
from pnpdepth_cli.io.remote import store
from pnpdepth_cli.io.remote.address import RemotePath, path_of
from pnpdepth_cli.io.remote.copies import Copies
from pnpdepth_cli.io.remote.store import StatusIndex, create, listed, status_of, upload

pytest.importorskip("fsspec")


class NoCredentialsError(Exception):
    """As botocore raises it."""


class FakeStore:
    """Objects in memory; raises `error` instead, if there is one."""

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.error: Exception | None = None
        self.calls: list[str] = []

    def _called(self, name: str) -> None:
        self.calls.append(name)
        if self.error:
            raise self.error

    def info(self, path: str) -> dict[str, Any]:
        self._called("info")
        if path not in self.objects:
            raise FileNotFoundError(path)
        data = self.objects[path]
        return {"name": path, "size": len(data), "type": "file", "ETag": str(hash(data))}

    def ls(self, path: str, detail: bool) -> list[dict[str, Any]]:
        self._called("ls")
        return [self.info(name) for name in self.objects if name.startswith(path)]

    def get_file(self, path: str, file: str) -> None:
        self._called("get_file")
        Path(file).write_bytes(self.objects[path])

    def put_file(self, file: str, path: str) -> None:
        self._called("put_file")
        self.objects[path] = Path(file).read_bytes()

    def pipe_file(self, path: str, data: bytes, mode: str) -> None:
        self._called("pipe_file")
        if path in self.objects and mode == "create":
            raise FileExistsError(path)
        self.objects[path] = data


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeStore:
    fake_store = FakeStore()
    monkeypatch.setattr(store, "_file_system", lambda scheme: fake_store)
    return fake_store


def remote(name: str) -> RemotePath:
    path = path_of(f"s3://b/{name}")
    assert isinstance(path, RemotePath)
    return path


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (PermissionError("no"), InputError, "s3://b/x may not be read with these credentials; che"),
        (NoCredentialsError(), StorageError, "s3://b needs credentials, and there are none; set"),
        (TimeoutError(), StorageError, "s3://b cannot be reached .no answer in time.; check the"),
        (OSError("at http://h/x?sig=abc now"), StorageError, "reached .at http://h/x now.; check"),
    ],
)
def test_what_a_store_raises_is_one_line(
    fake: FakeStore, error: Exception, kind: type[PnpDepthError], message: str
) -> None:
    fake.error = error
    with pytest.raises(kind, match=message) as caught:
        status_of(remote("x"))
    assert len(str(caught.value).splitlines()) == 1


def test_what_may_not_be_written_stops_the_batch(fake: FakeStore, tmp_path: Path) -> None:
    fake.error = PermissionError("no")
    (tmp_path / "x").touch()
    with pytest.raises(StorageError, match="s3://b/x may not be written with these credentials"):
        upload(tmp_path / "x", remote("x"))


def test_an_object_is_created_once(fake: FakeStore) -> None:
    assert create(remote("x"), b"one")
    assert not create(remote("x"), b"two")
    assert fake.objects == {"s3://b/x": b"one"}
    assert listed(remote("x").parent)["x"].size == 3


def test_many_objects_of_a_folder_are_listed_and_not_asked_for_one_by_one(fake: FakeStore) -> None:
    fake.objects = {f"s3://b/d/{number}": b"x" for number in range(100)}
    index = StatusIndex()
    assert all(index.status(remote(f"d/{number}")) for number in range(100))
    assert index.status(remote("d/100")) is None
    assert fake.calls.count("ls") == 1


def test_copies_are_kept_within_their_limit_and_while_they_are_read(
    fake: FakeStore, tmp_path: Path
) -> None:
    fake.objects = {f"s3://b/{name}": b"x" * 10 for name in "abcd"}
    copies = Copies(tmp_path, max_bytes=20)
    with copies.held(remote("a")) as (first, _):
        for name in "bcd":
            with copies.held(remote(name)) as (file, status):
                assert (file.name, status.size) == (name, 10)
        assert first.read_bytes() == b"x" * 10
        assert sorted(path.name for path in tmp_path.rglob("?") if path.is_file()) == [*"acd"]
    assert sorted(path.name for path in tmp_path.rglob("?") if path.is_file()) == [*"cd"]
    assert fake.calls.count("get_file") == 4
    with copies.held(remote("d")):
        pass
    assert fake.calls.count("get_file") == 4


def test_two_threads_make_one_copy(fake: FakeStore, tmp_path: Path) -> None:
    fake.objects = {"s3://b/a": b"x"}
    copies = Copies(tmp_path)

    def read() -> None:
        with copies.held(remote("a")) as (file, _):
            assert file.read_bytes() == b"x"

    threads = [threading.Thread(target=read) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert fake.calls.count("get_file") == 1


def test_an_object_beyond_the_budget_is_not_copied(fake: FakeStore, tmp_path: Path) -> None:
    fake.objects = {"s3://b/a": b"x" * (2 << 20)}
    set_max_pixels(1000)
    try:
        with (
            pytest.raises(FileFormatError, match="has 2,097,152 bytes, more than 1,048,576; make"),
            Copies(tmp_path).held(remote("a")),
        ):
            pass
    finally:
        set_max_pixels(None)
    assert "get_file" not in fake.calls


def test_a_full_disk_is_named_and_leaves_no_copy(
    fake: FakeStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake.objects = {"s3://b/a": b"x"}
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(fake, "get_file", lambda *_: (_ for _ in ()).throw(full))
    with (
        pytest.raises(StorageError, match="set TMPDIR to a larger disk"),
        Copies(tmp_path).held(remote("a")),
    ):
        pass
    assert not list(tmp_path.iterdir())
