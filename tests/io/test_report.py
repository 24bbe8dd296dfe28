from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.report import (
    _embedded,
    begin_report,
    check_report_folder,
    image_key,
    remove_report_leftovers,
    whole_report,
    write_report,
)
from tests.pipeline.report_pages import page_data

HEAD = {"title": "a report"}
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


def test_names_are_data_whatever_they_say(tmp_path: Path) -> None:
    begin_report(tmp_path, {"command": "eval"})
    write_report(tmp_path, {"title": NAMES[0]}, (frame(name) for name in NAMES))
    data = page_data(tmp_path)
    assert data["title"] == NAMES[0]
    assert [each["name"] for each in data["frames"]] == NAMES
    text = (tmp_path / "index.html").read_text()
    assert text.count("<script") == text.count("</script>") == 2


@given(st.text(st.characters(codec=None)))
def test_embedded_json_ends_no_element_and_opens_none(text: str) -> None:
    assert "<" not in _embedded({"text": text})
    assert _embedded({"text": text}).isascii()


def test_the_page_names_no_address_and_lets_nothing_run_but_itself(tmp_path: Path) -> None:
    begin_report(tmp_path, {})
    write_report(tmp_path, HEAD, [])
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
    begin_report(tmp_path, {})
    seen: list[int] = []

    def frames() -> Iterator[dict[str, Any]]:
        for number in range(3000):
            seen.append((tmp_path / "index.html").exists())
            yield frame(f"{number:04}")

    size = write_report(tmp_path, HEAD, frames())
    assert not any(seen)
    assert size == (tmp_path / "index.html").stat().st_size
    assert len(page_data(tmp_path)["frames"]) == 3000


def test_images_of_no_frame_are_removed_and_nothing_else(tmp_path: Path) -> None:
    images = begin_report(tmp_path, {})
    kept, stale = image_key("a"), image_key("b")
    for name in (f"{kept}_map.jpg", f"{stale}_map.jpg", "mine.jpg", f"{stale}.txt"):
        (images / name).write_bytes(b"x")
    write_report(tmp_path, HEAD, [frame("a", kept), frame("without")])
    left = {path.name for path in images.iterdir()}
    assert left == {f"{kept}_map.jpg", "mine.jpg", f"{stale}.txt"}


def test_a_report_of_an_earlier_version_is_replaced_with_its_images(tmp_path: Path) -> None:
    begin_report(tmp_path, {"command": "batch"})
    old, image = tmp_path / "pictures", f"{image_key('a')}_map.jpg"
    old.mkdir()
    (old / image).write_bytes(b"x")
    (old / ".0123456789ab.jpg").write_bytes(b"half")
    check_report_folder(tmp_path, [], made_of={"command": "batch"}, overwrite=False)
    assert remove_report_leftovers(tmp_path) == 1
    write_report(tmp_path, HEAD, [frame("a", image_key("a"))])
    assert not old.exists()
    old.mkdir()
    for name in (image, "mine.jpg"):
        (old / name).write_bytes(b"x")
    with whole_report(tmp_path) as folder:
        begin_report(folder, {"command": "eval"})
    assert [path.name for path in old.iterdir()] == ["mine.jpg"]


def test_keys_of_different_parts_differ() -> None:
    keys = {
        image_key("a", "bc"),
        image_key("ab", "c"),
        image_key("abc"),
        image_key("\udcff"),
    }
    assert len(keys) == 4


def test_what_a_killed_writer_left_is_removed(tmp_path: Path) -> None:
    images = begin_report(tmp_path, {})
    for path in (tmp_path / ".0123456789ab.html", images / ".0123456789ab.jpg"):
        path.write_bytes(b"half")
    assert remove_report_leftovers(tmp_path) == 2
    assert remove_report_leftovers(tmp_path / "nowhere") == 0


def test_a_page_that_fails_midway_leaves_the_old_one(tmp_path: Path) -> None:
    begin_report(tmp_path, {})
    write_report(tmp_path, HEAD, [frame("old")])

    def broken() -> Iterator[dict[str, Any]]:
        yield frame("new")
        raise OutputError("no")

    with pytest.raises(OutputError):
        write_report(tmp_path, HEAD, broken())
    assert [each["name"] for each in page_data(tmp_path)["frames"]] == ["old"]
    assert {p.name for p in tmp_path.iterdir()} == {"index.html", "images", "report.json"}


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("in", "lies in in, which is read"),
        ("in/deep/report", "lies in in, which is read"),
        (".", "holds in, which is read"),
        ("file", "is a file"),
        ("full", "not empty; --overwrite replaces the report"),
        ("link", "lies in in, which is read"),
    ],
)
def test_inputs_and_other_files_are_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("in", "full"):
        Path(name).mkdir()
    Path("file").write_text("mine")
    Path("full/notes.txt").write_text("mine")
    Path("link").symlink_to("in")
    with pytest.raises(OutputError, match=message):
        check_report_folder(Path(folder), [Path("in")], made_of=None, overwrite=False)
    if folder != "full":
        with pytest.raises(OutputError):
            check_report_folder(Path(folder), [Path("in")], made_of=None, overwrite=True)


def test_a_report_of_the_same_may_be_written_again_and_no_other(tmp_path: Path) -> None:
    folder = tmp_path / "report"
    begin_report(folder, {"command": "batch", "output": "../out"})
    check_report_folder(
        folder, [], made_of={"command": "batch", "output": "../out"}, overwrite=False
    )
    for other in (None, {"command": "batch", "output": "../other"}):
        with pytest.raises(OutputError, match="not empty"):
            check_report_folder(folder, [], made_of=other, overwrite=False)
    check_report_folder(folder, [], made_of=None, overwrite=True)
