"""Files as bytes and their digest, as text, JSON, YAML and rows of numbers, within the budget.

The budget is that of `pnpdepth_cli.budget`. JSON is written whole.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import budget
from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path

_LONGEST_TEXT = 1 << 20  # bytes of a calibration or a pose; one has a few thousand
_LONGEST_YAML = 1 << 17
"""Characters, parsed in 2 s at most; a calibration has a few thousand, a bag a line per topic."""

_OPENCV_HEADER = re.compile(r"\A\s*%YAML:1\.\d\s*$", re.MULTILINE)
"""OpenCV's first line, which YAML itself does not allow."""

PIXELS = ["x", "y", "depth"]
"""Header of a list of points of an image."""
_HEADERS = (PIXELS, ["x", "y", "z"])
_WORD = re.compile(r"[^\s,;]+")
_UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")
_LONGEST_LINE = 160  # characters of a text that is shown in a message
_BLOCK_BYTES = 1 << 20  # of a file, read at once
_SMALLER = "make it smaller, or allow more with --max-pixels"


def read_bytes(path: Path) -> bytes:
    """Returns the whole content of a regular file.

    Raises:
        InputError: There is no such file; it is a folder, a device or a pipe; or it is empty, or
            larger than the budget.
    """
    size = size_of_regular_file(path)
    limit = budget.max_file_bytes()
    check_claim(f"{path} has {size:,} bytes", size, limit, way_out=_SMALLER)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise cannot_read(path, error) from error
    return data


def decode_text(data: bytes) -> str:
    """Returns a text of UTF-8, of UTF-16 with its mark, or else of Windows' cp1252.

    Raises:
        UnicodeDecodeError: The bytes are no text.
    """
    if data.startswith(_UTF_16_MARKS):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        if b"\0" in data:  # cp1252 would take it, but no text has this character
            raise
        return data.decode("cp1252")


def numbered_lines(data: bytes) -> Iterator[tuple[int, str]]:
    """Yields number from 1 and content of each line of a text that is not empty.

    The content has no comment, which begins with #, and no space at its ends.

    Args:
        data: Text as UTF-8, or as UTF-16 with its mark; anything else becomes a replacement
            character.
    """
    encoding = "utf-16" if data.startswith(_UTF_16_MARKS) else "utf-8-sig"
    for number, line in enumerate(data.decode(encoding, "replace").splitlines(), 1):
        content = line.partition("#")[0].strip()
        if content:
            yield number, content


def read_text(path: Path) -> str:
    """Returns the content of a short text file, such as a calibration or a pose.

    Raises:
        InputError: The file cannot be read, is larger than any such file, or is no text.
    """
    size = size_of_regular_file(path)
    check_claim(f"{path} has {size:,} bytes", size, _LONGEST_TEXT, way_out="give another file")
    try:
        return decode_text(read_bytes(path))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file; give another") from error


def size_of_regular_file(path: Path) -> int:
    """Returns the size of a file in bytes.

    Raises:
        InputError: There is no such file; it is a folder, a device or a pipe; or it is empty.
    """
    status = _status(path)
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path} is a folder; give one file")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is a device or a pipe; save its content to a file first")
    if not status.st_size:  # also of what /proc shows as files, some of which never end
        raise InputError(f"{path} is empty (0 bytes); copy or create it again")
    return status.st_size


def _status(path: Path) -> os.stat_result:
    """Size, kind and times of a file. InputError if it is not there or cannot be reached."""
    try:
        return path.stat()
    except (OSError, ValueError) as error:  # a path with a null character is a ValueError
        raise cannot_read(path, error) from error


def cannot_read(path: Path, error: OSError | ValueError) -> InputError:
    """Returns the error that says why a file cannot be read."""
    if isinstance(error, (FileNotFoundError, NotADirectoryError)):
        return InputError(f"{path}: no such file; check the path")
    reason = one_line(getattr(error, "strerror", None) or error).lower()
    return InputError(f"{one_line(path)} cannot be read ({reason}); check the path")


def damaged(path: Path, kind: str, fact: str) -> InputError:
    """Returns the error for a file that ends early or is corrupt.

    Args:
        path: The file.
        kind: Name of its format.
        fact: What is wrong, as the rest of a sentence that begins with the kind.
    """
    return InputError(f"{path}: {kind} {one_line(fact)}; copy or create the file again")


