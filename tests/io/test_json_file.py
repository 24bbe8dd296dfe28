from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError, InputError, OutputError
from pnpdepth_cli.io.file_bytes import sha256_of
from pnpdepth_cli.io.text_files import read_json, write_json


@dataclass
class Point:
    x: float


def test_what_is_written_is_read_back_in_the_same_order(tmp_path: Path) -> None:
    inner = {"z": [None, True, -1.5e-300, 10**30], "ä": {}, "": '\u2028 "\\\n\0 \U0001f600'}
    mapping = {"é-_": [inner, [], [[1]]], "a": inner, "0": 0.1 + 0.2}
    write_json(tmp_path / "record.json", mapping)
    again = read_json(tmp_path / "record.json")
    assert again == mapping
    assert [list(again), list(again["a"])] == [list(mapping), list(inner)]


def test_numpy_values_paths_and_dataclasses_become_plain_and_nan_null(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    content = {"n": np.int64(3), "x": np.array([0.5, np.nan]), "p": Path("a/b"), "t": (1, 2)}
    write_json(path, content | {"d": Point(x=float("inf")), "c": [{"c": np.float32("nan")}]})
    assert read_json(path) == {
        "n": 3, "x": [0.5, None], "p": "a/b", "t": [1, 2], "d": {"x": None}, "c": [{"c": None}],
    }  # fmt: skip


def test_the_text_is_readable_and_what_json_cannot_hold_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    write_json(path, {"name": "Tübingen", "δ1": 0.5})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert path.read_text("utf-8") == '{\n  "name": "Tübingen",\n  "δ1": 0.5\n}\n'
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "content",
    [
        *(b"{", b"[1]", b'{"a": NaN}', b"\xff\xfe", b"null", b"[" * 100_000, b"{} {}"),
        b'{"a": 1%s}' % (b"0" * 400),
    ],
)
def test_what_is_no_json_object_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "r.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"r\.json") as caught:
        read_json(path)
    assert "\n" not in str(caught.value)


def test_the_digest_is_that_of_the_content_and_of_a_folder_that_of_its_files_by_name(
    tmp_path: Path,
) -> None:
    content = bytes(range(256)) * 9000
    (tmp_path / "f").write_bytes(content)
    assert sha256_of(tmp_path / "f") == hashlib.sha256(content).hexdigest()
    (tmp_path / "one").mkdir()
    (tmp_path / "other").mkdir()
    for folder in ("one", "other"):
        for name in ("fine.pth", "coarse.pth"):
            (tmp_path / folder / name).write_text(name)
    assert sha256_of(tmp_path / "one") == sha256_of(tmp_path / "other")
    (tmp_path / "other" / "fine.pth").rename(tmp_path / "other" / "finer.pth")
    assert sha256_of(tmp_path / "one") != sha256_of(tmp_path / "other")


def test_missing_files_and_folders_are_our_errors(tmp_path: Path) -> None:
    for read in (read_json, sha256_of):
        with pytest.raises(InputError):
            read(tmp_path / "none.json")
    with pytest.raises(InputError):
        read_json(tmp_path)
    with pytest.raises(OutputError):
        write_json(tmp_path / "none" / "r.json", {})
