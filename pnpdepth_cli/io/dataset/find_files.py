"""All files in a folder and in the folders in it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Unmatched


def find_files(
    folder: Path, suffixes: tuple[str, ...]
) -> tuple[dict[str, Path], tuple[Unmatched, ...]]:
    """Returns the files with one of these suffixes, by relative path without suffix, and problems.

    Links are followed, except into a folder that they lie in. Hidden files and folders are skipped.
    Files are sorted by path. Problems are folders that cannot be read, and files that differ in
    suffix only, which are left out. The folder need not exist.
    """
    files: dict[str, Path] = {}
    broken: list[Unmatched] = []
    ambiguous: set[str] = set()
    paths = sorted(_walk(folder, frozenset(), broken)) if folder.is_dir() else []
    for path in paths:
        if path.suffix.lower() in suffixes:
            name = path.relative_to(folder).with_suffix("").as_posix()
            if name in files:
                why = f"and {files[name].name} are one frame; keep one"
                broken.append(Unmatched(path=path, why=why))
                ambiguous.add(name)
            files.setdefault(name, path)
    return {name: path for name, path in files.items() if name not in ambiguous}, tuple(broken)


def _walk(folder: Path, above: frozenset[str], broken: list[Unmatched]) -> Iterator[Path]:
    real = os.path.realpath(folder)
    if real in above:
        return  # a link to a folder that it is in
    try:
        paths = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        why = f"cannot be read ({reason}); what is in it is left out"
        broken.append(Unmatched(path=folder, why=why))
        return
    for path in paths:
        if path.is_dir():
            yield from _walk(path, above | {real}, broken)
        elif path.is_file():
            yield path
