"""Run records: JSON written whole, read strictly, and the digests that go into it."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.opening import one_line, read_bytes


def write_json(path: Path, mapping: Mapping[str, Any]) -> None:
    """`path` holds the mapping as indented JSON in its own order; NaN and infinity are null."""
    text = json.dumps(_plain(mapping), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises FileFormatError for anything else."""
    data = read_bytes(path)
    try:
        content = json.loads(data.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{path} is not valid JSON ({one_line(error)}); create it again"
        ) from error
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} holds no JSON object at its top level; create it again")
    return content


def sha256_of(path: Path) -> str:
    """The SHA-256 of the file's content, 64 hexadecimal digits."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{path} cannot be read ({reason}); check the path") from error
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")
