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
from pnpdepth_cli.io.colours import LOGARITHMIC_FROM, DepthScale, signed_bar
from pnpdepth_cli.io.file_bytes import plain, read_json, write_json
from pnpdepth_cli.version import __version__

PAGE = "index.html"
IMAGES = "images"
VIEWER = "viewer.js"
_MADE_OF = "report.json"
"""Name of the file that says what a report was made of, by which it is known."""
_MAP_COLOURS = 9  # between which a browser interpolates the bar of gains
_DEPTH_COLOURS = 17  # and that of depth
_SMALLEST_MB = 0.1  # size of a view, as it is shown
_INVISIBLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def check_report_folder(folder: Path, made_of: Mapping[str, object], *, overwrite: bool) -> None:
    """Raises OutputError if a new report would replace something else than an earlier one.

    A folder may be absent or empty, or hold an earlier report of the same sources.

    Args:
        folder: The report's folder, which need not exist.
        made_of: Sources of the report, as `write_report` takes them.
        overwrite: Whether a report of other sources may be replaced, too.
    """
    nearest_path = next((path for path in (folder, *folder.parents) if path.exists()), folder)
    if nearest_path.is_file():
        raise OutputError(f"{nearest_path} is a file; name a folder for the report")
    try:
        names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    except OSError as error:
        raise cannot_write(folder, error) from error
    if not names:
        return
    # The sources of the report in the folder; without a readable file of them, it is no report.
    earlier = None
    with suppress(InputError):
        earlier = read_json(folder / _MADE_OF)
    is_same = earlier == plain(made_of)
    is_report = earlier is not None and names <= {PAGE, IMAGES, VIEWER, _MADE_OF}
    if not is_report or not (is_same or overwrite):
        raise OutputError(f"{folder} is not empty; name another folder, or --overwrite a report")


def visible(text: str) -> str:
    r"""Returns the text with invisible characters, such as a new line in a name, as \\uXXXX."""
    return _INVISIBLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def _visible_if_text(value: object) -> object:
    """What a template shows of a value: a text with visible characters, anything else as it is.

    Markup, which is a kind of text, is this program's own.
    """
    return visible(value) if type(value) is str else value


_TEMPLATES = jinja2.Environment(
    autoescape=True,
    loader=jinja2.PackageLoader("pnpdepth_cli.io"),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    finalize=_visible_if_text,
)
"""Templates whose values are escaped: names of frames and files are untrusted text."""
_TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}


def write_report(
    folder: Path,
    made_of: Mapping[str, object],
    page: Mapping[str, object],
    data: Mapping[str, object],
    frames: Callable[[Path], Iterable[Mapping[str, object]]],
    *,
    viewer: bool = False,
) -> None:
    """Writes a report as a folder. An earlier one is replaced, and stays if writing fails.

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

    Raises:
        OutputError: The folder cannot be written.
    """
    # The colours of maps and of depth, for the legends.
    depth_bar = DepthScale(low_m=1, high_m=2).paint(np.linspace(1, 2, _DEPTH_COLOURS))
    data = {
        **data,
        "map_colours": [f"#{bytes(colour).hex()}" for colour in signed_bar("gain", _MAP_COLOURS)],
        "depth_colours": [f"#{bytes(colour).hex()}" for colour in depth_bar],
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
    """Makes the new file `target` a hard link to `source`, or a copy where no link is possible."""
    try:
        os.link(source, target)
    except OSError:  # another disk, or one without links; of anything else the copy fails, too
        shutil.copy2(source, target)


def save_view_3d(source: Path, target: Path) -> float:
    """Writes a frame's 3D view as a script, which a page opened from disk can load.

    Args:
        source: The view, a JSON file.
        target: The script.

    Returns:
        Size of the script in MB, rounded to 0.1 and at least that.

    Raises:
        InputError: The view cannot be read.
    """
    text = json.dumps(read_json(source), allow_nan=False, separators=(",", ":"))
    target.write_text(f"pnpdepthView({text});\n", encoding="utf-8", newline="\n")
    return max(_SMALLEST_MB, round(target.stat().st_size / 1e6, 1))


def _source(name: str) -> str:
    """The content of a text file of the package, by its path below the folder of templates."""
    return files(__package__).joinpath("templates", name).read_text(encoding="utf-8")


def _policy(style: str, script: str, *, viewer: bool) -> Markup:
    """The content security policy of a report: no request leaves its folder.

    Args:
        style: The page's own style, the only one that is allowed.
        script: The page's own script, the only one that is allowed without a viewer.
        viewer: Whether scripts of files are allowed too.
    """
    scripts = f"'sha256-{_digest_of(script)}'"
    if viewer:
        scripts += " file:"
    return Markup(
        f"default-src 'none'; img-src 'self' file: data:; style-src 'sha256-{_digest_of(style)}';"
        f" script-src {scripts}"
    )


def _digest_of(text: str) -> str:
    """The SHA-256 of a text in base 64, by which a policy allows it."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
