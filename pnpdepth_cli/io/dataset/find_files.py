"""All files below a folder."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Unmatched


def find_files(
    folder: Path, suffixes: Iterable[str]
) -> tuple[dict[str, Path], tuple[Unmatched, ...]]:
    """The files with one of these suffixes, by their place in the folder without the suffix.

    Links are followed, but not round in circles; hidden files and folders are left out. Sorted by
    place. Also what is in the way: folders that cannot be read, and two files of one place.
    """
    wanted = set(suffixes)
    files: dict[str, Path] = {}
    broken: list[Unmatched] = []
    twice: set[str] = set()
    found = sorted(_walk(folder, frozenset(), broken)) if folder.is_dir() else ()
    for path in found:
        if path.suffix.lower() not in wanted:
            continue
        place = path.relative_to(folder).with_suffix("").as_posix()
        if place in files:
            why = f"and {files[place].name} are one frame; keep one"
            broken.append(Unmatched(path=path, why=why))
            twice.add(place)
        files.setdefault(place, path)
    return {place: path for place, path in files.items() if place not in twice}, tuple(broken)


def _walk(folder: Path, above: frozenset[str], broken: list[Unmatched]) -> Iterator[Path]:
    real = os.path.realpath(folder)
    if real in above:
        return  # a link to a folder that it is in
    try:
        entries = [Path(entry.path) for entry in os.scandir(folder)]
    except OSError as error:
        why = (
            f"cannot be read ({(error.strerror or str(error)).lower()}); what is in it is left out"
        )
        broken.append(Unmatched(path=folder, why=why))
        return
    for path in entries:
        if path.name.startswith("."):
            continue
        if path.is_dir():
            yield from _walk(path, above | {real}, broken)
        elif path.is_file():
            yield path
