"""The depth file formats, listed in `choices.FORMATS`.

A new format is one more `DepthFormat` in `TABLE`, with its name in `choices.FORMATS`, or an entry
point of the group `pnpdepth.formats`.
"""

from __future__ import annotations

from pnpdepth_cli.choices import FORMATS
from pnpdepth_cli.io.formats import array_files, images
from pnpdepth_cli.io.formats.depth_format import KITTI_SCALE as KITTI_SCALE
from pnpdepth_cli.io.formats.depth_format import LARGEST_CODE as LARGEST_CODE
from pnpdepth_cli.io.formats.depth_format import SATURATED_CODE as SATURATED_CODE
from pnpdepth_cli.io.formats.depth_format import SCALE_KEY as SCALE_KEY
from pnpdepth_cli.io.formats.depth_format import DepthFile as DepthFile
from pnpdepth_cli.io.formats.depth_format import DepthFormat as DepthFormat
from pnpdepth_cli.io.formats.depth_format import Reading as Reading
from pnpdepth_cli.io.formats.depth_format import check_scale as check_scale
from pnpdepth_cli.io.formats.depth_format import eight_bits as eight_bits

TABLE: dict[str, DepthFormat] = {
    "png": images.PNG,
    "exr": images.EXR,
    "npy": array_files.NPY,
    "npz": array_files.NPZ,
    "pfm": array_files.PFM,
    "tiff": images.TIFF,
}
"""The formats of this package by name."""


def format_of_content(data: bytes) -> DepthFormat | None:
    """The format whose magic the content begins with; None for another kind of file."""
    return next((kind for kind in FORMATS.values() if data.startswith(kind.magic)), None)


def format_of_suffix(suffix: str) -> DepthFormat | None:
    """The format that is written for a suffix in any case; None for an unknown one."""
    return next((kind for kind in FORMATS.values() if suffix.lower() in kind.suffixes), None)


def kind_of(data: bytes) -> str | None:
    """Returns "PNG", "JPEG", "TIFF", "WEBP" or the name of another depth format; None if unknown.

    Args:
        data: Content of the file, or at least its first 16 bytes.
    """
    if data.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WEBP"
    depth_format = format_of_content(data)
    return None if depth_format is None else depth_format.name


DEPTH_SUFFIXES: tuple[str, ...] = tuple(s for kind in FORMATS.values() for s in kind.suffixes)
"""The suffixes that depth can be written to; PNG holds integer codes, the others float32 metres."""
