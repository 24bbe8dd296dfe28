"""An append-only file with a JSON object per line, of which the newest of each key counts.

A process that is killed while it writes leaves an incomplete last line. It is cut off before the
next line is written. Each line begins with the CRC-32 of the rest of it; lines that are damaged or
edited are skipped, so all others stay valid.
"""

from __future__ import annotations

import json
import os
import threading
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.atomic import cannot_write
from pnpdepth_cli.io.record import plain

_CHECKSUM = b'{"crc32": "%08x", '
_CHECKSUM_BYTES = len(_CHECKSUM % 0)


@dataclass(frozen=True, kw_only=True)
class EncodedLine:
    """A line as it is in the file, which another process may make."""

    key: str | None
    """What identifies it."""
    data: bytes
    """With its checksum and its end."""

    @classmethod
    def of(cls, content: Mapping[str, Any], key: str) -> EncodedLine:
        """Returns the line of this content, identified by its field `key`."""
        rest = json.dumps(plain(content), allow_nan=False).encode("ascii")[1:]
        name = content.get(key)
        return cls(
            key=name if isinstance(name, str) else None,
            data=_CHECKSUM % zlib.crc32(rest) + rest + b"\n",
        )


class Journal:
    """The lines of a file by their `key`; only their offsets in the file are kept in memory.

    Several threads may append, several processes must not.

    Args:
        path: The file; it need not exist yet.
        key: The field of a line that identifies it.

    Attributes:
        lost: Number of lines that are damaged or edited.
        end: Offset behind the last complete line.
        writing: Held while lines are written.
    """

    def __init__(self, path: Path, key: str) -> None:
        self.path = path
        self.lost = 0
        self._key = key
        self._offsets: dict[str, int] = {}
        self.writing = threading.Lock()
        self.end = self._index()

    def keys(self) -> list[str]:
        """Returns the keys in the order in which they first appeared."""
        return list(self._offsets)

    def newest(self, key: str, before: str | None = None) -> dict[str, Any] | None:
        """Returns the newest line with this key; None if there is none.

        Args:
            key: What identifies the line.
            before: A field that holds an object. It and those behind it are left out, if it is
                there, which takes less time where they are long.
        """
        if key not in self._offsets:
            return None
        try:
            with self.path.open("rb") as file:
                file.seek(self._offsets[key])
                return _object(file.readline(), before)
        except OSError as error:
            raise _cannot_read(self.path, error) from error

    def append(self, *lines: Mapping[str, Any] | EncodedLine) -> None:
        """Appends lines, all in one write.

        Raises:
            StorageError: The disk is full or gone; at most an incomplete line was written.
        """
        encoded = [
            line if isinstance(line, EncodedLine) else EncodedLine.of(line, self._key)
            for line in lines
        ]
        with self.writing:
            try:
                self._write(b"".join(line.data for line in encoded))
            except OSError as error:
                raise cannot_write(self.path, error) from error
            for line in encoded:
                if line.key is not None:
                    self._offsets[line.key] = self.end
                self.end += len(line.data)

    def _write(self, data: bytes) -> None:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(self.path, flags, 0o666), "r+b", buffering=0) as file:
            if file.seek(0, os.SEEK_END) != self.end:
                file.truncate(self.end)
            file.seek(self.end)
            rest = memoryview(data)
            while rest:  # a disk that is nearly full takes a part
                rest = rest[file.write(rest) :]

    def _index(self) -> int:
        """Notes the offsets of the lines; returns the offset behind the last complete one."""
        offset = 0
        try:
            with self.path.open("rb") as file:
                for data in file:
                    if not data.endswith(b"\n"):
                        break
                    key = self._key_in(data)
                    if key is not None:
                        self._offsets[key] = offset
                    offset += len(data)
        except FileNotFoundError:
            return 0
        except OSError as error:
            raise _cannot_read(self.path, error) from error
        return offset

    def _key_in(self, data: bytes) -> str | None:
        """The key of a line; None if it has none, or is damaged, which is counted."""
        if not _is_whole(data):
            self.lost += 1
            return None
        first = f'"{self._key}": '
        text = data[_CHECKSUM_BYTES:].decode("ascii")
        if text.startswith(first):  # a tenth of the time of parsing the whole line
            key = json.JSONDecoder().raw_decode(text, len(first))[0]
        else:
            key = json.loads("{" + text).get(self._key)
        return key if isinstance(key, str) else None


def _object(data: bytes, before: str | None = None) -> dict[str, Any] | None:
    """The content of a whole line; None if its checksum is wrong or missing."""
    if not _is_whole(data):
        return None
    # in a text of JSON the quotes would be escaped
    end = -1 if before is None else data.find(f', "{before}": {{'.encode())
    text = data[_CHECKSUM_BYTES:] if end < 0 else data[_CHECKSUM_BYTES:end] + b"}"
    content: dict[str, Any] = json.loads(b"{" + text)
    return content


def _is_whole(data: bytes) -> bool:
    rest = data.removesuffix(b"\n")[_CHECKSUM_BYTES:]
    return data.startswith(_CHECKSUM % zlib.crc32(rest))


def _cannot_read(path: Path, error: OSError) -> InputError:
    reason = (error.strerror or str(error)).lower()
    return InputError(
        f"{path} cannot be read ({reason}); check it, or choose another output folder"
    )
