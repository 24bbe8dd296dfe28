"""Frame names that are fit for file names of results, on every operating system where asked."""

from __future__ import annotations

import re
from pathlib import PurePosixPath

_LONGEST_PART = 255 - len("_improvement.png")
"""Bytes of a part of a name, so that the longest file name of a result has 255."""

_LEADS_OUT = "leads out of the output folder"
_DRIVE = re.compile(r"[A-Za-z]:")
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])\s*(\..*)?", re.IGNORECASE)
"""Device names that Windows reserves in every folder, with any suffix."""


def normalised_name(name: str) -> str:
    """Returns the name without "./" and double slashes: what its files would be called."""
    return name if PurePosixPath(name).is_absolute() else PurePosixPath(name).as_posix()


def name_problem(name: str) -> str | None:
    """Returns why no result can be stored under a frame's name on POSIX; None if it can.

    The reason is a predicate, such as "holds a NUL character".
    """
    if "\0" in name:
        return "holds a NUL character"
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        return _LEADS_OUT
    if not path.parts:
        return "names no file"
    if any(len(part.encode("utf-8", "surrogateescape")) > _LONGEST_PART for part in path.parts):
        return f"is longer than {_LONGEST_PART} bytes"
    return None


def portable_name_problem(name: str) -> str | None:
    """Returns why a name is not fit for results on Linux, macOS or Windows; None if it is."""
    if "\\" in name:
        return "holds a backslash, which separates folders on Windows only; use /"
    if _DRIVE.match(name):
        return "begins with a drive letter"
    for part in PurePosixPath(name).parts:
        if _RESERVED.fullmatch(part):
            return f"holds {part!r}, which Windows reserves"
    problem = name_problem(name)
    return None if problem == _LEADS_OUT else problem  # only what writes results minds
