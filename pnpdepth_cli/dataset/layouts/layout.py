"""What a layout is, and one made of a row: folders of files that belong together by their stem.

A place is a folder that holds all parts of some frames, such as one sequence of a data set: its
images, its sparse depth, its calibration.
"""

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
"""Words that the pattern of a file name may end with, for any of these suffixes."""

_NO_FIELDS = FrameFiles()


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the files of a data set lie on disk."""

    matches: Callable[[Path], object]
    """Returns something true for a folder or file of this layout."""
    frames: Callable[[Path], Iterable[FrameFiles | Unmatched]]
    """Returns the frames of a folder or file that matches, and the files that are in no frame."""
    needs: tuple[str, ...] = ()
    """Patterns of what a place of the data set has, for errors; | between alternatives."""
    below: str = ""
    """Patterns of where the places are, below the root, with | between them. Empty: it is one."""

    def lacks(self, root: Path) -> tuple[Path, str] | None:
        """Returns the place that lacks least, and one pattern that it lacks; None if it has all."""
        places = [root]
        for pattern in self.below.split("|"):
            places += [path.parent for path in root.glob(f"{pattern}*")]
        lacked = {place: lacking(place, self.needs) for place in places}
        best = min(lacked, key=lambda place: len(lacked[place]))
        if not lacked[best]:
            return None
        return best, lacked[best][0].replace("|", " or ")


Finish = Callable[[FrameFiles], FrameFiles | None]
"""Returns a frame with further fields, such as its pose, or None for one that is not wanted."""


def as_it_is(frame: FrameFiles) -> FrameFiles:
    """Returns the frame itself: the `Finish` of frames that need no further fields."""
    return frame


Part = tuple[Path, str]
"""The folder of one part of a frame, such as its images, and a pattern of the names of its files.

