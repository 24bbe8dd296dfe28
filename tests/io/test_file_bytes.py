"""A file is known by its digest."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import fingerprint, is_unchanged, sha256_of


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
