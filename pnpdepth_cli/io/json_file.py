"""Run records: JSON that is written whole and read strictly, and the digests in it."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import cannot_read, one_line, read_bytes, size_of_regular_file


def write_json(path: Path, mapping: Mapping[str, Any]) -> None:
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
        raise FileFormatError(
            f"{path} is not valid JSON ({one_line(error)}); create it again"
        ) from error
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} holds no JSON object at its top level; create it again")
    return content


def sha256_of(path: Path) -> str:
    """Returns the SHA-256 of the file's content, 64 hexadecimal digits.

    Of a folder, that of its files' names and digests, in the order of the names.

    Raises:
        InputError: The file cannot be read, or is a device or a pipe.
    """
    digest = hashlib.sha256()
    if path.is_dir():
        for inside in sorted(path.iterdir()):
            if inside.is_file():
                digest.update(f"{inside.name} {sha256_of(inside)}\n".encode())
        return digest.hexdigest()
    size_of_regular_file(path)
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise cannot_read(path, error) from error
    return digest.hexdigest()


def plain(value: Any) -> Any:
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
