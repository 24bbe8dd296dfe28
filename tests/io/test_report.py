from __future__ import annotations

import base64
import errno
import hashlib
import json
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
    image_key,
    link_image,
    save_view_3d,
    visible,
    write_report,
)
from tests.commands.report_pages import page_data

LABELS = {"first": "Before", "second": "After", "map": "Change"}
HEAD = Head(kind="Test", title="a report", labels=LABELS)
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
    head = Head(kind="Test", title=NAMES[0], without=[(n, n) for n in NAMES], labels=LABELS)
    written(tmp_path, head, (frame(name) for name in NAMES))
    data = page_data(tmp_path)
    assert data["title"] == NAMES[0]
    assert [each["name"] for each in data["frames"]] == NAMES
    assert [name for name, _ in data["without"]] == [visible(name) for name in NAMES]
    text = (tmp_path / "index.html").read_text()
    assert text.count("<script") == text.count("</script>") == 2


@given(st.text(st.characters(codec=None)))
def test_text_ends_no_element_and_opens_none(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        head = Head(kind=text, title="t", facts=[("a", text)], notes=[text], labels={"map": text})
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


def test_frames_are_taken_one_by_one(tmp_path: Path) -> None:
    seen: list[int] = []

    def frames() -> Iterator[dict[str, Any]]:
        for number in range(3000):
            seen.append((tmp_path / "index.html").exists())
            yield frame(f"{number:04}")

    written(tmp_path, HEAD, frames())
    assert not any(seen)
    assert len(page_data(tmp_path)["frames"]) == 3000


def test_images_of_the_report_before_are_removed_and_nothing_else(tmp_path: Path) -> None:
    written(tmp_path, HEAD, [])
    kept, stale, images = image_key("a"), image_key("b"), tmp_path / "images"
    for name in (f"{kept}_map.jpg", f"{stale}_map.jpg", "mine.jpg", f"{stale}.txt"):
        (images / name).write_bytes(b"x")

    def frames(images: Path) -> list[dict[str, Any]]:
        (images / f"{kept}_map.jpg").write_bytes(b"y")
        return []

    write_report(tmp_path, {}, HEAD, frames)
    left = {path.name: path.read_bytes() for path in images.iterdir()}
    assert left == {f"{kept}_map.jpg": b"y", "mine.jpg": b"x", f"{stale}.txt": b"x"}


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


@pytest.mark.parametrize(("length", "size_mb"), [(10, 0.1), (1_260_000, 1.3)])
def test_a_3d_view_becomes_a_script_of_a_known_size(
    length: int, size_mb: float, tmp_path: Path
) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"rgb": "x" * length}))
    assert save_view_3d(tmp_path / "a.json", tmp_path / "a.js") == size_mb
    assert (tmp_path / "a.js").read_text() == f'pnpdepthView({{"rgb":"{"x" * length}"}});\n'


def test_a_page_that_fails_midway_leaves_the_old_one(tmp_path: Path) -> None:
    written(tmp_path, HEAD, [frame("old")])

    def broken() -> Iterator[dict[str, Any]]:
        yield frame("new")
        raise OutputError("no")

    with pytest.raises(OutputError):
        written(tmp_path, HEAD, broken())
    assert [each["name"] for each in page_data(tmp_path)["frames"]] == ["old"]
    assert {p.name for p in tmp_path.iterdir()} == {"index.html", "images", "report.json"}


def test_inputs_and_other_files_are_safe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("in", "full"):
        Path(name).mkdir()
    Path("file").write_text("mine")
    Path("full/notes.txt").write_text("mine")
    Path("link").symlink_to("in")
    for folder, message in (
        ("in", "lies in in, which is read"),
        ("in/deep/report", "lies in in, which is read"),
        (".", "holds in, which is read"),
        ("file", "file is a file"),
        ("file/deep/report", "file is a file"),
        ("full", "not empty; --overwrite replaces the report"),
        ("link", "lies in in, which is read"),
    ):
        for overwrite in (False, True) if folder != "full" else (False,):
            with pytest.raises(OutputError, match=message):
                check_report_folder(Path(folder), [Path("in")], made_of=None, overwrite=overwrite)
