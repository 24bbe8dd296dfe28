"""A report's folder is replaced whole, and its page runs nothing that names say."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.report import check_report_folder, visible, write_report
from tests.commands.report_pages import page_data

NAMES = [
    *("</script><script>alert(1)</script>", "<!-- \"'&amp; -->", "two\nlines", "@DATA@ @SCRIPT@"),
    *("ü \u2028 \U0001f600", "not utf-8: \udcff"),
]


def written(folder: Path, frames: Iterable[dict[str, Any]], **head: Any) -> list[str]:
    """The names of the frames on the page of these frames."""
    page = {"title": "", "facts": [], "notes": [], "tables": [], "without": [], **head}
    data = {"columns": [], "sort_by": 0, "signed": [], "unit": "m"}
    write_report(folder, {"command": "eval"}, page, data, lambda images: frames)
    return [each["name"] for each in page_data(folder)["frames"]]


def frame(name: str) -> dict[str, Any]:
    return {"name": name, "key": None, "values": []}


def test_names_are_data_and_the_page_lets_nothing_run_but_itself(tmp_path: Path) -> None:
    without = [(name, name) for name in NAMES]
    assert written(tmp_path, map(frame, NAMES), title=NAMES[0], without=without) == NAMES
    data, text = page_data(tmp_path), (tmp_path / "index.html").read_text()
    assert data["title"] == NAMES[0]
    assert [name for name, _ in data["without"]] == [visible(name) for name in NAMES]
    assert text.count("<script") == text.count("</script>") == 2
    addresses = set(re.findall(r"\w+://[^\s\"']*", text))
    assert addresses == {"http://www.w3.org/2000/svg"}  # the name of SVG's elements
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    for element in ("style", "script"):
        (body,) = re.findall(rf"<{element}>(.*?)</{element}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{element}-src 'sha256-{digest}'" in policy


def test_a_report_replaces_the_one_before_with_its_images_or_leaves_it(tmp_path: Path) -> None:
    written(tmp_path / "r", [])
    (tmp_path / "r/images/stale_map.png").write_bytes(b"x")
    assert written(tmp_path / "r", [frame("new")]) == ["new"]
    assert not any((tmp_path / "r/images").iterdir())

    def broken() -> Iterator[dict[str, Any]]:
        yield frame("newest")
        raise OutputError("no")

    with pytest.raises(OutputError):
        written(tmp_path / "r", broken())
    assert [each["name"] for each in page_data(tmp_path / "r")["frames"]] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


@pytest.mark.parametrize("folder", [".", "file", "file/deep", "full", "link"])
def test_other_files_are_safe(folder: str, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "file").write_text("mine")
    (tmp_path / "full/notes.txt").write_text("mine")
    (tmp_path / "link").symlink_to("full")
    for overwrite in (False, True):
        with pytest.raises(OutputError):
            check_report_folder(tmp_path / folder, {}, overwrite=overwrite)