def one_line(text: object) -> str:
    """Returns the text with runs of white space made single spaces, cut to a readable length."""
    line = " ".join(str(text).split())
    return line if len(line) <= _LONGEST_LINE else line[: _LONGEST_LINE - 1] + "…"


def check_pixel_count(
    path: Path, width: int, height: int, *, pixel_bytes: int = 1, file_bytes: int | None = None
) -> None:
    """Raises InputError for an image without pixels, or with more than the budget allows.

    It is called with what a file's header claims, before the pixels are decoded.

    Args:
        path: The file.
        width: Width in pixels.
        height: Height in pixels.
        pixel_bytes: Bytes of a decoded pixel.
        file_bytes: Size of the file, for a compressed format, in which few bytes may claim any
            number of pixels. None: it is not checked.
    """
    if width < 1 or height < 1:
        raise InputError(f"{path} has no pixels ({width}x{height}); create it again")
    count = width * height
    check_value_count(path, count, value_bytes=pixel_bytes)
    if file_bytes is not None:
        claim = f"{path} claims {width}x{height} pixels in {file_bytes:,} bytes"
        check_claim(claim, count, budget.max_values_from(file_bytes), way_out="create it again")


def check_value_count(path: Path, count: int, *, value_bytes: int = 1) -> None:
    """Raises InputError for an array of more values, or of more bytes, than the budget allows.

    Args:
        path: The file.
        count: Number of values.
        value_bytes: Bytes of a decoded value.
    """
    check_claim(f"{path} has {count:,} values", count, budget.max_pixels(), way_out=_SMALLER)
    decoded = count * value_bytes
    claim = f"{path} has {count:,} values of {decoded:,} bytes"
    check_claim(claim, decoded, budget.max_image_bytes(), way_out=_SMALLER)


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """Size in bytes, times and digest of a file when it was read."""

    size: int
    sha256: str
    mtime_ns: int  # when the content was changed last, as programs may set it
    ctime_ns: int  # when content or properties were changed last, which programs cannot set


