"""What a layout is, and one made of a row: folders of files that belong together by their stem."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.dataset.find_files import find_files
from pnpdepth_cli.io.dataset.frame import (
    IMAGE_SUFFIXES,
    SCAN_ONLY_SUFFIXES,
    Frame,
    Listing,
    Unmatched,
)
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES

_SUFFIXES = {
    "IMAGE": IMAGE_SUFFIXES,
    "DEPTH": DEPTH_SUFFIXES,
    "SPARSE": (*DEPTH_SUFFIXES, *SCAN_ONLY_SUFFIXES, ".csv"),
    "CALIB": (".txt", ".json", ".yaml", ".yml"),
}
"""What a pattern of file names may end with, for any of these."""

Parts = dict[str, Any]
"""Files of one frame by field of `Frame`."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the files of a data set lie on disk."""

    matches: Callable[[Path], bool]
    """Whether a folder or file is of this layout."""
    listing: Callable[[Path], Listing]
    """The frames of a folder or file that matches, and what is in no frame."""
    needs: tuple[str, ...] = ()
    """Patterns of what the folder or one in it holds, for the message of an unknown folder."""


class _Part:
    """Where the files of one part of a frame lie, and what they are called."""

    def __init__(self, text: str, find: Callable[[Path], Path] | None) -> None:
        self.optional = text.endswith("?")
        folder, _, self.names = text.removesuffix("?").rpartition("/")
        self.folders, self._find = folder.split("|"), find

    def path(self, place: Path) -> Path:
        """Returns the first of the folders that exists."""
        if self._find is not None:
            return self._find(place)
        paths = [place / name for name in self.folders]
        return next((path for path in paths if path.is_dir()), paths[0])

    def files(self, place: Path) -> tuple[dict[str, Path], tuple[Unmatched, ...]]:
        """Returns the files by stem, sorted by number, and what cannot be read.

        Raises:
            InputError: Two files have the same stem.
        """
        folder, (stem, _, suffix) = self.path(place), self.names.rpartition(".")
        if stem == "**":
            return find_files(folder, _SUFFIXES[suffix])
        suffixes = "|".join(each[1:] for each in _SUFFIXES.get(suffix, (f".{suffix}",)))
        groups = stem if "(" in stem else stem.replace(".", r"\.").replace("*", "(.+)")
        pattern = re.compile(rf"{groups}\.(?:{suffixes})", re.IGNORECASE | re.DOTALL)
        files: dict[str, Path] = {}
        for path in sorted(folder.iterdir() if folder.is_dir() else ()):
            match = pattern.fullmatch(path.name)
            if match and path.is_file():
                stem = "".join(match.groups(""))
                if stem in files:
                    raise InputError(f"{path} and {files[stem].name} are one frame; keep one")
                files[stem] = path
        return {stem: files[stem] for stem in sorted(files, key=_by_numbers)}, ()


def _by_numbers(stem: str) -> list[tuple[int, str]]:
    return [(int(part) if part.isdecimal() else 0, part) for part in re.split(r"(\d+)", stem)]


