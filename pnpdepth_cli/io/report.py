"""A report as a folder: one page that opens from disk, and its images beside it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup

from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.atomic import atomic_folder, cannot_write
from pnpdepth_cli.io.file_bytes import plain, read_json, write_json
from pnpdepth_cli.io.visualisation import LOGARITHMIC_FROM, DepthScale, signed_bar
from pnpdepth_cli.version import __version__

PAGE = "index.html"
IMAGES = "images"
VIEWER = "viewer.js"
_MADE_OF = "report.json"
_TEMPLATES = jinja2.Environment(
    autoescape=True,
    loader=jinja2.PackageLoader("pnpdepth_cli.io"),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    finalize=lambda value: visible(value) if type(value) is str else value,
)
"""Templates whose values are escaped: names of frames and files are untrusted text."""
_TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
_INVISIBLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def check_report_folder(folder: Path, made_of: Mapping[str, object], *, overwrite: bool) -> None:
    """Raises OutputError for a folder that holds anything but this report.

    Args:
        folder: The report's folder.
        made_of: Sources of an earlier report in it, as given to `write_report`.
        overwrite: Whether another report may be replaced.
    """
    there = next((path for path in (folder, *folder.parents) if path.exists()), folder)
    if there.is_file():
        raise OutputError(f"{there} is a file; name a folder for the report")
    try:
        names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    except OSError as error:
        raise cannot_write(folder, error) from error
    before = None
    with suppress(InputError):
        before = read_json(folder / _MADE_OF)
    known = before is not None and (overwrite or before == plain(made_of))
    if names and not (known and names <= {PAGE, IMAGES, VIEWER, _MADE_OF}):
        raise OutputError(f"{folder} is not empty; name another folder, or --overwrite a report")


def visible(text: str) -> str:
    r"""Returns the text with invisible characters, such as a new line in a name, as \\uXXXX."""
    return _INVISIBLE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def write_report(
    folder: Path,
    made_of: Mapping[str, object],
    page: Mapping[str, object],
    data: Mapping[str, object],
    frames: Callable[[Path], Iterable[Mapping[str, object]]],
    *,
    viewer: bool = False,
) -> None:
    """Writes a report that replaces the one in `folder`, which stays if it fails.

    Args:
        folder: The report's folder.
        made_of: Sources of the report, by which it is known later.
        page: What report.html shows of all frames: `title`, `facts` and `notes`; `tables` with
            title, headings and texts; `without`, the names of frames not refined, and why.
        data: What report.js needs of all frames: `columns`, the measures of a frame's values;
            `sort_by`, the number of the column that comes first; `signed`, the keys of those whose
            values below 0 are better; `unit`.
        frames: Function of the folder for images that gives a mapping per frame, one by one, as
            report.js shows it. Its `key` is that of its images, or None.
        viewer: Whether frames have 3D views, so that the page may run scripts of its folder.
    """
    turbo = DepthScale(low_m=1, high_m=2).paint(np.linspace(1, 2, 17))
    data = {
        **data,
        "map_colours": [f"#{bytes(colour).hex()}" for colour in signed_bar("gain", 9)],
        "depth_colours": [f"#{bytes(colour).hex()}" for colour in turbo],
        "logarithmic_from": LOGARITHMIC_FROM,
    }
    style, script = (_source(f"report.{kind}") for kind in ("css", "js"))
    with atomic_folder(folder) as temporary:
        images = temporary / IMAGES
        images.mkdir()
        write_json(temporary / _MADE_OF, made_of)
        # The page, frame by frame.
        parts = _TEMPLATES.get_template("report.html").generate(
            page, data=plain(data), frames=map(plain, frames(images)), style=Markup(style),
            script=Markup(script), policy=_policy(style, script, viewer=viewer),
            version=__version__,
        )  # fmt: skip
        with (temporary / PAGE).open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(parts)
        if viewer:
            scripts = _source("../three/three.min.js") + "\n" + _source(VIEWER)
            (temporary / VIEWER).write_text(scripts, encoding="utf-8", newline="\n")


def link_image(source: Path, target: Path) -> None:
    """Makes the new file `target` the same as `source`, or a copy of it on another disk."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def save_view_3d(source: Path, target: Path) -> float:
    """Writes a frame's 3D view as a script, which a page opened from disk can load.

    Returns:
        Its size in MB, rounded to 0.1 and at least that.
    """
    text = json.dumps(read_json(source), allow_nan=False, separators=(",", ":"))
    target.write_text(f"pnpdepthView({text});\n", encoding="utf-8", newline="\n")
    return max(0.1, round(target.stat().st_size / 1e6, 1))


def _source(name: str) -> str:
    return files(__package__).joinpath("templates", name).read_text(encoding="utf-8")


def _policy(style: str, script: str, *, viewer: bool) -> Markup:
    """Lets no request leave the folder, and runs its own script; for a viewer, those beside it."""
    return Markup(
        f"default-src 'none'; img-src 'self' file: data:; style-src 'sha256-{_digest_of(style)}';"
        f" script-src 'sha256-{_digest_of(script)}'{' file:' if viewer else ''}"
    )


def _digest_of(text: str) -> str:
    """The SHA-256 of a text in base 64, by which a policy allows it."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
