from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import InputError, PnpDepthError, StorageError
from pnpdepth_cli.io.remote import store
from pnpdepth_cli.io.remote.address import RemotePath, path_of
from pnpdepth_cli.io.remote.store import Listing, local_files, status_of, upload

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

    def ls(self, path: str, *, detail: bool) -> list[dict[str, Any]]:
        self._called("ls")
        return [self.info(name) for name in self.objects if name.startswith(path)]

    def get_file(self, path: str, file: str) -> None:
        self._called("get_file")
        Path(file).write_bytes(self.objects[path])

    def put_file(self, file: str, path: str) -> None:
        self._called("put_file")
        self.objects[path] = Path(file).read_bytes()


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


def test_a_folder_is_listed_once(fake: FakeStore) -> None:
    fake.objects = {f"s3://b/d/{number}": b"x" for number in range(100)}
    listing = Listing()
    assert all(listing.status(remote(f"d/{number}")) for number in range(100))
    assert listing.status(remote("d/100")) is None
    assert fake.calls.count("ls") == 1


def test_the_names_in_a_folder_on_disk_are_listed_too(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    listing = Listing()
    assert list(listing.names(tmp_path)) == ["a"]
    assert not listing.names(tmp_path / "no")


def test_copies_have_the_names_of_their_objects_and_end_with_the_block(fake: FakeStore) -> None:
    fake.objects = {"s3://b/1/a.png": b"one", "s3://b/2/a.png": b"two"}
    paths = [remote("1/a.png"), remote("2/a.png"), Path("local.png")]
    with local_files(paths) as copies:
        assert [copies[path].read_bytes() for path in paths[:2]] == [b"one", b"two"]
        assert [copies[path].name for path in paths[:2]] == ["a.png", "a.png"]
        assert len(copies) == 2
    assert not any(copy.exists() for copy in copies.values())


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (None, "no such object; check"),
        (b"x" * (2 << 20), "has 2,097,152 bytes, more than 1,048,57"),
    ],
)
def test_an_object_that_is_missing_or_beyond_the_budget_is_not_copied(
    fake: FakeStore, data: bytes | None, message: str
) -> None:
    fake.objects = {} if data is None else {"s3://b/a": data}
    set_max_pixels(1000)
    try:
        with pytest.raises(InputError, match=message), local_files([remote("a")]):
            pass
    finally:
        set_max_pixels(None)
    assert "get_file" not in fake.calls


def test_a_full_disk_is_named(fake: FakeStore, monkeypatch: pytest.MonkeyPatch) -> None:
    fake.objects = {"s3://b/a": b"x"}
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(fake, "get_file", lambda *_: (_ for _ in ()).throw(full))
    with (
        pytest.raises(StorageError, match="set TMPDIR to a larger disk"),
        local_files([remote("a")]),
    ):
        pass
