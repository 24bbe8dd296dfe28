"""A journal in a store: segments that are put once and never changed.

A store cannot append. The lines of a run are collected in a local journal, and every few seconds
put as the next segment, FOLDER/.batch/PART-000007.jsonl. A number that is taken already shows that
another process writes to the same journal.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError, StorageError
from pnpdepth_cli.io.journal import EncodedLine, Journal
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.remote.store import create, download, listed

_FOLDER = ".batch"
_SUFFIX = ".jsonl"
_SEGMENT_S = 10.0
_SEGMENT_BYTES = 1 << 24
_PUT_BYTES = 1 << 26
"""Of one segment at most; a store puts so much at once, whole or not at all."""


class SegmentedJournal(Journal):
    """A journal whose lines go to a store; a killed process loses those of the last seconds.

    Args:
        path: The local journal, as `fetch_journals` left it.
        key: The field of a line that identifies it.
        store: The output folder.
    """

    def __init__(self, path: Path, key: str, store: RemotePath) -> None:
        super().__init__(path, key)
        self._folder, self._part = store / _FOLDER, path.stem
        names = listed(self._folder)
        self._number = max((_number(name, self._part) for name in names), default=0)
        self._published = self.end
        self._last = time.monotonic()

    def append(self, *lines: Mapping[str, Any] | EncodedLine) -> None:
        """Appends lines; puts a segment if the last one is some seconds old.

        Raises:
            StorageError: Nothing more can be written.
        """
        super().append(*lines)
        old = time.monotonic() - self._last > _SEGMENT_S
        if old or self.end - self._published > _SEGMENT_BYTES:
            self.publish()

    def publish(self) -> None:
        """Puts the lines that the store does not have yet.

        Raises:
            StorageError: The store cannot be written, or another process writes there.
        """
        with self.writing:
            while self._published < self.end:
                data = self._unpublished()
                self._number += 1
                path = self._folder / f"{self._part}-{self._number:06}{_SUFFIX}"
                if not create(path, data):
                    raise StorageError(
                        f"{self._folder.parent}: another batch writes there; wait for it to end, or"
                        " choose another output folder"
                    )
                self._published += len(data)
            self._last = time.monotonic()

    def _unpublished(self) -> bytes:
        """Whole lines, as many as go into a segment."""
        with self.path.open("rb") as file:
            file.seek(self._published)
            data = file.read(min(_PUT_BYTES, self.end - self._published))
            return data if data.endswith(b"\n") else data + file.readline()


def fetch_journals(store: RemotePath, folder: Path) -> None:
    """Writes the journals of an output folder in a store to a local folder, each as one file.

    Raises:
        InputError: They may not be read.
        StorageError: The store cannot be reached, or the disk is full.
    """
    names = listed(store / _FOLDER)
    for name in sorted(names):
        part = name.rpartition("-")[0]
        if not part or not _number(name, part):
            continue
        segment = folder / "segment"
        download(store / _FOLDER / name, segment, names[name].size)
        if segment.stat().st_size != names[name].size:
            raise InputError(f"{store / _FOLDER / name} was not copied whole; run again")
        with (folder / f"{part}{_SUFFIX}").open("ab") as journal, segment.open("rb") as source:
            while block := source.read(1 << 20):
                journal.write(block)
        segment.unlink()


def _number(name: str, part: str) -> int:
    """The number of a segment of this journal; 0 for any other file."""
    number = name.removeprefix(f"{part}-").removesuffix(_SUFFIX)
    return int(number) if number.isdecimal() and name == f"{part}-{number}{_SUFFIX}" else 0
