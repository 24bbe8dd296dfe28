"""The data in a report's page, for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

_BEFORE = '<script type="application/json" id="data">'


def page_data(folder: Path) -> dict[str, Any]:
    """What the page in the folder is given to show."""
    text = (folder / "index.html").read_text()
    data: dict[str, Any] = json.loads(text.split(_BEFORE)[1].split("</script>")[0])
    return data


def frames_of(folder: Path) -> dict[str, dict[str, Any]]:
    """The frames on the page by name, their values by the key of the column."""
    data = page_data(folder)
    keys = [column["key"] for column in data["columns"]]
    return {
        frame["name"]: frame | {"values": dict(zip(keys, frame["values"], strict=True))}
        for frame in data["frames"]
    }


def images_of(folder: Path) -> dict[str, bytes]:
    """Returns the images of a report by name."""
    return {path.name: path.read_bytes() for path in sorted((folder / "images").iterdir())}


def everything(folder: Path) -> dict[str, bytes]:
    """The files of a report by their names."""
    return {p.name: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
