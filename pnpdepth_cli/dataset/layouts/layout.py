"""What a layout is, and one made of a row: folders of files that belong together by their stem."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

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

_NO_FIELDS = FrameFiles()


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the files of a data set lie on disk."""

    matches: Callable[[Path], object]  # true for a folder or file of this layout
    frames: Callable[[Path], Iterable[FrameFiles | Unmatched]]
    """The frames of a folder or file that matches, and what is in no frame."""
    needs: tuple[str, ...] = ()
    """Patterns of what a place of the data set has, for errors; | between alternatives."""
    below: str = ""  # patterns of where the places are, below the root, with | between them

    def lacks(self, root: Path) -> tuple[Path, str] | None:
        """Returns the place with the most that is needed, and what it lacks, if anything."""
        found = (p.parent for start in self.below.split("|") for p in root.glob(f"{start}*"))
        places = {place: lacking(place, self.needs) for place in (root, *found)}
        place = min(places, key=lambda place: len(places[place]))
        return (place, places[place][0].replace("|", " or ")) if places[place] else None


Part = tuple[Path, str]
"""The folder of one part of a frame, and a pattern of the names of its files.

The stem of a name is what * stands for, or groups of a regular expression; ** stands for paths
below the folder. A part whose pattern ends with ? may be missing."""


def _video(folder: Path, names: str) -> Path | None:
    """The video that lies there instead of the folder of images."""
    if not names.endswith(".IMAGE") or folder.is_dir():
        return None
    paths = (folder.with_name(folder.name + suffix) for suffix in VIDEO_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _exists(part: Part) -> bool:
    """Whether the folder of a part, or the video instead of it, is there."""
    return part[0].is_dir() or _video(*part) is not None


def lacking(place: Path, needs: Iterable[str]) -> list[str]:
    """Returns the patterns, with | between alternatives, that nothing in a place has."""
    return [need for need in needs if not any(next(place.glob(p), None) for p in need.split("|"))]


def _files(folder: Path, names: str) -> tuple[dict[str, Path], list[Unmatched]]:
    """The files of a part by stem, sorted by number, and what belongs to no frame."""
    stem, _, suffix = names.removesuffix("?").rpartition(".")
    suffixes = _SUFFIXES.get(suffix, (f".{suffix}",))
    if stem == "**":
        return find_files(folder, suffixes)
    stem = stem if "(" in stem else re.escape(stem).replace(r"\*", "(.+)")
    endings = "|".join(map(re.escape, suffixes))
    pattern = re.compile(f"{stem}(?:{endings})", re.IGNORECASE | re.DOTALL)
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    files, ambiguous = one_of_each(
        ("".join(match.groups("")), path)
        for path in paths
        if (match := pattern.fullmatch(path.name)) and path.is_file()
    )
    return {stem: files[stem] for stem in sorted(files, key=natural_order)}, ambiguous


def join_parts(parts: Mapping[str, Part], shared: FrameFiles) -> Iterator[FrameFiles | Unmatched]:
    """Yields the frames, which the first part has, named by their stems; and files of none.

    `shared` is a frame whose fields all frames have.
    """
    # The images may be a video, which has each frame by its number.
    video = _video(*parts["image"])
    if video is not None:
        parts = {field: parts[field] for field in parts if field != "image"}
    first, *others = parts
    needed = [field for field in others if not parts[field][1].endswith("?")]
    for field in needed:
        folder = parts[field][0]
        if not folder.is_dir():
            yield parts[first][0], f"has no {folder}; add it"
            return
    files = dict[str, dict[str, Path]]()
    for field, (folder, names) in parts.items():
        files[field], unreadable = _files(folder, names)
        yield from unreadable
    # Files without a partner.
    pairs = [(first, field) for field in needed] + [(field, first) for field in others]
    for field, partner in pairs:
        for stem, path in files[field].items():
            if stem not in files[partner]:
                yield path, f"has no partner {stem}.* in {parts[partner][0]}; add or remove one"
    # The frames.
    for stem in files[first]:
        own = {field: found[stem] for field, found in files.items() if stem in found}
        if not own.keys() >= set(needed):
            continue
        image: Path | VideoFrame | None = own.get("image")
        if video is not None:
            if (number := re.search(r"\d+$", stem)) is None:
                yield own[first], f"has no number of a frame of {video} in its name"
                continue
            image = VideoFrame(path=video, index=int(number[0]))
        yield replace(
            shared,
            name=stem,
            image=image,
            sparse=own.get("sparse"),
            sparse_mask=own.get("sparse_mask"),
            gt=own.get("gt"),
            calib=own.get("calib", shared.calib),
            masks=tuple(path for field, path in own.items() if field.startswith("mask")),
        )


def _path_below(root: Path, place: Path, stem: str) -> str:
    """The path of a frame's files below the root."""
    return (place.relative_to(root) / stem).as_posix()


def row(
    parts: Mapping[str, str],
    *,
    name: Callable[[Path, Path, str], str] = _path_below,
    below: str = "",
    marks: tuple[str, ...] = (),
    calib: str = "",
    more: Callable[[Path], Callable[[FrameFiles], FrameFiles | None]] | None = None,
    shared: FrameFiles = _NO_FIELDS,
) -> Layout:
    """Returns the layout of a data set whose parts lie in folders, with files of one stem.

    Args:
        parts: Folder, or folders with | between them of which the first that exists counts, and
            pattern (see `Part`) by field of `FrameFiles`. Every frame has the first part.
        name: Function of root, place and stem that gives the name of a frame; by default it is
            the path of its files below the root.
        below: Patterns of where the places are, below the root, with | between them.
        marks: Patterns of what else a place has. The first, or else the last needed part's folder,
            finds a place.
        calib: File in a place, the calibration of frames without one of their own.
        more: Function of a place. It gives a function of a frame, named by its stem, that returns
            it with further fields, or None for one that is not wanted.
        shared: A frame whose fields all frames have.
    """
    # What a place of the data set has, and by what it is found.
    needed = [_places(text) for text in parts.values() if "/" in text and not text.endswith("?")]
    needs = (*needed, *marks)
    probe = marks[0] if marks else needed[-1].split("|")[0]

    def find(root: Path) -> list[Path]:
        """The places below a root that have all that is needed."""
        found = {path.parent for start in below.split("|") for path in root.glob(start + probe)}
        return sorted(place for place in found if not lacking(place, needs))

    def parts_in(place: Path) -> dict[str, Part]:
        """The parts of the frames of a place."""
        return {field: _part(place, text) for field, text in parts.items()}

    def frames(root: Path) -> Iterator[FrameFiles | Unmatched]:
        """The frames of all places, and what is in none."""
        for place in find(root):
            own = place / calib if calib and (place / calib).is_file() else None
            complete = more(place) if more else replace
            for found in join_parts(parts_in(place), replace(shared, calib=own)):
                if isinstance(found, tuple):
                    yield found
                elif (frame := complete(found)) is not None:
                    yield replace(frame, name=name(root, place, frame.name))

    return Layout(matches=find, frames=frames, needs=needs, below=below)


def _places(text: str) -> str:
    """Where the files of a part may lie: its folders, and videos instead of images."""
    folders, _, names = text.rpartition("/")
    videos = VIDEO_SUFFIXES if names.endswith(".IMAGE") else ()
    return "|".join(folder + end for end in ("", *videos) for folder in folders.split("|"))


def _part(place: Path, text: str) -> Part:
    """The part of a place in the first of its folders, or videos, that exists."""
    folders, _, names = text.rpartition("/")
    parts = [(place / folder, names) for folder in folders.split("|")]
    return next(filter(_exists, parts), parts[0])
