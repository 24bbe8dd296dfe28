"""YAML from untrusted files: plain values only, no tags, no aliases, bounded in size."""

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

_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}
_MOST_DIGITS = 15
"""Of a whole number; longer ones become floats."""


def parse_yaml(path: Path, text: str) -> Any:
    """Returns the content of a YAML or JSON text, of several documents the first.

    Tags are ignored, so that OpenCV's matrices are mappings with rows, cols and data. Its own
    cv2.FileStorage is not used, because it aborts the process on damaged files.

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
        """BaseLoader, whose values are texts, with numbers and without aliases.

        Aliases can make a small file large, and the constructors of tags raise many kinds of error.
        """

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("it has an alias (*name), which is not allowed here")
            return super().compose_node(parent, index)

        def construct_scalar(self, node: Any) -> Any:
            value = super().construct_scalar(node)
            return value if node.style else _plain_value(value)

    try:
        return next(yaml.load_all(_OPENCV_HEADER.sub("", text), Loader), None)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = one_line(error)
        raise FileFormatError(f"{path} is not valid YAML ({reason}); correct it") from error


def _plain_value(text: str) -> Any:
    """The value of a text without quotes."""
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    match = _NUMBER.fullmatch(text)
    if match is None:
        return text
    whole = match[2] is None and match[3] is None and text.lstrip("+-").isdecimal()
    return int(text) if whole and len(text) <= _MOST_DIGITS else float(text)
