"""What a report's page shows, for tests."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path
from typing import Any

_DATA = re.compile(r'(?s)<script type="application/json" id="data">(.*?)</script>')


def page_data(folder: Path) -> dict[str, Any]:
    """The data of the page's script, and the text of its head."""
    text = (folder / "index.html").read_text()
    found = _DATA.search(text)
    assert found
    data: dict[str, Any] = json.loads(found[1])
    head = text[: found.start()]

    def pairs(element: str, first: str, second: str) -> list[tuple[str, ...]]:
        (part,) = re.findall(f'(?s)id="{element}">(.*?)</[du]l>', head) or [""]
        return _found(f"<{first}>(.*?)</{first}><{second}>(.*?)</{second}>", part)

    return {
        **data["head"],
        "frames": data["frames"],
        "title": unescape(re.findall('id="title">(.*?)<', head)[0]),
        "facts": pairs("facts", "dt", "dd"),
        "without": pairs("reasons", "strong", "span"),
        "notes": re.findall("<li[^>]*>(.*?)</li>", head.split('id="notes">')[1].split("</ul>")[0]),
        "tables": [
            _table(each) for each in re.findall('(?s)<table class="means">(.*?)</table>', head)
        ],
    }


def _found(pattern: str, text: str) -> list[tuple[str, ...]]:
    return [tuple(map(unescape, each)) for each in re.findall(pattern, text)]


def _table(text: str) -> dict[str, Any]:
    header, *rows = (
        [unescape(cell) for cell in re.findall("<t[hd][^>]*>(.*?)</t[hd]>", row)]
        for row in re.findall("(?s)<tr>(.*?)</tr>", text)
    )
    return {
        "title": unescape(re.findall("<caption>(.*?)<", text)[0]), "header": header, "rows": rows
    }  # fmt: skip


def frames_of(folder: Path) -> dict[str, dict[str, Any]]:
    """The frames on the page by name, their values by the key of the column."""
    data = page_data(folder)
    keys = [column["key"] for column in data["columns"]]
    return {
        frame["name"]: frame | {"values": dict(zip(keys, frame["values"], strict=True))}
        for frame in data["frames"]
    }


def everything(folder: Path) -> dict[str, bytes]:
    """The files of a report by their names."""
    return {p.name: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
