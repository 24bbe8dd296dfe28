"""Differences between the kept output of a step and its output now."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.golden.normalise import NUMBER

RELATIVE = 0.002
"""Of numbers that differ no more than this, or by one in the last digit, one is rounded."""
LEAST_DIGITS = 5
"""One in a later digit is rounded as well."""
_MESSAGES = re.compile(r"(^|\.)(notes|warnings|message|messages|problem|why)(\.|\[|$)")


def differences(kept: Any, now: Any, *, messages: bool, path: str = "") -> Iterator[str]:
    """A line for each difference between what was kept of a step and what it gave now."""
    if kept == now or (not messages and _is_message(path)):
        return
    if isinstance(kept, dict) and isinstance(now, dict):
        if _only_encoded(kept, now):
            yield f"{path}: other bytes, the same values"
            return
        if "hash" in kept and "hash" in now and kept["hash"] != now["hash"]:
            yield f"{path}: other values: {_short(_figures(kept))} -> {_short(_figures(now))}"
            return
        for name in [*kept, *(name for name in now if name not in kept)]:
            where = f"{path}.{name}" if path else name
            if name not in now:
                yield f"{where}: missing"
            elif name not in kept:
                yield f"{where}: new, {_short(now[name])}"
            else:
                yield from differences(kept[name], now[name], messages=messages, path=where)
        return
    if isinstance(kept, list) and isinstance(now, list):
        if all(isinstance(line, str) for line in (*kept, *now)):
            yield from _other_lines(kept, now, path)
            return
        if len(kept) == len(now):
            for number, (one, other) in enumerate(zip(kept, now, strict=True)):
                where = f"{path}[{number}]"
                yield from differences(one, other, messages=messages, path=where)
            return
    yield f"{path}: {_short(kept)} -> {_short(now)}"


def _is_message(path: str) -> bool:
    if path in ("stdout", "stderr"):
        return False  # looked at below, as data on stdout is no message
    return _MESSAGES.search(path) is not None


def _figures(described: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in described.items() if name != "hash"}


def _only_encoded(kept: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether a file has other bytes but the same values in it."""
    if "bytes" not in kept or kept.keys() != now.keys() or len(kept) == 1:
        return False
    return all(kept[name] == now[name] for name in kept if name != "bytes")


def _other_lines(kept: Sequence[str], now: Sequence[str], path: str) -> Iterator[str]:
    changes = [
        line
        for line in difflib.unified_diff(kept, now, n=0, lineterm="")
        if not line.startswith(("---", "+++", "@@"))
    ]
    for line in changes[:20]:
        yield f"{path}: {line[0]} {line[1:].strip()[:300]}"
    if len(changes) > 20:
        yield f"{path}: and {len(changes) - 20} lines more"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 160 else f"{text[:150]}… ({len(text)} characters)"


def portable(output: Any) -> Any:
    """The output of a step without what libraries, their versions and rounding change: hashes,
    bytes and sizes of files, and digests of settings.
    """
    if isinstance(output, dict):
        return {
            name: portable(each)
            for name, each in output.items()
            if name not in ("hash", "bytes", "sha256")
            and not (name == "size" and isinstance(each, int))
            and not (name == "settings" and isinstance(each, str))
        }
    return [portable(each) for each in output] if isinstance(output, list) else output


def nearly(kept: Any, now: Any, *, numbers: bool = True, path: str = "") -> Iterator[str]:
    """A line for each difference between portable outputs that is no matter of rounding.

    Args:
        numbers: Compare them.
    """
    if isinstance(kept, dict) and isinstance(now, dict) and kept.keys() == now.keys():
        for name in kept:
            yield from nearly(
                kept[name], now[name], numbers=numbers, path=f"{path}.{name}" if path else name
            )
    elif isinstance(kept, list) and isinstance(now, list) and len(kept) == len(now):
        for number, (one, other) in enumerate(zip(kept, now, strict=True)):
            yield from nearly(one, other, numbers=numbers, path=f"{path}[{number}]")
    elif kept != now and not _only_rounded(kept, now, numbers):
        yield f"{path}: {_short(kept)} -> {_short(now)}"


def _only_rounded(kept: Any, now: Any, numbers: bool) -> bool:
    if isinstance(kept, bool) or type(kept) is not type(now):
        return False
    if isinstance(kept, int | float):
        return not numbers or _near(repr(kept), repr(now))
    if not isinstance(kept, str) or NUMBER.sub("#", kept) != NUMBER.sub("#", now):
        return False
    pairs = zip(NUMBER.findall(kept), NUMBER.findall(now), strict=True)
    return not numbers or all(_near(*pair) for pair in pairs)


def _near(kept: str, now: str) -> bool:
    one, other = (float(text.replace(",", "")) for text in (kept, now))
    digits = len(kept.partition(".")[2]) if "e" not in kept else 12
    unit = 0.0 if "." not in kept else 10.0 ** -min(digits, LEAST_DIGITS)
    return abs(one - other) <= RELATIVE * max(abs(one), abs(other)) + 1.5 * unit


def compared(kept: Mapping[str, Any], now: Mapping[str, Any], *, messages: bool) -> list[str]:
    """The differences of one step; without `messages` of its data and files alone."""
    if not messages:
        kept, now = (
            {
                key: value
                for key, value in each.items()
                if key not in ("stdout", "stderr") or (key == "stdout" and _is_data(value))
            }
            for each in (kept, now)
        )
    return list(differences(kept, now, messages=messages))


def _is_data(output: Any) -> bool:
    return isinstance(output, dict) or (
        isinstance(output, list) and any(not isinstance(each, str) for each in output)
    )
