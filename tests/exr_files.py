"""Writes OpenEXR files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR


def write_exr(path: Path, channels: dict[str, np.ndarray], **header: object) -> None:
    """Writes a file with these channels; `header` adds or replaces attributes."""
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(attributes, {k: OpenEXR.Channel(v) for k, v in channels.items()}) as file:
        file.write(str(path))
