"""What a layout is, and one made of a row: folders of files that belong together by their stem."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.dataset.frame_files import (
    IMAGE_SUFFIXES,
    SCAN_ONLY_SUFFIXES,
    VIDEO_SUFFIXES,
    FrameFiles,
    Unmatched,
    VideoFrame,
    find_files,
    natural_order,
    one_of_each,
)
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES

_SUFFIXES = {
    "IMAGE": IMAGE_SUFFIXES,
    "DEPTH": DEPTH_SUFFIXES,
    "SPARSE": (*DEPTH_SUFFIXES, *SCAN_ONLY_SUFFIXES, ".csv"),
    "CALIB": (".txt", ".json", ".yaml", ".yml"),
}
"""What a pattern of file names may end with, for any of these."""

Files = dict[str, Path]
"""Files of one frame, by field of `FrameFiles`."""
Fields = Mapping[str, Any] | Unmatched | None
"""More fields of a frame, why it is none, or None for one that is not wanted."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the files of a data set lie on disk."""

    matches: Callable[[Path], Any]  # true for a folder or file of this layout
    frames: Callable[[Path], Iterable[FrameFiles | Unmatched]]
    """The frames of a folder or file that matches, and what is in no frame."""
    needs: tuple[str, ...] = ()
    """Patterns of what the folder or one in it holds, for the message of an unknown folder."""


class _FilePart:
    """Where the files of one part of a frame lie, and what they are called."""

    def __init__(self, text: str, find: Callable[[Path], Path] | None) -> None:
        self.optional = text.endswith("?")
        folder, _, names = text.removesuffix("?").rpartition("/")
        self.folders, self._find = folder.split("|"), find
        self._stem, _, self._suffix = names.rpartition(".")

    def path(self, place: Path) -> Path:
        """Returns the first of the folders that exists."""
        if self._find is not None:
            return self._find(place)
        paths = [place / name for name in self.folders]
        return next((path for path in paths if path.is_dir()), paths[0])

    def video(self, place: Path) -> Path | None:
        """Returns the video that lies there instead of the folder of images."""
        if self._suffix != "IMAGE" or self.path(place).is_dir():
            return None
        paths = (place / f"{name}{suffix}" for name in self.folders for suffix in VIDEO_SUFFIXES)
        return next((path for path in paths if path.is_file()), None)

    def files(self, place: Path) -> tuple[dict[str, Path], list[Unmatched]]:
        """Returns the files by stem, sorted by number, and what belongs to no frame."""
        folder, suffixes = self.path(place), _SUFFIXES.get(self._suffix, (f".{self._suffix}",))
        if self._stem == "**":
            return find_files(folder, suffixes)
        stem = self._stem if "(" in self._stem else re.escape(self._stem).replace(r"\*", "(.+)")
        endings = "|".join(map(re.escape, suffixes))
        pattern = re.compile(f"{stem}(?:{endings})", re.IGNORECASE | re.DOTALL)
        paths = sorted(folder.iterdir()) if folder.is_dir() else []
        files, ambiguous = one_of_each(
            ("".join(match.groups("")), path)
            for path in paths
            if (match := pattern.fullmatch(path.name)) and path.is_file()
        )
        return {stem: files[stem] for stem in sorted(files, key=natural_order)}, ambiguous


