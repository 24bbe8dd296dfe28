"""JSON that is written whole and read strictly, YAML that is not trusted, rows of numbers, CSV."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import numbered_lines, one_line, read_bytes

_LONGEST_YAML = 1 << 17
"""Characters, parsed in 2 s at most; a calibration has a few thousand, a bag a line per topic."""

_OPENCV_HEADER = re.compile(r"\A\s*%YAML:1\.\d\s*$", re.MULTILINE)
"""OpenCV's first line, which YAML itself does not allow."""

PIXELS = ["x", "y", "depth"]
_HEADERS = (PIXELS, ["x", "y", "z"])
_SEPARATOR = re.compile(r"[\s,;]+")


def write_json(path: Path, mapping: Mapping[str, object]) -> None:
    """Writes the mapping as indented JSON in its own order; NaN and infinity become null."""
    text = json.dumps(plain(mapping), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        # A file name that is not UTF-8 has surrogates, which JSON spells as \udcff.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


def read_json(path: Path) -> dict[str, Any]:
    """Returns the object in a JSON file.

    Raises:
        InputError: The file cannot be read, or holds anything else.
    """
    data = read_bytes(path)
    try:
        content = parse_json(data)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path} is not valid JSON ({one_line(error)})") from error
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} holds no JSON object at its top level; create it again")
    return content


def plain(value: object) -> Any:
    """Returns the value in JSON's own types; NaN and infinity become None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


def parse_json(data: bytes) -> Any:
    """Returns the content of a JSON text. Raises ValueError or RecursionError if it is none.

    NaN, infinity and numbers that are too large to be finite are no JSON numbers.
    """
    text = data.decode("utf-8-sig")
    return json.loads(text, parse_constant=_finite, parse_float=_finite, parse_int=_whole)


def _whole(text: str) -> int:
    _finite(text)
    return int(text)


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is not a JSON number")
    return number


def parse_yaml(path: Path, text: str) -> object:
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
    if len(text) > _LONGEST_YAML:
        raise FileFormatError(f"{path} has {len(text):,} characters, more than {_LONGEST_YAML:,}")

    class Loader(yaml.BaseLoader):  # type: ignore[misc]
        """BaseLoader without aliases, which can make a small file large."""

        def compose_node(self, parent: object, index: object) -> object:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("it has an alias (*name), which is not allowed here")
            return super().compose_node(parent, index)

    try:
        return next(yaml.load_all(_OPENCV_HEADER.sub("", text), Loader), None)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise FileFormatError(f"{path} is not valid YAML ({one_line(error)})") from error


def read_rows(path: Path, data: bytes) -> tuple[NDArray[np.float64], list[str]]:
    """Returns the numbers (N, 3 or more) of lines of text, and the words of a header, if any.

    A first line that begins with x y depth or x y z is a header; "#" begins a comment.

    Raises:
        FileFormatError: A line is not made of as many numbers as the first.
    """
    rows: list[list[float]] = []
    header: list[str] = []
    for number, text in numbered_lines(data):
        words = _SEPARATOR.split(text)
        names = [word.strip('"').lower() for word in words]
        if not rows and not header and names[:3] in _HEADERS:
            header = names
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        # Every row has as many numbers as the first.
        count = len(rows[0]) if rows else max(3, len(row))
        if len(row) != count:
            shown = one_line(text)[:60]
            raise FileFormatError(f"{path}, line {number}: {shown!r} is not {count} numbers")
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else 3), header


def write_csv(file: TextIO, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Writes RFC 4180 with lines that end in \\n, None as nothing."""
    csv.writer(file, lineterminator="\n").writerows([header, *rows])
