from __future__ import annotations

import errno
import hashlib
import pickle
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import InputError, PnpDepthError, StorageError, UsageError
from pnpdepth_cli.io import remote as stores
from pnpdepth_cli.io.fingerprint import fingerprint, is_unchanged
from pnpdepth_cli.io.remote import (
    Listing,
    RemotePath,
    joined,
    local_files,
    path_of,
    remove,
    renamed,
    status_of,
    upload,
)

pytest.importorskip("fsspec")


@pytest.mark.parametrize("text", ["s3://b/a/0.png", "gs://b/0.png", "hf://datasets/u/r@main/x.png"])
def test_an_address_is_a_path_that_keeps_its_text(text: str) -> None:
    path = path_of(text)
    assert isinstance(path, RemotePath)
    assert str(path) == text
    assert path.name == text.rpartition("/")[2]
    assert str(path.parent / "more" / "1.png") == text.rpartition("/")[0] + "/more/1.png"
    assert pickle.loads(pickle.dumps(path)) == path
    with pytest.raises(InputError, match="is in a store, which only `batch` reads"):
        path.stat()


def test_local_files_and_file_addresses_are_plain_paths() -> None:
    assert type(path_of("rgb/0.png")) is type(Path())
    assert path_of("file:///data/a%20b.png") == Path("/data/a b.png")
    assert path_of("C:/data/0.png") == Path("C:/data/0.png")


def test_a_query_travels_with_its_path_and_is_never_shown() -> None:
    path = path_of("https://h/a.png?X-Amz-Signature=abc%2F")
    copy = pickle.loads(pickle.dumps(path))
    assert copy.query == "?X-Amz-Signature=abc%2F"
    assert "abc" not in f"{copy} {copy!r}"
    assert copy.suffix == ".png"
    assert not (copy.parent / "b.png").query


def test_a_list_in_a_store_names_files_beside_it() -> None:
    folder = path_of("s3://b/drive/list.csv").parent
    assert str(joined(folder, "../rgb/./0.png")) == "s3://b/rgb/0.png"
    assert str(joined(folder, "gs://other/0.png")) == "gs://other/0.png"
    assert joined(folder, "/data/0.png") == Path("/data/0.png")
    assert joined(Path("drive"), "rgb/0.png") == Path("drive/rgb/0.png")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ftp://h/x.png", "ftp:// is no known store; stores are s3, gs, hf, https, http, file"),
        ("s3://b//x.png", "has an empty or relative part"),
        ("s3://b/../x.png", "has an empty or relative part"),
        ("s3://", "has an empty or relative part"),
        ("file://host/x.png", "names a host"),
        ("s3://me:pass@b/x.png", r"^(?!.*pass).*has a user name in it"),
    ],
)
def test_other_addresses_are_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        path_of(text)


class NoCredentialsError(Exception):
    """As botocore raises it."""


class FakeStore:
    """Objects in memory; raises `error` instead, if there is one."""

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.error: Exception | None = None
        self.versions = True
        self.calls: list[str] = []

    def _called(self, name: str) -> None:
        self.calls.append(name)
        if self.error and name != "info":
            raise self.error

    def info(self, path: str) -> dict[str, Any]:
        self._called("info")
        if path not in self.objects:
            raise self.error or FileNotFoundError(path)
        data = self.objects[path]
        version = {"ETag": str(hash(data))} if self.versions else {}
        return {"name": path, "size": len(data), "type": "file", **version}

    def ls(self, path: str, *, detail: bool) -> list[dict[str, Any]]:
        self._called("ls")
        return [self.info(name) for name in self.objects if name.startswith(path)]

    def get_file(self, path: str, file: str) -> None:
        self._called("get_file")
        Path(file).write_bytes(self.objects[path])

    def put_file(self, file: str, path: str) -> None:
        self._called("put_file")

    def rm_file(self, path: str) -> None:
        self._called("rm_file")


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeStore:
    fake_store = FakeStore()
    monkeypatch.setattr(stores, "_file_system", lambda scheme: fake_store)
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


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError("no"), "s3://b/x may not be written with these credentials"),
        (FileNotFoundError("b"), "s3://b: no such bucket; check the output"),
    ],
)
def test_what_cannot_be_written_stops_the_batch(
    fake: FakeStore, error: Exception, message: str, tmp_path: Path
) -> None:
    fake.error, fake.objects = error, {"s3://b/x": b"old"}
    with pytest.raises(StorageError, match=message):
        upload(tmp_path / "x", remote("x"))
    with pytest.raises(StorageError, match=message):
        remove(remote("x"))