def row(
    parts: Mapping[str, str],
    *,
    name: Callable[[Path, Path, str], str],
    below: str = "",
    marks: tuple[str, ...] = (),
    places: Callable[[Path], list[Path]] | None = None,
    folders: Mapping[str, Callable[[Path], Path]] | None = None,
    needs: tuple[str, ...] = (),
    gaps: bool = False,
    calib: str = "",
    more: Callable[[Path], Callable[[Files], Fields]] = lambda place: lambda files: {},
    **fields: Any,
) -> Layout:
    """Returns the layout of a data set whose parts lie in folders, with files of one stem.

    Args:
        parts: Patterns of files by field of `FrameFiles`, or "mask…" for its masks. A pattern is
            "folder|other folder/*.png": the first of these folders that exists in a place, and the
            names of the files in it. `*`, or groups of a regular expression, make the stem. `**`
            are paths in the folder and all folders in it. Instead of images, a video of the
            folder's name may lie there (rgb.mp4). Its frame, from 0, is the number at the end of a
            stem. A part that ends with ? may be missing; every frame has the first.
        name: Function of root, place and stem that gives the name of a frame.
        below: Patterns of where the places are, below the root, with | between them.
        marks: Patterns of what else a place has. The first, or else the last part's folder, finds
            a place.
        places: Function of a root that gives the places, instead of `below` and `marks`.
        folders: Functions of a place that give the folders of parts that lie elsewhere.
        needs: Field `needs` of `Layout`, if not the folders of the parts and `marks`.
        gaps: Whether a file of the first part without a partner is spare, not broken.
        calib: File in a place, the calibration of frames without one of their own.
        more: Function of a place. It gives a function from a frame's files to its further fields.
        fields: Fields that all frames have.
    """
    # The parts, and what finds a place.
    kinds = {field: _FilePart(text, (folders or {}).get(field)) for field, text in parts.items()}
    wanted = [kind for kind in kinds.values() if not kind.optional]
    probe = marks[0] if marks else wanted[-1].folders[0]

    def find(root: Path) -> list[Path]:
        found = {path.parent for start in below.split("|") for path in root.glob(start + probe)}
        return sorted(
            place
            for place in found
            if all(kind.path(place).is_dir() or kind.video(place) for kind in wanted)
            and all(next(place.glob(mark), None) for mark in marks)
        )

    find_places = places or find

    def frames(root: Path) -> Iterator[FrameFiles | Unmatched]:
        for place in find_places(root):
            # What all frames of the place share, and its videos.
            fields_of = more(place)
            shared = {"calib": place / calib} if calib and (place / calib).is_file() else {}
            videos = {field: path for field, kind in kinds.items() if (path := kind.video(place))}
            others = {field: kind for field, kind in kinds.items() if field not in videos}
            for found in _join_parts(place, others, gaps):
                if isinstance(found, Unmatched):
                    yield found
                    continue
                # A frame of a video has the number at the end of the stem.
                stem, files = found
                number = re.search(r"\d+$", stem)
                if videos and number is None:
                    why = f"has no number of a frame of {next(iter(videos.values()))} in its name"
                    yield Unmatched(path=next(iter(files.values())), why=why)
                    continue
                # Further fields may rule the frame out.
                extra = fields_of(files)
                if isinstance(extra, Unmatched):
                    yield extra
                elif extra is not None:
                    values = {**shared, **files, **fields, **extra}
                    for field, path in videos.items():
                        values[field] = VideoFrame(path=path, index=int(number[0] if number else 0))
                    masks = tuple(values.pop(key) for key in files if key.startswith("mask"))
                    yield FrameFiles(name=name(root, place, stem), masks=masks, **values)

    # What the layout needs, for messages.
    missing = (*(kind.folders[0] for kind in wanted), *marks)
    return Layout(
        matches=find_places,
        frames=frames,
        needs=needs or tuple(dict.fromkeys(filter(None, missing))),
    )


def _join_parts(
    place: Path, kinds: Mapping[str, _FilePart], gaps: bool
) -> Iterator[tuple[str, Files] | Unmatched]:
    """The stem and files of each frame, and the files that lack a partner."""
    first, *others = kinds
    needed = [field for field in others if not kinds[field].optional]
    absent = [path for field in needed if not (path := kinds[field].path(place)).is_dir()]
    if absent:
        yield Unmatched(path=place, why=f"has no {absent[0]}; add it")
        return
    files: dict[str, dict[str, Path]] = {}
    for field, kind in kinds.items():
        files[field], unreadable = kind.files(place)
        yield from unreadable

    def alone(field: str, other: str, *, spare: bool) -> Iterator[Unmatched]:
        for stem, path in files[field].items():
            if stem not in files[other]:
                why = f"has no partner {stem}.* in {kinds[other].path(place)}; add or remove one"
                yield Unmatched(path=path, why=why, spare=spare)

    for field in needed:
        yield from alone(first, field, spare=gaps)
    for stem in files[first]:
        if all(stem in files[field] for field in needed):
            yield stem, {field: of[stem] for field, of in files.items() if stem in of}
    for field in others:
        yield from alone(field, first, spare=True)
