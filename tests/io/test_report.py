from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.report import (
    Head,
    check_report_folder,
    visible,
    write_report,
)
from tests.commands.report_pages import page_data

HEAD = Head(title="a report")
NAMES = [
    "</script><script>alert(1)</script>",
    "<!-- \"'&amp; -->",
    "two\nlines",
    "ü \u2028 \U0001f600",
    "not utf-8: \udcff",
    "@DATA@ @SCRIPT@",
]


def frame(name: str, key: str | None = None) -> dict[str, Any]:
    return {"name": name, "key": key, "values": []}


def written(folder: Path, head: Head, frames: Iterable[dict[str, Any]]) -> None:
    write_report(folder, {"command": "eval"}, head, lambda images: frames)


def test_names_are_data_whatever_they_say(tmp_path: Path) -> None:
    head = Head(title=NAMES[0], without=[(n, n) for n in NAMES])
    written(tmp_path, head, (frame(name) for name in NAMES))
    data, text = page_data(tmp_path), (tmp_path / "index.html").read_text()
    assert data["title"] == NAMES[0]
    assert [each["name"] for each in data["frames"]] == NAMES
    assert [name for name, _ in data["without"]] == [visible(name) for name in NAMES]
    assert text.count("<script") == text.count("</script>") == 2


def test_the_page_names_no_address_and_lets_nothing_run_but_itself(tmp_path: Path) -> None:
    written(tmp_path, HEAD, [])
    text = (tmp_path / "index.html").read_text()
    addresses = set(re.findall(r"\w+://[^\s\"']*", text))
    assert addresses == {"http://www.w3.org/2000/svg"}  # the name of SVG's elements
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    for element in ("style", "script"):
        (body,) = re.findall(rf"<{element}>(.*?)</{element}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{element}-src 'sha256-{digest}'" in policy


def test_a_report_replaces_the_one_before_with_its_images(tmp_path: Path) -> None:
    written(tmp_path / "r", HEAD, [])
    (tmp_path / "r/images/stale_map.png").write_bytes(b"x")
    written(tmp_path / "r", HEAD, [frame("new")])
    assert [each["name"] for each in page_data(tmp_path / "r")["frames"]] == ["new"]
    assert not any((tmp_path / "r/images").iterdir())
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


def test_a_page_that_fails_midway_leaves_the_old_one(tmp_path: Path) -> None:
    written(tmp_path, HEAD, [frame("old")])

    def broken() -> Iterator[dict[str, Any]]:
        yield frame("new")
        raise OutputError("no")

    with pytest.raises(OutputError):
        written(tmp_path, HEAD, broken())
    assert [each["name"] for each in page_data(tmp_path)["frames"]] == ["old"]
    assert {p.name for p in tmp_path.iterdir()} == {"index.html", "images", "report.json"}


@pytest.mark.parametrize("folder", [".", "file", "file/deep", "full", "link"])
def test_other_files_are_safe(folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("full").mkdir()
    Path("file").write_text("mine")
    Path("full/notes.txt").write_text("mine")
    Path("link").symlink_to("full")
    for overwrite in (False, True):
        with pytest.raises(OutputError):
            check_report_folder(Path(folder), made_of=None, overwrite=overwrite)
