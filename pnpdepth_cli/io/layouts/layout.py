"""What a layout is, and one made of a row: folders of files that belong together by their stem."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.dataset.frame import IMAGE_SUFFIXES, Frame, Listing, Unmatched

IMAGE = rf"(.+)\.(?:{'|'.join(suffix[1:] for suffix in IMAGE_SUFFIXES)})"
"""Names of images; the group is the stem."""
PNG, BIN, TXT = r"(.+)\.png", r"(.+)\.bin", r"(.+)\.txt"

Files = dict[str, Path]
"""Files of a folder by stem."""

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
    """Patterns of what the folder holds, for the message of an unknown folder."""


class Part(NamedTuple):
    """The files of one part of a frame."""

    folder: str
    """Relative to the place where the parts are, "" for the place itself; "a|b" is the first of two
    that exists."""
    pattern: str = PNG
    """Of the names of its files; the group is the stem. Case does not matter."""
    optional: bool = False
    """Whether frames, and places, may lack it."""

    def path(self, place: Path) -> Path:
        """Returns its folder in a place."""
        paths = [place / name for name in self.folder.split("|")]
        return next((path for path in paths if path.is_dir()), paths[0])


def of_folders(
    parts: Mapping[str, Part],
    *,
    below: tuple[str, ...] = ("",),
    probe: str,
    marks: tuple[str, ...] = (),
    needs: tuple[str, ...],
    name: Callable[[Path, Path, str], str],
    spare: Container[str] = (),
    order: Callable[[str], Any] = lambda stem: (),
    more: Callable[[Path, Path, Parts], Mapping[str, Any] | None] = lambda root, place, files: {},
    **fields: Any,
) -> Layout:
    """Returns the layout of a data set whose parts lie in folders, with files of one stem.

    Args:
        parts: By field of `Frame`, or "mask" for one of its masks; the first is the one that every
            frame has.
        below: Where the parts may be, below the root.
        probe: A path in such a place by which it is found.
        marks: Other paths that such a place has.
        needs: As in `Layout`.
        name: From root, place and stem to the name of a frame.
        spare: Parts whose files without a partner are listed as spare.
        order: Key by which the stems of a place are sorted; by default, as their files are.
        more: From root, place and the frame's files to further fields; None leaves the frame out.
        fields: Fields that all frames have.
    """

    def places(root: Path) -> list[Path]:
        depth = len(Path(probe).parts) - 1
        found = {path.parents[depth] for start in below for path in root.glob(start + probe)}
        wanted = [part for part in parts.values() if not part.optional]
        return sorted(
            place
            for place in found
            if all(part.path(place).is_dir() for part in wanted)
            and all((place / mark).exists() for mark in marks)
        )

    def listing(root: Path) -> Listing:
        return merged(of_place(root, place) for place in places(root))

    def of_place(root: Path, place: Path) -> Listing:
        def make(stem: str, files: Parts) -> Frame | None:
            extra = more(root, place, files)
            if extra is None:
                return None
            parts_of: Parts = {"name": name(root, place, stem), **files, **fields, **extra}
            if "mask" in parts_of:
                parts_of["masks"] = (parts_of.pop("mask"),)
            return Frame(**parts_of)

        folders = {field: part.path(place) for field, part in parts.items()}
        files = {field: files_in(folders[field], part.pattern) for field, part in parts.items()}
        first = next(iter(parts))
        files[first] = {stem: files[first][stem] for stem in sorted(files[first], key=order)}
        optional = [field for field, part in parts.items() if part.optional]
        return joined(folders, files, make, optional=optional, spare=spare)

    return Layout(matches=lambda root: bool(places(root)), listing=listing, needs=needs)


def files_in(folder: Path, pattern: str) -> Files:
    """Returns the files of a folder, which need not exist, by the stem in their names, sorted.

    Raises:
        InputError: Two files have the same stem.
    """
    compiled = re.compile(pattern, re.IGNORECASE | re.DOTALL)
    files: Files = {}
    for path in sorted(folder.iterdir() if folder.is_dir() else ()):
        match = compiled.fullmatch(path.name)
        if match and path.is_file():
            if match[1] in files:
                raise InputError(f"{path} and {files[match[1]].name} are one frame; keep one")
            files[match[1]] = path
    return files


def joined(
    folders: Mapping[str, Path],
    files: Mapping[str, Files],
    make: Callable[[str, Parts], Frame | None],
    *,
    optional: Container[str] = (),
    spare: Container[str] = (),
) -> Listing:
    """Returns a frame for each file of the first part with a partner in the others.

    Args:
        folders: Where the files of each part are, for messages.
        files: Of each part, by stem.
        make: From the stem and its files to the frame; None leaves it out.
        optional: Parts that a frame may lack.
        spare: Parts whose files without a partner are spare.
    """
    first, *others = files
    needed = [part for part in others if part not in optional]
    frames: list[Frame | None] = []
    for stem in files[first]:
        if all(stem in files[part] for part in needed):
            frames.append(make(stem, {part: of[stem] for part, of in files.items() if stem in of}))
    broken = (without_partner(files[first], files[part], folders[part]) for part in needed)
    left = (
        without_partner(files[part], files[first], folders[first])
        for part in others
        if part in spare
    )
    return Listing(
        frames=[frame for frame in frames if frame is not None],
        broken=tuple(each for one in broken for each in one),
        spare=tuple(each for one in left for each in one),
    )


def without_partner(
    files: Mapping[str, Path], others: Container[str], folder: Path
) -> tuple[Unmatched, ...]:
    """Returns the files whose stem is not among the others, which `folder` holds."""
    return tuple(
        Unmatched(path=path, why=f"has no partner {stem}.* in {folder}; add or remove one")
        for stem, path in files.items()
        if stem not in others
    )


def merged(listings: Iterable[Listing]) -> Listing:
    """Returns all frames and other files of the listings."""
    every = list(listings)
    return Listing(
        frames=[frame for one in every for frame in one.frames],
        broken=tuple(each for one in every for each in one.broken),
        spare=tuple(each for one in every for each in one.spare),
    )
