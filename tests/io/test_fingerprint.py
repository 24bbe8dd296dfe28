from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.fingerprint import fingerprint, is_unchanged
from pnpdepth_cli.io.remote import Listing


def test_a_file_is_known_by_its_digest_and_a_new_time_alone_is_no_change(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(b"abc")
    os.utime(path, ns=(5, 7))
    known = fingerprint(path)
    assert (known.size, known.mtime_ns) == (3, 7)
    assert known.sha256 == hashlib.sha256(b"abc").hexdigest()
    os.utime(path, ns=(5, 8))
    assert is_unchanged(path, known, Listing())
    for content in (b"abd", b"abcd"):
        path.write_bytes(content)
        assert not is_unchanged(path, known, Listing())
    path.unlink()
    assert not is_unchanged(path, known, Listing())


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        fingerprint(tmp_path / "no")


def test_another_content_of_the_same_size_and_time_is_a_change(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(b"abc")
    known = fingerprint(path)
    time.sleep(0.02)
    path.write_bytes(b"abd")
    os.utime(path, ns=(known.mtime_ns, known.mtime_ns))
    assert not is_unchanged(path, known, Listing())
