from __future__ import annotations

import base64
import errno
import hashlib
import os
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.report import (
    Head,
    check_report_folder,
    link_image,
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


@given(st.text(st.characters(codec=None)))
def test_text_ends_no_element_and_opens_none(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        head = Head(title=text, facts=[("a", text)], notes=[text])
        written(Path(folder), head, [frame(text)])
        page = (Path(folder) / "index.html").read_bytes()
    ends = (f"</{each}>".encode() for each in ("script", "li", "dt", "dd", "h1", "td"))
    assert [page.count(each) for each in ends] == [2, 1, 1, 1, 1, 0]


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


def test_a_linked_image_is_the_file_itself_or_on_another_disk_a_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    source, target = tmp_path / "source.png", tmp_path / "linked.png"
    source.write_bytes(b"first")
    link_image(source, target)
    assert target.samefile(source)
    monkeypatch.setattr(os, "link", refuse)
    link_image(source, tmp_path / "copy.png")
    assert (tmp_path / "copy.png").read_bytes() == b"first"
    assert not (tmp_path / "copy.png").samefile(source)


@pytest.mark.parametrize(
    "folder", ["in", "in/deep/report", ".", "file", "file/deep", "full", "link"]
)
def test_inputs_and_other_files_are_safe(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("in", "full"):
        Path(name).mkdir()
    Path("file").write_text("mine")
    Path("full/notes.txt").write_text("mine")
    Path("link").symlink_to("in")
    for overwrite in (False, folder != "full"):
        with pytest.raises(OutputError):
            check_report_folder(Path(folder), [Path("in")], made_of=None, overwrite=overwrite)
