"""Damages a file's bytes as transfers, wrong tools and attackers do."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable, Sequence

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
    if data[:2] == b"PK" and rng.random() < 0.5:
        return _zip_with_a_mutated_member(data, rng)
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


_BINARY_MUTATIONS: tuple[Mutation, ...] = (
    *(_flip_bits, _cut_short, _remove_a_part, _insert_noise, _repeat_a_part),
    *(_overwrite_an_integer, _overwrite_an_integer, _replace_a_word),
)
_TEXT_MUTATIONS: tuple[Mutation, ...] = (
    *(_replace_a_word, _replace_a_word, _repeat_a_line, _cut_short, _remove_a_part),
    *(_insert_noise, _flip_bits),
)