def row(
    parts: Mapping[str, str],
    *,
    name: Callable[[Path, Path, str], str],
    below: str = "",
    marks: tuple[str, ...] = (),
    places: Callable[[Path], Iterable[Path]] | None = None,
    folders: Mapping[str, Callable[[Path], Path]] | None = None,
    needs: tuple[str, ...] = (),
    absent: Callable[[Path], str] | None = None,
    gaps: bool = False,
    more: Callable[[Path, Parts], Mapping[str, Any] | Unmatched | None] = lambda place, files: {},
    **fields: Any,
) -> Layout:
    """Returns the layout of a data set whose parts lie in folders, with files of one stem.

    Args:
        parts: By field of `Frame`, or "mask…" for its masks, "folder|other folder/*.png": the
            names of its files in the first of these folders that exists in a place. `*`, or groups
            of a regular expression, make the stem; `**` are paths in the folder and all folders in
            it. A part that ends with ? may be missing; every frame has the first.
        name: From root, place and stem to the name of a frame.
        below: Patterns of where the places are, below the root, with | between them.
        marks: Patterns of what else a place has. By the first, or the last part's folder, a place
            is found.
        places: Returns the places below a root, instead of `below` and `marks`.
        folders: From the place to the folder, of parts that lie elsewhere.
        needs: As in `Layout`, if not the folders of the parts and `marks`.
        absent: From a place that lacks a folder to the end of a sentence about it.
        gaps: Whether a file of the first part without a partner is spare, not broken.
        more: From place and the frame's files to further fields; None leaves the frame out.
        fields: Fields that all frames have.
    """
    kinds = {field: _Part(text, (folders or {}).get(field)) for field, text in parts.items()}
    wanted = [kind for kind in kinds.values() if not kind.optional]
    probe = marks[0] if marks else wanted[-1].folders[0]
    missing = (*(kind.folders[0] for kind in wanted), *marks)

    def find(root: Path) -> list[Path]:
        if places is not None:
            return list(places(root))
        found = {path.parent for start in below.split("|") for path in root.glob(start + probe)}
        return sorted(
            place
            for place in found
            if all(kind.path(place).is_dir() for kind in wanted)
            and all(next(place.glob(mark), None) for mark in marks)
        )

    def of_place(root: Path, place: Path) -> Listing:
        def make(stem: str, files: Parts) -> Frame | Unmatched | None:
            extra = more(place, files)
            if not isinstance(extra, Mapping):
                return extra
            values = {**files, **fields, **extra}
            masks = tuple(values.pop(key) for key in list(values) if key.startswith("mask"))
            return Frame(name=name(root, place, stem), masks=masks, **values)

        if absent and not all(kind.path(place).is_dir() for kind in wanted):
            return Listing(frames=[], broken=(Unmatched(path=place, why=absent(place)),))
        return _joined(place, kinds, make, gaps)

    return Layout(
        matches=lambda root: bool(find(root)),
        listing=lambda root: merged(of_place(root, place) for place in find(root)),
        needs=needs or tuple(dict.fromkeys(filter(None, missing))),
    )


def either(first: Layout, other: Layout) -> Layout:
    """Returns the layout of a data set that comes in two ways; the first is looked for first."""
    return Layout(
        matches=lambda root: first.matches(root) or other.matches(root),
        listing=lambda root: (first if first.matches(root) else other).listing(root),
        needs=first.needs,
    )


def _joined(
    place: Path,
    kinds: Mapping[str, _Part],
    make: Callable[[str, Parts], Frame | Unmatched | None],
    gaps: bool,
) -> Listing:
    """A frame for each file of the first part with a partner in all others that are needed."""
    found = {field: kind.files(place) for field, kind in kinds.items()}
    files = {field: of for field, (of, _) in found.items()}
    first, *others = files
    needed = [field for field in others if not kinds[field].optional]
    made = [
        make(stem, {field: of[stem] for field, of in files.items() if stem in of})
        for stem in files[first]
        if all(stem in files[field] for field in needed)
    ]

    def alone(field: str, other: str) -> list[Unmatched]:
        why = f"has no partner {{}}.* in {kinds[other].path(place)}; add or remove one"
        left = (each for each in files[field].items() if each[0] not in files[other])
        return [Unmatched(path=path, why=why.format(stem)) for stem, path in left]

    lost = [each for field in needed for each in alone(first, field)]
    spare = [each for field in others for each in alone(field, first)]
    return listing_of(
        made,
        broken=(
            *(each for _, unreadable in found.values() for each in unreadable),
            *([] if gaps else lost),
        ),
        spare=(*(lost if gaps else []), *spare),
    )


def listing_of(
    made: Iterable[Frame | Unmatched | None],
    broken: tuple[Unmatched, ...] = (),
    spare: tuple[Unmatched, ...] = (),
) -> Listing:
    """Returns the frames, and what could not become one after what is broken already."""
    every = list(made)
    lost = dict.fromkeys(each for each in every if isinstance(each, Unmatched))
    frames = [each for each in every if isinstance(each, Frame)]
    return Listing(frames=frames, broken=(*broken, *lost), spare=spare)


def merged(listings: Iterable[Listing]) -> Listing:
    """Returns all frames and other files of the listings."""
    every = list(listings)
    return Listing(
        frames=[frame for one in every for frame in one.frames],
        broken=tuple(each for one in every for each in one.broken),
        spare=tuple(each for one in every for each in one.spare),
    )
