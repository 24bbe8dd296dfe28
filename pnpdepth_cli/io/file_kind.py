"""What kind of file it is, by content alone."""

from __future__ import annotations

from pnpdepth_cli.io.formats import format_of_content


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
