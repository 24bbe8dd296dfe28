from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.remote.address import RemotePath, joined, path_of


@pytest.mark.parametrize("text", ["s3://b/a/0.png", "gs://b/0.png", "hf://datasets/u/r@main/x.png"])
def test_an_address_is_a_path_that_keeps_its_text(text: str) -> None:
    path = path_of(text)
    assert isinstance(path, RemotePath)
    assert str(path) == text
    assert path.name == text.rpartition("/")[2]
    assert str(path.parent / "more" / "1.png") == text.rpartition("/")[0] + "/more/1.png"
    assert pickle.loads(pickle.dumps(path)) == path


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
    ],
)
def test_other_addresses_are_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        path_of(text)


def test_a_password_in_an_address_is_refused_without_showing_it() -> None:
    with pytest.raises(UsageError) as caught:
        path_of("s3://me:pass@b/x.png")
    assert "pass" not in str(caught.value)


def test_a_reader_that_takes_no_copy_is_an_error() -> None:
    with pytest.raises(InputError, match="is in a store, which only `batch` reads"):
        path_of("s3://b/x.png").stat()
