"""Damages a file's bytes as transfers, wrong tools and attackers do."""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

INTEGERS = (0, 1, -1, 2**7, 2**15 - 1, 2**16, 2**31 - 1, -(2**31), 2**32 - 1, 2**62)
"""Sizes that readers often do not expect."""

WORDS = (
    *("", "nan", "inf", "-1", "0", "1e308", "-1e-320", "9" * 30, "\x00", "../..", "=1+1", "☃"),
    *("[" * 500, "{}", "null", "true", '"', "1 2 3", "\n", "%n%s", "1e9", "100000000", "0x7f"),
)
"""Texts in place of a number or a word."""

Mutation = Callable[[bytearray, np.random.Generator], bytearray]


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Returns the bytes after one to four random mutations.

    Args:
        data: A valid file.
        rng: Decides everything; the same state gives the same bytes.
    """
    if rng.random() < 0.65:
        if data[8:9] == b"{" and data[2:8] == bytes(6):
            return _safetensors_with_a_right_length(data, rng)
        for begin, inside in _CONTAINERS:
            if data.startswith(begin):
                return inside(data, rng)
        gentle = _GENTLE_TEXT_MUTATIONS if _is_text(data) else _GENTLE_BINARY_MUTATIONS
        return bytes(gentle[int(rng.integers(len(gentle)))](bytearray(data), rng))
    result = bytearray(data)
    kinds = _TEXT_MUTATIONS if _is_text(data) else _BINARY_MUTATIONS
    for _ in range(int(rng.integers(1, 5))):
        result = kinds[int(rng.integers(len(kinds)))](result, rng)
    return bytes(result)


def _is_text(data: bytes) -> bool:
    """Whether the first bytes are printable ASCII."""
    return all(32 <= byte < 127 or byte in b"\t\r\n" for byte in data[:256])


def _position(data: Sequence[int], rng: np.random.Generator) -> int:
    """A random position, half of them in the first 256 bytes, where headers are."""
    most = len(data) if rng.random() < 0.5 else min(len(data), 256)
    return int(rng.integers(most + 1))


def _flip_bits(data: bytearray, rng: np.random.Generator) -> bytearray:
    for _ in range(int(rng.integers(1, 9))):
        at = _position(data, rng)
        if at < len(data):
            data[at] ^= 1 << int(rng.integers(8))
    return data


def _cut_short(data: bytearray, rng: np.random.Generator) -> bytearray:
    return data[: _position(data, rng)]


def _remove_a_part(data: bytearray, rng: np.random.Generator) -> bytearray:
    at = _position(data, rng)
    del data[at : at + int(rng.integers(1, 65))]
    return data


def _insert_noise(data: bytearray, rng: np.random.Generator) -> bytearray:
    at = _position(data, rng)
    data[at:at] = rng.bytes(int(rng.integers(1, 65)))
    return data


def _repeat_a_part(data: bytearray, rng: np.random.Generator) -> bytearray:
    at = _position(data, rng)
    part = data[at : at + int(rng.integers(1, 129))]
    data[at:at] = part * int(rng.choice([1, 2, 50]))
    return data


def _overwrite_an_integer(data: bytearray, rng: np.random.Generator) -> bytearray:
    width = int(rng.choice([1, 2, 4, 8]))
    value = INTEGERS[int(rng.integers(len(INTEGERS)))] % (1 << 8 * width)
    at = _position(data, rng)
    order = "little" if rng.random() < 0.5 else "big"
    data[at : at + width] = value.to_bytes(width, order)
    return data


def _replace_a_word(data: bytearray, rng: np.random.Generator) -> bytearray:
    words = list(re.finditer(rb"[-+.\w]+", bytes(data[:20_000])))
    if not words:
        return data
    chosen = words[int(rng.integers(len(words)))]
    text = WORDS[int(rng.integers(len(WORDS)))]
    return data[: chosen.start()] + text.encode() + data[chosen.end() :]


def _repeat_a_line(data: bytearray, rng: np.random.Generator) -> bytearray:
    lines = bytes(data).split(b"\n")
    at = int(rng.integers(len(lines)))
    count = int(rng.choice([2, 3, 1000]))
    return bytearray(b"\n".join([*lines[:at], *[lines[at]] * count, *lines[at + 1 :]]))


def _flip_a_late_bit(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Where the content of most formats is."""
    data[int(rng.integers(len(data) // 2, len(data)))] ^= 1 << int(rng.integers(8))
    return data


def _overwrite_a_late_integer(data: bytearray, rng: np.random.Generator) -> bytearray:
    half = len(data) // 2
    return data[:half] + _overwrite_an_integer(data[half:], rng)[: len(data) - half]


def _change_a_number(data: bytearray, rng: np.random.Generator) -> bytearray:
    """The text with another number in place of one, which leaves its syntax as it is."""
    numbers = list(re.finditer(rb"(?<![\w.])-?\d+(\.\d+)?(?![\w.])", bytes(data[:20_000])))
    if not numbers:
        return _replace_a_word(data, rng)
    chosen = numbers[int(rng.integers(len(numbers)))]
    text = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
    return data[: chosen.start()] + text.encode() + data[chosen.end() :]


def _json_with_another_value(data: bytes, rng: np.random.Generator) -> bytes:
    """The JSON with one value, at any depth, replaced; still JSON."""
    try:
        root = [json.loads(data)]
    except ValueError:  # a line for each frame
        return bytes(_change_a_number(bytearray(data), rng))
    places: list[tuple[Any, Any]] = []
    pending: list[Any] = [root]
    while pending:
        holder = pending.pop()
        keys = list(holder) if isinstance(holder, dict) else range(len(holder))
        places += [(holder, key) for key in keys]
        pending += [holder[key] for key in keys if isinstance(holder[key], dict | list)]
    holder, key = places[int(rng.integers(1, len(places)) if len(places) > 1 else 0)]
    holder[key] = _VALUES[int(rng.integers(len(_VALUES)))]
    return json.dumps(root[0]).encode()


def _png_with_right_checksums(data: bytes, rng: np.random.Generator) -> bytes:
    """The PNG with one damaged chunk; most of the damaged pixels are compressed again."""
    at, chunks = 8, []
    while at + 8 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    chosen = len(chunks) - 2 if rng.random() < 0.5 else int(rng.integers(len(chunks) - 1))
    kind, content = chunks[chosen]
    if kind == b"IDAT" and [k for k, _ in chunks].count(kind) == 1 and rng.random() < 0.8:
        content = zlib.compress(bytes(_flip_bits(bytearray(zlib.decompress(content)), rng)))
    else:
        content = bytes(_overwrite_an_integer(bytearray(content), rng))
    chunks[chosen] = kind, content
    packed = data[:8]
    for kind, content in chunks:
        packed += struct.pack(">I", len(content)) + kind + content
        packed += struct.pack(">I", zlib.crc32(kind + content))
    return packed


def _safetensors_with_a_right_length(data: bytes, rng: np.random.Generator) -> bytes:
    """Still a length, JSON and the tensors; most headers stay, as their reader takes no other."""
    (size,) = struct.unpack_from("<Q", data)
    if rng.random() < 0.85:
        return data[: 8 + size] + bytes(_flip_bits(bytearray(data[8 + size :]), rng))
    header = _json_with_another_value(data[8 : 8 + size], rng)
    return struct.pack("<Q", len(header)) + header + data[8 + size :]


def _zip_with_a_mutated_member(data: bytes, rng: np.random.Generator) -> bytes:
    """The archive with one damaged member, whose checksum is right."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(packed, "w") as target:
        names = source.namelist()
        chosen = names[int(rng.integers(len(names)))]
        for name in names:
            member = source.read(name)
            target.writestr(name, mutated(member, rng) if name == chosen else member)
    return packed.getvalue()


_NUMBERS = ("0", "-1", "0.5", "1e30", "-3.25", "7", "65536", "4294967296", "1e-9", "100")
_VALUES = (None, True, "", "x", "../x", 0, -1, 0.5, 1e300, 2**63, [], {}, [1, 2, 3], [[0] * 3] * 3)
_CONTAINERS: tuple[tuple[bytes, Callable[[bytes, np.random.Generator], bytes]], ...] = (
    (b"PK", _zip_with_a_mutated_member),
    (b"\x89PNG", _png_with_right_checksums),
    (b"{", _json_with_another_value),
    (b"[", _json_with_another_value),
)
"""By their first bytes, formats whose content is reached only if what is around it is right."""

_GENTLE_BINARY_MUTATIONS: tuple[Mutation, ...] = (_flip_a_late_bit, _overwrite_a_late_integer)
_GENTLE_TEXT_MUTATIONS: tuple[Mutation, ...] = (_change_a_number,)
_BINARY_MUTATIONS: tuple[Mutation, ...] = (
    *(_flip_bits, _cut_short, _remove_a_part, _insert_noise, _repeat_a_part),
    *(_overwrite_an_integer, _overwrite_an_integer, _replace_a_word),
)
_TEXT_MUTATIONS: tuple[Mutation, ...] = (
    *(_replace_a_word, _replace_a_word, _repeat_a_line, _cut_short, _remove_a_part),
    *(_insert_noise, _flip_bits),
)
