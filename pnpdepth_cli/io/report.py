"""A report as a folder: one page that opens from disk, and its images beside it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError, InputError, OutputError
from pnpdepth_cli.io.atomic import (
    atomic_folder,
    atomic_path,
    cannot_write,
    make_folder,
    remove_leftovers,
)
from pnpdepth_cli.io.record import plain, read_json, write_json
from pnpdepth_cli.io.report_view import VIEWER, save_viewer

PAGE = "index.html"
IMAGES = "images"
_OLD_IMAGES = "pictures"
"""Its earlier name; images there are removed when such a report is replaced."""
_MADE_OF = "report.json"
_IMAGE = re.compile(r"[0-9a-f]{20}_[a-z_]+\.(?:jpg|js)")


def check_report_folder(
    folder: Path, inputs: Sequence[Path], *, made_of: Mapping[str, Any] | None, overwrite: bool
) -> None:
    """Raises OutputError for a folder that a report must not be written to.

    It must not hold inputs or lie in one. It must be empty, or an earlier report of the same.

    Args:
        folder: The report's folder.
        inputs: Files and folders that are read.
        made_of: What the report is of, as given to `begin_report`; None for anything.
        overwrite: Whether any other content may be replaced.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; name a folder for the report")
    resolved = folder.resolve()
    for source in inputs:
        read = source.resolve()
        if resolved.is_relative_to(read):
            raise OutputError(f"{folder} lies in {source}, which is read; name another folder")
        if read.is_relative_to(resolved):
            raise OutputError(f"{folder} holds {source}, which is read; name another folder")
    try:
        empty = not folder.exists() or next(folder.iterdir(), None) is None
    except OSError as error:
        raise cannot_write(folder, error) from error
    if not (empty or overwrite or _is_of(folder, made_of)):
        raise OutputError(
            f"{folder} is not empty; --overwrite replaces the report in it, or name another folder"
        )


def begin_report(folder: Path, made_of: Mapping[str, Any]) -> Path:
    """Creates the report's folder and returns its folder for images.

    Args:
        folder: The report's folder.
        made_of: What the report is of, by which a later run recognises it.

    Raises:
        OutputError: The folder cannot be written to.
    """
    images = folder / IMAGES
    make_folder(images)
    write_json(folder / _MADE_OF, made_of)
    return images


@contextmanager
def whole_report(folder: Path) -> Iterator[Path]:
    """Yields a folder for a report that replaces the one in `folder`; if it fails, that one stays.

    Raises:
        OutputError: The folder cannot be written to.
    """
    remove_report_leftovers(folder)
    with atomic_folder(folder) as temporary:
        yield temporary
        images = {path.name for path in (temporary / IMAGES).iterdir()}
        viewer = (temporary / VIEWER).exists()
    if not viewer:
        _remove_viewer(folder)
    _remove_images(folder / IMAGES, lambda name: name not in images)
    _remove_old_images(folder)


def remove_report_leftovers(folder: Path) -> int:
    """Removes what killed writers left and returns how many there were.

    To be called only while nobody writes to the report.
    """
    folders = (folder, folder / IMAGES, folder / _OLD_IMAGES)
    try:
        return sum(remove_leftovers(each) for each in folders if each.is_dir())
    except OSError as error:
        raise cannot_write(folder, error) from error


def image_key(*parts: str) -> str:
    """Returns the start of a frame's image names: fit for a file, and different for other parts."""
    text = "\0".join(parts)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:20]


def write_report(
    folder: Path,
    head: Mapping[str, Any],
    frames: Iterable[Mapping[str, Any]],
    *,
    viewer: bool = False,
) -> int:
    """Writes the page, removes images of frames that it does not have, and returns its size.

    Args:
        folder: The report's folder.
        head: What report_page.js shows of all frames.
        frames: A mapping per frame, taken one by one; its `key` is that of its images, or None.
        viewer: Whether frames have 3D views, so that the page may run scripts of its folder.

    Returns:
        Bytes of the page.

    Raises:
        OutputError: The page cannot be written.
    """
    keys: set[str] = set()
    start, end = _page(viewer=viewer).split("@DATA@")
    page = folder / PAGE
    with (
        atomic_path(page) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.write(start)
        file.write(_embedded(head).removesuffix("}") + ',"frames":[')
        for number, frame in enumerate(frames):
            file.write((",\n" if number else "\n") + _embedded(frame))
            keys.add(frame["key"])
        file.write("\n]}")
        file.write(end)
    if viewer:
        save_viewer(folder)
    else:
        _remove_viewer(folder)
    _remove_images(folder / IMAGES, lambda name: name.partition("_")[0] not in keys)
    _remove_old_images(folder)
    return page.stat().st_size


def _remove_viewer(folder: Path) -> None:
    try:
        (folder / VIEWER).unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def _remove_old_images(folder: Path) -> None:
    """Removes images of an earlier version's report, and their folder if it is then empty."""
    old = folder / _OLD_IMAGES
    if old.is_dir():
        _remove_images(old, lambda name: True)
        with suppress(OSError):
            old.rmdir()  # fails where files of others are in it


def _remove_images(images: Path, unused: Callable[[str], bool]) -> None:
    """Removes images of a report, and no other file, by their names."""
    try:
        for path in images.iterdir():
            if _IMAGE.fullmatch(path.name) and unused(path.name):
                path.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(images, error) from error


def _is_of(folder: Path, made_of: Mapping[str, Any] | None) -> bool:
    try:
        return made_of is not None and read_json(folder / _MADE_OF) == plain(made_of)
    except (InputError, FileFormatError):
        return False


def _page(*, viewer: bool) -> str:
    """The page with style and script in it; its policy allows no request beyond its folder.

    It allows no other script either, but for a report with 3D views those beside it.
    """
    html, style, script = (_template(kind) for kind in ("html", "css", "js"))
    policy = (
        f"default-src 'none'; img-src 'self' file: data:; style-src {_digest(style)};"
        f" script-src {_digest(script)}{' file:' if viewer else ''}"
    )
    parts = {"@POLICY@": policy, "@STYLE@": style, "@SCRIPT@": script}
    for mark, text in parts.items():
        html = html.replace(mark, text)
    return html


def _template(kind: str) -> str:
    return files(__package__).joinpath(f"report_page.{kind}").read_text(encoding="utf-8")


def _digest(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _embedded(mapping: Mapping[str, Any]) -> str:
    """JSON in ASCII that an HTML page can hold: frame names are untrusted text."""
    text = json.dumps(plain(mapping), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
