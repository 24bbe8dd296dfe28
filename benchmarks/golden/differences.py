"""Differences between the kept output of a step and its output now."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

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