def test_a_folder_is_listed_once_in_a_store_and_on_disk(fake: FakeStore, tmp_path: Path) -> None:
    fake.objects = {f"s3://b/d/{number}": b"x" for number in range(100)}
    listing = Listing()
    assert all(listing.status(remote(f"d/{number}")) for number in range(100))
    assert listing.status(remote("d/100")) is None
    assert fake.calls.count("ls") == 1
    (tmp_path / "a").touch()
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


@pytest.mark.parametrize("versions", [True, False])
def test_an_object_is_known_by_its_version_or_without_one_by_its_content(
    fake: FakeStore, versions: bool
) -> None:
    path, fake.versions, fake.objects = remote("a"), versions, {"s3://b/a": b"one"}
    with local_files([path]) as copies:
        known = fingerprint(path, copies[path])
    assert (known.size, known.sha256) == (3, hashlib.sha256(b"one").hexdigest())
    assert is_unchanged(path, known, Listing())
    assert fake.calls.count("get_file") == (1 if versions else 2)
    fake.objects["s3://b/a"] = b"two"
    assert not is_unchanged(path, known, Listing())
    with pytest.raises(InputError, match="is in a store; copy the file first"):
        fingerprint(path)
    fake.objects.clear()
    assert not is_unchanged(path, known, Listing())


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        (None, None, "no such object; check"),
        (b"x" * (2 << 20), None, "has 2,097,152 bytes, more than 1,048,57"),
        (b"x", OSError(errno.ENOSPC, "No space left on device"), "set TMPDIR to a larger disk"),
    ],
)
def test_an_object_that_cannot_be_copied_is_an_error(
    fake: FakeStore, data: bytes | None, error: Exception | None, message: str
) -> None:
    fake.objects, fake.error = {} if data is None else {"s3://b/a": data}, error
    set_max_pixels(1000)
    try:
        with pytest.raises(PnpDepthError, match=message), local_files([remote("a")]):
            pass
    finally:
        set_max_pixels(None)
    assert ("get_file" in fake.calls) == (error is not None)


def test_names_are_replaced_in_all_texts_of_a_record_and_nothing_else_changes() -> None:
    record = {"files": ["/tmp/0/a.png", ("read /tmp/0/a.png", 3, True, None)]}
    assert renamed(record, {"/tmp/0/a.png": "s3://b/a.png"}) == {
        "files": ["s3://b/a.png", ("read s3://b/a.png", 3, True, None)]
    }


@contextmanager
def web_server(answer: bytes, then_s: float) -> Iterator[str]:
    """The address of a server that gives this answer to any request, and hangs up after a while."""

    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            self.request.recv(65536)
            self.request.sendall(answer)
            ended.wait(then_s)

    ended = threading.Event()
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/x.csv"
        finally:
            ended.set()
            server.shutdown()


def web_head(status: str, length: object) -> bytes:
    return f"HTTP/1.1 {status}\r\nContent-Length: {length}\r\n\r\n".encode()


@pytest.mark.slow  # fsspec's thread stays, with which standard error is not silenced
@pytest.mark.parametrize(
    ("answer", "then_s", "message"),
    [
        (b"", 60, "no answer in time"),
        (web_head("200 OK", 1000) + b"image", 60, "no answer in time"),
        (web_head("200 OK", 1000) + b"image", 0, "payload is not completed"),
        (b"", 0, "cannot be reached"),
        (b"\x00\xff" * 100, 0, "cannot be reached"),
        (web_head("500 Oops", 0), 0, "500"),
        (web_head("403 No", 0), 0, "may not be read with these credentials"),
        (web_head("404 No", 0), 0, "no such object"),
        (web_head("200 OK", -5), 0, "cannot be reached"),
        (web_head("200 OK", 10**15), 0, "1,000,000,000,000,000 bytes, more than"),
    ],
)
def test_a_slow_a_cut_and_a_false_answer_are_one_line(
    answer: bytes, then_s: float, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra [remote]")
    monkeypatch.setattr(stores, "_READ_S", 0.3)
    stores._file_system.cache_clear()
    with web_server(answer, then_s) as address:
        path = path_of(address)
        with pytest.raises(PnpDepthError, match=message) as caught, local_files([path]):
            pass
    stores._file_system.cache_clear()
    assert len(str(caught.value).splitlines()) == 1