The stem of a name, by which the parts of a frame belong together, is what * stands for, or the
groups of a regular expression. ** stands for paths below the folder. A part whose pattern ends with
? may be missing."""


def _video_of(part: Part) -> Path | None:
    """The video beside the folder of images that a part names. None: the folder is there."""
    folder, pattern = part
    if not pattern.endswith(".IMAGE") or folder.is_dir():
        return None
    for suffix in VIDEO_SUFFIXES:
        video = folder.with_name(folder.name + suffix)
        if video.is_file():
            return video
    return None


def _exists(part: Part) -> bool:
    """Whether the folder of a part is there, or the video instead of it."""
    folder, _ = part
    return folder.is_dir() or _video_of(part) is not None


def lacking(place: Path, needs: Iterable[str]) -> list[str]:
    """Returns those of the patterns that nothing in a place has.

    Args:
        place: A folder.
        needs: Patterns of paths below it, with | between alternatives.
    """
    lacked = list[str]()
    for need in needs:
        is_there = any(next(place.glob(pattern), None) for pattern in need.split("|"))
        if not is_there:
            lacked.append(need)
    return lacked


def _files_of(part: Part) -> tuple[dict[str, Path], list[Unmatched]]:
    """The files that a part names, by their stem in natural order; and those that share a stem.

    Both are empty without the part's folder.
    """
    folder, pattern = part
    stem, _, ending = pattern.removesuffix("?").rpartition(".")
    suffixes = _SUFFIXES.get(ending, (f".{ending}",))
    if stem == "**":  # files in the folder and below, whose stem is their path
        return find_files(folder, suffixes)
    # A regular expression of the whole name, whose groups are the frame's stem.
    stem_pattern = stem if "(" in stem else re.escape(stem).replace(r"\*", "(.+)")
    suffix_pattern = "|".join(map(re.escape, suffixes))
    name_pattern = re.compile(f"{stem_pattern}(?:{suffix_pattern})", re.IGNORECASE | re.DOTALL)
    named = list[tuple[str, Path]]()
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        match = name_pattern.fullmatch(path.name)
        if match is not None and path.is_file():
            named.append(("".join(match.groups("")), path))
    files, ambiguous = one_of_each(named)
    in_order = {name: files[name] for name in sorted(files, key=natural_order)}
    return in_order, ambiguous


def join_parts(parts: Mapping[str, Part], shared: FrameFiles) -> Iterator[FrameFiles | Unmatched]:
    """Yields the frames, named by the stems of the first part's files, and files of no frame.

    The files of a frame have one stem, such as 000123 of 000123.png and 000123.bin.

    Args:
        parts: Folder of each part of the frames, and pattern of its files' names, by the part's
            field of `FrameFiles`; masks by names that begin with "mask". There are images, or one
            video instead. Every frame has the first part, and those whose pattern has no ? at its
            end.
        shared: A frame whose fields all frames have.
    """
    # The images may be a video, which has each frame by its number.
    video = _video_of(parts["image"])
    if video is not None:
        parts = {field: parts[field] for field in parts if field != "image"}
    first, *others = parts
    needed = [field for field in others if not parts[field][1].endswith("?")]
    for field in needed:
        folder, _ = parts[field]
        if not folder.is_dir():
            yield parts[first][0], f"has no {folder}; add it"
            return
    files = dict[str, dict[str, Path]]()  # by part, then by stem
    for field in parts:
        files[field], ambiguous = _files_of(parts[field])
        yield from ambiguous
    # Files without a partner.
    pairs = [(first, field) for field in needed] + [(field, first) for field in others]
    for field, partner in pairs:
        for stem, path in files[field].items():
            if stem not in files[partner]:
                yield path, f"has no partner {stem}.* in {parts[partner][0]}; add or remove one"
    # The frames.
    for stem in files[first]:
        paths = {field: files[field][stem] for field in files if stem in files[field]}
        if any(field not in paths for field in needed):
            continue
        image: Path | VideoFrame | None = paths.get("image")
        if video is not None:
            number = re.search(r"\d+$", stem)
            if number is None:
                yield paths[first], f"has no number of a frame of {video} in its name"
                continue
            image = VideoFrame(path=video, index=int(number[0]))
        yield replace(
            shared,
            name=stem,
            image=image,
            sparse=paths.get("sparse"),
            sparse_mask=paths.get("sparse_mask"),
            gt=paths.get("gt"),
            calib=paths.get("calib", shared.calib),
            masks=tuple(path for field, path in paths.items() if field.startswith("mask")),
        )


def _path_below(root: Path, place: Path, stem: str) -> str:
    """The name of a frame that is the path of its files below the root."""
    return (place.relative_to(root) / stem).as_posix()


def layout_of_folders(
    parts: Mapping[str, str],
    *,
    name: Callable[[Path, Path, str], str] = _path_below,
    below: str = "",
    marks: tuple[str, ...] = (),
    calib: str = "",
    finish_of: Callable[[Path], Finish] | None = None,
    shared: FrameFiles = _NO_FIELDS,
) -> Layout:
    """Returns the layout of a data set whose parts lie in folders, with files of one stem.

    Args:
        parts: Folder and pattern of the names of files (see `Part`), as one path, by field of
            `FrameFiles`. Of several folders, with | between them, the first that exists counts.
            Every frame has the first part.
        name: Function of root, place and stem that gives the name of a frame.
        below: Patterns of where the places are, below the root, with | between them.
        marks: Patterns of what else a place has. The first of these finds the places; without any,
            the folder of the last part that is needed does.
        calib: File in a place, the calibration of frames without one of their own. Empty: none.
        finish_of: Function of a place that returns the function which finishes its frames, named by
            their stems. None: they are complete.
        shared: A frame whose fields all frames have.
    """
    # What a place of the data set has, and by what it is found.
    needed = [_paths_of(text) for text in parts.values() if "/" in text and not text.endswith("?")]
    needs = (*needed, *marks)
    finder = marks[0] if marks else needed[-1].split("|")[0]

    def find_places(root: Path) -> list[Path]:
        """The places below a root that have all that is needed."""
        places = set[Path]()
        for start in below.split("|"):
            places |= {path.parent for path in root.glob(start + finder)}
        return sorted(place for place in places if not lacking(place, needs))

    def frames(root: Path) -> Iterator[FrameFiles | Unmatched]:
        """Yields the finished frames of all places below a root, and the files of no frame."""
        for place in find_places(root):
            # What all frames of the place have.
            has_calibration = bool(calib) and (place / calib).is_file()
            calibration = place / calib if has_calibration else None
            shared_in_place = replace(shared, calib=calibration)
            # Its frames, which have only their stems as names at first.
            finish = as_it_is if finish_of is None else finish_of(place)
            parts_of_place = {field: _part_in(place, text) for field, text in parts.items()}
            for entry in join_parts(parts_of_place, shared_in_place):
                if isinstance(entry, tuple):  # a file of no frame, and why
                    yield entry
                    continue
                frame = finish(entry)
                if frame is not None:
                    yield replace(frame, name=name(root, place, frame.name))

    return Layout(matches=find_places, frames=frames, needs=needs, below=below)


def _paths_of(text: str) -> str:
    """The paths of which a place needs one to have a part, with | between them.

    They are the folders where the part's files may lie, and the videos that may be there instead of
    a folder of images.

    Args:
        text: Folders, with | between them, and pattern of names, as one path.
    """
    folders, _, pattern = text.rpartition("/")
    endings = ("", *VIDEO_SUFFIXES) if pattern.endswith(".IMAGE") else ("",)
    return "|".join(folder + ending for ending in endings for folder in folders.split("|"))


def _part_in(place: Path, text: str) -> Part:
    """The folder of a part, and the pattern of its files' names.

    Of several folders that it may have, it is the first that exists, or whose video does; else the
    first of all.

    Args:
        place: The folder of all parts.
        text: Folders, with | between them, and pattern of names, as one path.
    """
    folders, _, pattern = text.rpartition("/")
    candidates = [(place / folder, pattern) for folder in folders.split("|")]
    return next(filter(_exists, candidates), candidates[0])