def fingerprint(path: Path) -> Fingerprint:
    """Returns size, times and SHA-256 of a file. Raises InputError if it cannot be read."""
    status = _status(path)
    sha256 = _digest(path, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
    return Fingerprint(
        size=status.st_size,
        sha256=sha256,
        mtime_ns=status.st_mtime_ns,
        ctime_ns=status.st_ctime_ns,
    )


def is_unchanged(path: Path, earlier: Fingerprint) -> bool:
    """Returns whether the file still has the content that it had at an earlier time.

    Equal size and times are taken as equal content. Otherwise the content is read.

    Args:
        path: The file; if it cannot be read, the answer is false.
        earlier: Its fingerprint at that time.
    """
    try:
        status = _status(path)
        times = status.st_mtime_ns, status.st_ctime_ns
        if status.st_size == earlier.size and times == (earlier.mtime_ns, earlier.ctime_ns):
            return True
        return fingerprint(path).sha256 == earlier.sha256
    except InputError:
        return False


# Several frames may share one file: a calibration, a list, or a video.
@functools.lru_cache(maxsize=64)
def _digest(path: Path, size: int, mtime_ns: int, ctime_ns: int) -> str:
    """The SHA-256 of a file, computed again only if its size or a time differs."""
    return sha256_of(path)


def sha256_of(path: Path) -> str:
    """Returns the SHA-256 of the file's content, 64 hexadecimal digits.

    That of a folder is over the names and digests of its files, in the order of the names;
    subfolders do not count.

    Raises:
        InputError: The file cannot be read, is empty, or is a device or a pipe.
    """
    digest = hashlib.sha256()
    # A folder, in which a file may be empty.
    if path.is_dir():
        for file_inside in sorted(path.iterdir()):
            if file_inside.is_file():
                is_empty = file_inside.stat().st_size == 0
                content = hashlib.sha256().hexdigest() if is_empty else sha256_of(file_inside)
                digest.update(f"{file_inside.name} {content}\n".encode())
        return digest.hexdigest()
    # A file.
    size_of_regular_file(path)
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise cannot_read(path, error) from error
    return digest.hexdigest()


def write_json(path: Path, mapping: Mapping[str, object]) -> None:
    """Writes the mapping as indented JSON in its own order; NaN and infinity become null."""
    text = json.dumps(plain(mapping), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        # A file name that is not UTF-8 has surrogates, which JSON spells as \udcff.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


def read_json(path: Path) -> dict[str, Any]:
    """Returns the object at the top level of a JSON file.

    Raises:
        InputError: The file cannot be read, is not valid JSON, or has something else at its top
            level. NaN, infinity, and numbers that are too large to be finite are not valid.
    """
    data = read_bytes(path)
    try:
        text = data.decode("utf-8-sig")
        content = json.loads(text, parse_constant=_finite, parse_float=_finite, parse_int=_finite)
    except (ValueError, RecursionError) as error:  # invalid text, or nested too deeply
        raise InputError(
            f"{path} is not valid JSON ({one_line(error)}); correct it, or write it again"
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no JSON object at its top level; create it again")
    return content


def plain(value: object) -> Any:
    """Returns the value in JSON's own types; NaN and infinity become None.

    Dataclasses become mappings, tuples and arrays lists, and paths texts.
    """
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


def _finite(text: str) -> float:
    """The number that a text in JSON is, an int if it is written as one.

    Raises:
        ValueError: The number is not finite.
    """
    if not math.isfinite(float(text)):
        raise ValueError(f"{text[:20]} is not a JSON number")
    return int(text) if text.lstrip("-").isdecimal() else float(text)


def parse_yaml(path: Path, text: str) -> object:
    """Returns the content of a YAML or JSON text, of several documents the first.

    It is None, a text, or a list or mapping of such: numbers stay texts. Tags are ignored, so that
    OpenCV's matrices are mappings with rows, cols and data. OpenCV's own cv2.FileStorage is not
    used, because it aborts the process on damaged files.

    Args:
        path: The file that the text is from, for messages.
        text: The text.

    Raises:
        InputError: The text is too long, has aliases, or is not YAML.
        UsageError: PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError:
        raise UsageError(f"reading {path} needs PyYAML: pip install 'pnpdepth[ros]'") from None
    if len(text) > _LONGEST_YAML:
        raise InputError(
            f"{path} has {len(text):,} characters, more than {_LONGEST_YAML:,}; keep what is needed"
        )
    text = _OPENCV_HEADER.sub("", text)
    try:
        # An alias repeats a part of the document, so a small file can become a large one.
        for event in yaml.parse(text, yaml.BaseLoader):
            if isinstance(event, yaml.AliasEvent):
                raise yaml.YAMLError("it has an alias (*name), which is not allowed here")
            if isinstance(event, yaml.DocumentEndEvent):
                break
        return next(yaml.load_all(text, yaml.BaseLoader), None)
    # PyYAML's own errors, and Python's for what it does not check: odd keys and deep nesting.
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} is not valid YAML ({one_line(error)}); correct it, or write it again"
        ) from error


def read_rows(
    path: Path, data: bytes, names: Sequence[str] = ()
) -> tuple[NDArray[np.float64], list[str]]:
    """Returns the rows of numbers in a text, (N, 3 or more), and the words of its header.

    The header is the first line, if that begins with x y depth or x y z, or has all of the names.
    Its words are in lower case; there are none without a header. "#" begins a comment. Numbers are
    separated by spaces, commas or semicolons.

    Args:
        path: The file that the text is from, for messages.
        data: Content of the file.
        names: Names of columns by which a header is known.

    Raises:
        InputError: A line is not made of as many numbers as the first.
    """
    # The header.
    lines = list(numbered_lines(data))
    header: list[str] = []
    if lines:
        _, first_line = lines[0]
        words = [word.strip('"').lower() for word in _WORD.findall(first_line)]
        has_names = len(names) > 0 and set(names) <= set(words)
        if words[:3] in _HEADERS or has_names:
            header = words
            lines = lines[1:]
    # All other lines are numbers, as many as in the first of them.
    rows: list[list[float]] = []
    for number, text in lines:
        words = _WORD.findall(text)
        count = len(rows[0]) if rows else max(3, len(words))
        if ";" in text and "," in text:
            raise InputError(
                f"{path}, line {number}: {text[:80]!r} has decimal commas; write points"
            )
        try:
            numbers = [float(word) for word in words]
        except ValueError:  # a word is no number, which is refused below
            numbers = []
        if len(numbers) != count and (rows or header):
            raise InputError(
                f"{path}, line {number}: {' '.join(words)[:80]!r} is not {count} numbers; correct"
                " it, or take it out"
            )
        if len(numbers) != count:
            raise InputError(
                f"{path}, line {number}: {' '.join(words)[:80]!r} is not {count} numbers, nor the"
                " header x y depth or x y z"
            )
        rows.append(numbers)
    return np.array(rows or np.empty((0, 3)), np.float64), header
