"""JSON is read as it was written, and a file is known by its digest."""

from __future__ import annotations

import hashlib
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.file_bytes import (
    fingerprint,
    is_unchanged,
    read_json,
    read_rows,
    sha256_of,
    write_json,
)


@dataclass
class Point:
    x: float


def test_what_is_written_is_read_back_plain_and_in_the_same_order(tmp_path: Path) -> None:
    inner = {"z": [None, True, -1.5e-300, 10**30], "ä": {}, "": '\u2028 "\\\n\0 \U0001f600'}
    mapping = {"é-_": [inner, [], [[1]]], "a": inner, "0": 0.1 + 0.2}
    others = {"n": np.int64(3), "x": np.array([0.5, np.nan]), "p": Path("a/b"), "t": (1, 2)}
    write_json(tmp_path / "record.json", {**mapping, **others, "d": Point(x=float("inf"))})
    again = read_json(tmp_path / "record.json")
    plain = {"n": 3, "x": [0.5, None], "p": "a/b", "t": [1, 2], "d": {"x": None}}
    assert again == {**mapping, **plain}
    assert [list(again), list(again["a"])] == [[*mapping, *plain], list(inner)]


def test_the_text_is_readable_and_what_json_cannot_hold_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    write_json(path, {"name": "Tübingen", "δ1": 0.5})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert path.read_text("utf-8") == '{\n  "name": "Tübingen",\n  "δ1": 0.5\n}\n'


@pytest.mark.parametrize(
    "content",
    [
        *(b"{", b"[1]", b'{"a": NaN}', b"\xff\xfe", b"[" * 100_000, None),
        b'{"a": 1%s}' % (b"0" * 400),
    ],
)
def test_what_is_no_json_object_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "r.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError if content is None else FileFormatError, match=r"r\.json") as no:
        read_json(path)
    assert "\n" not in str(no.value)


@pytest.mark.parametrize(
    ("text", "line"),
    [("x,y,depth\n1,2,3\n1,b,3\n", 3), ("# c\n\n1 2 3\n1 2 3 4\n", 4), ("1 2\n1 2 3\n", 1)],
)
def test_a_row_that_is_not_of_as_many_numbers_is_named_by_its_line(text: str, line: int) -> None:
    with pytest.raises(FileFormatError, match=rf"points\.csv, line {line}\b"):
        read_rows(Path("points.csv"), text.encode())


def test_a_file_is_known_by_its_digest_whatever_its_times_say(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(b"abc")
    os.utime(path, ns=(5, 7))
    known = fingerprint(path)
    assert (known.size, known.mtime_ns) == (3, 7)
    assert known.sha256 == hashlib.sha256(b"abc").hexdigest()
    os.utime(path, ns=(5, 8))
    assert is_unchanged(path, known)
    time.sleep(0.02)
    for content in (b"abd", b"abcd"):
        path.write_bytes(content)
        os.utime(path, ns=(5, 7))
        assert not is_unchanged(path, known)
    path.unlink()
    assert not is_unchanged(path, known)
    for read in (fingerprint, sha256_of):
        with pytest.raises(InputError):
            read(path)
