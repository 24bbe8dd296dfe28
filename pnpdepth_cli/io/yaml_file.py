"""YAML from untrusted files: plain texts only, no tags, no aliases, bounded in size."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.file_bytes import one_line

_LONGEST = 1 << 17
"""Characters, parsed in 2 s at most; a calibration has a few thousand, a bag a line per topic."""

_OPENCV_HEADER = re.compile(r"\A\s*%YAML:1\.\d\s*$", re.MULTILINE)
"""OpenCV's first line, which YAML itself does not allow."""


def parse_yaml(path: Path, text: str) -> Any:
    """Returns the content of a YAML or JSON text, of several documents the first.

    Values are texts, also those of numbers. Tags are ignored, so that OpenCV's matrices are
    mappings with rows, cols and data. Its own cv2.FileStorage is not used, because it aborts the
    process on damaged files.

    Raises:
        FileFormatError: The text is too long, has aliases, or is not YAML.
        UsageError: PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError:
        raise UsageError(f"reading {path} needs PyYAML: pip install 'pnpdepth[ros]'") from None
    if len(text) > _LONGEST:
        raise FileFormatError(
            f"{path} has {len(text):,} characters, more than a calibration ({_LONGEST:,}); give"
            " another file"
        )

    class Loader(yaml.BaseLoader):  # type: ignore[misc]
        """BaseLoader without aliases, which can make a small file large."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("it has an alias (*name), which is not allowed here")
            return super().compose_node(parent, index)

    try:
        return next(yaml.load_all(_OPENCV_HEADER.sub("", text), Loader), None)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = one_line(error)
        raise FileFormatError(f"{path} is not valid YAML ({reason}); correct it") from error
