"""JSON is read as it was written, and a file is known by its digest."""

from __future__ import annotations

import hashlib
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import fingerprint, is_unchanged, read_json, read_rows, write_json


@dataclass
class Point:
    x: float


def test_json_is_read_back_in_order_or_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    same = {"é-_": [{"z": [None, True, -1.5e-300, 10**30]}, []], "a": '\u2028 "\\\n\0', "0": 0.3}
    others = {"n": np.int64(3), "x": np.array([0.5, np.nan]), "p": Path("a/b"), "d": Point(x=9)}
    write_json(path, {**same, **others})
    plain = {**same, "n": 3, "x": [0.5, None], "p": "a/b", "d": {"x": 9}}
    assert list(read_json(path).items()) == list(plain.items())
    write_json(path, {"name": "Tübingen"})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert path.read_text("utf-8") == '{\n  "name": "Tübingen"\n}\n'


@pytest.mark.parametrize(
    "content",
    [b"{", b"[1]", b'{"a": NaN}', b"\xff\xfe", b"[" * 100_000, b'{"a": 1%s}' % (b"0" * 400)],
)
def test_what_is_no_json_object_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "r.json").write_bytes(content)
    with pytest.raises(InputError, match=r"^.*r\.json.*$"):
        read_json(tmp_path / "r.json")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("x,y,depth\n1,2,3\n1,b,3\n", 3),
        ("# c\n\n1 2 3\n1 2 3 4\n", 4),
        ("1 2\n1 2 3\n", 1),
        ("x;y;depth\n1,5;2,5;3,0", 2),
    ],
)
def test_a_row_that_is_not_of_as_many_numbers_is_named_by_its_line(text: str, line: int) -> None:
    with pytest.raises(InputError, match=rf"points\.csv, line {line}\b"):
        read_rows(Path("points.csv"), text.encode())


def test_a_file_is_known_by_its_digest_whatever_its_times_say(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(b"abc")
    known = fingerprint(path)
    assert (known.size, known.sha256) == (3, hashlib.sha256(b"abc").hexdigest())
    time.sleep(0.02)  # times of files have steps
    path.write_bytes(b"abc")
    assert is_unchanged(path, known)
    path.write_bytes(b"abd")
    os.utime(path, ns=(5, known.mtime_ns))
    assert not is_unchanged(path, known)
    path.unlink()
    assert not is_unchanged(path, known)
    with pytest.raises(InputError):
        fingerprint(path)
