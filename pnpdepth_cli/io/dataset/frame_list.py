"""Many frames in little memory: about 300 bytes each instead of 2,000."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, overload

from pnpdepth_cli.io.dataset.frame import Frame

_FILES = ("image", "sparse", "gt", "calib")
_OWN = {"name", *_FILES}
_SHARED = tuple(field.name for field in dataclasses.fields(Frame) if field.name not in _OWN)
_Row = tuple[Any, ...]
"""Number of the pattern, name, and folder and file name of each of _FILES; or one Frame."""


class FrameList(Sequence[Frame]):
    """A sequence of frames, which are made when they are asked for.

    Folders, file names and all that frames have in common are kept once. A frame with neighbours, a
    window, or fields that cannot be compared, such as arrays, is kept as it is.

    Args:
        frames: The frames, in their order.
    """

    def __init__(self, frames: Iterable[Frame] = ()) -> None:
        self._patterns: list[Frame] = []
        self._numbers: dict[Any, int] = {}
        self._folders: dict[Path, Path] = {}
        self._rows: list[_Row] = []
        for frame in frames:
            self.append(frame)

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> FrameList:
        """Returns the frames as they are if they are in such a sequence, else one of them."""
        return frames if isinstance(frames, FrameList) else cls(frames)

    def append(self, frame: Frame) -> None:
        """Adds a frame."""
        self._rows.append(self._packed(frame))

    def taken(self, numbers: Iterable[int]) -> FrameList:
        """Returns some of the frames; both sequences share what they keep."""
        return self._with_rows([self._rows[number] for number in numbers])

    def names(self) -> Iterator[str]:
        """Yields the names of the frames without making them."""
        return (row[0].name if len(row) == 1 else row[1] for row in self._rows)

    def patterns(self) -> Iterator[Frame]:
        """Yields a frame for each combination of fields, those of names and files left out."""
        numbers = {row[0] for row in self._rows if len(row) > 1}
        yield from (self._patterns[number] for number in sorted(numbers))
        yield from (row[0] for row in self._rows if len(row) == 1)

    def count_of(self, part: str) -> int:
        """Returns how many frames have a file of this part: image, sparse, gt or calib."""
        column = 2 + 2 * _FILES.index(part)
        return sum(
            (getattr(row[0], part) if len(row) == 1 else row[column]) is not None
            for row in self._rows
        )

    def set(self, number: int, frame: Frame) -> None:
        """Replaces a frame; lists that `taken` or a slice returned are as before."""
        self._rows[number] = self._packed(frame)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, number: int) -> Frame: ...
    @overload
    def __getitem__(self, number: slice) -> FrameList: ...
    def __getitem__(self, number: int | slice) -> Frame | FrameList:
        if isinstance(number, slice):
            return self._with_rows(self._rows[number])
        return self._frame(self._rows[number])

    def __iter__(self) -> Iterator[Frame]:
        return map(self._frame, self._rows)

    def _with_rows(self, rows: list[_Row]) -> FrameList:
        result = FrameList()
        result.__dict__.update(self.__dict__, _rows=rows)
        return result

    def _frame(self, row: _Row) -> Frame:
        if len(row) == 1:
            frame: Frame = row[0]
            return frame
        number, name, *files = row
        parts = {
            part: files[2 * i] / files[2 * i + 1]
            for i, part in enumerate(_FILES)
            if files[2 * i] is not None
        }
        frame = object.__new__(Frame)  # its fields were checked when it was first made
        frame.__dict__.update(self._patterns[number].__dict__, name=name, **parts)
        return frame

    def _packed(self, frame: Frame) -> _Row:
        files = [getattr(frame, part) for part in _FILES]
        key = tuple(getattr(frame, name) for name in _SHARED)
        if frame.neighbours or frame.window or not all(_can_be_split(file) for file in files):
            return (frame,)
        try:
            number = self._numbers.setdefault(key, len(self._patterns))
        except TypeError:  # an array
            return (frame,)
        if number == len(self._patterns):
            nothing: dict[str, Any] = dict.fromkeys(_FILES)
            self._patterns.append(dataclasses.replace(frame, name="", **nothing))
        row: list[Any] = [number, frame.name]
        names: dict[str, str] = {}
        for file in files:
            if file is None:
                row += (None, None)
            else:
                folder = self._folders.setdefault(file.parent, file.parent)
                row += (folder, names.setdefault(file.name, file.name))
        return tuple(row)


def _can_be_split(file: Any) -> bool:
    """Whether the file is its folder with its name; presigned addresses have a query as well."""
    if file is None:
        return True
    return isinstance(file, Path) and bool(file.name) and not getattr(file, "query", "")
