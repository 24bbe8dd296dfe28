"""What a report's page shows, for tests."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path
from typing import Any


def page_data(folder: Path) -> dict[str, Any]:
    """The data of the page's script, and the text of its head."""
    text = (folder / "index.html").read_text()
    head, script = text.split('<script type="application/json" id="data">')
    data = json.loads(script.split("</script>")[0])
    ((title,),) = _found('id="title">(.*?)<', head)
    tables = re.findall('(?s)<table class="means">(.*?)</table>', head)
    return {
        **data["head"],
        "frames": data["frames"],
        "title": title,
        "facts": _found("<dt>(.*?)</dt><dd>(.*?)</dd>", head),
        "without": _found("<strong>(.*?)</strong><span>(.*?)</span>", head),
        "notes": [note for (note,) in _found("<li[^>]*>([^<]*)</li>", head)],
        "tables": [_table(table) for table in tables],
    }


def _found(pattern: str, text: str) -> list[tuple[str, ...]]:
    matches = re.finditer(pattern, text, re.DOTALL)
    return [tuple(map(unescape, match.groups())) for match in matches]


def _table(text: str) -> dict[str, Any]:
    ((title,),) = _found("<caption>(.*?)<", text)
    rows = re.findall("(?s)<tr>(.*?)</tr>", text)[1:]
    cells = [_found("<t[hd][^>]*>(.*?)</t[hd]>", row) for row in rows]
    return {"title": title, "rows": [[cell for (cell,) in row] for row in cells]}


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
