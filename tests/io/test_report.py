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
    "</script><script>alert(1)</script>",
    "<!-- \"'&amp; -->",
    "two\nlines",
    "@DATA@ @SCRIPT@",
    "ü \u2028 \U0001f600",
    "not utf-8: \udcff",
]


def written(folder: Path, frames: Iterable[dict[str, Any]], **head: Any) -> list[str]:
    """The names of the frames on the page of these frames."""
    page = {"title": "", "facts": [], "notes": [], "tables": [], "without": [], **head}
    data = {"columns": [], "sort_by": 0, "signed": [], "unit": "m"}
    write_report(folder, {"command": "eval"}, page, data, lambda images: frames)
    return [row["name"] for row in page_data(folder)["frames"]]


def frame(name: str) -> dict[str, Any]:
    return {"name": name, "key": None, "values": []}


@pytest.fixture
def page_of_odd_names(tmp_path: Path) -> Path:
    """The folder of a report whose title, frames and frames left out have odd names."""
    without = [(name, name) for name in NAMES]
    written(tmp_path, map(frame, NAMES), title=NAMES[0], without=without)
    return tmp_path


def test_names_of_frames_and_the_title_are_data_of_the_page(page_of_odd_names: Path) -> None:
    data = page_data(page_of_odd_names)
    assert [row["name"] for row in data["frames"]] == NAMES
    assert data["title"] == NAMES[0]
    assert [name for name, _ in data["without"]] == [visible(name) for name in NAMES]


def test_no_name_opens_or_closes_a_script(page_of_odd_names: Path) -> None:
    text = (page_of_odd_names / "index.html").read_text()
    assert text.count("<script") == text.count("</script>") == 2


def test_the_page_has_no_address_but_the_name_of_svgs_elements(page_of_odd_names: Path) -> None:
    text = (page_of_odd_names / "index.html").read_text()
    assert set(re.findall(r"\w+://[^\s\"']*", text)) == {"http://www.w3.org/2000/svg"}


def policy_of(text: str) -> str:
    """What the page says that a browser may load and run."""
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    assert isinstance(policy, str)
    return policy


def test_the_page_lets_nothing_be_loaded(page_of_odd_names: Path) -> None:
    policy = policy_of((page_of_odd_names / "index.html").read_text())
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy


@pytest.mark.parametrize("element", ["style", "script"])
def test_the_page_lets_nothing_run_but_itself(page_of_odd_names: Path, element: str) -> None:
    text = (page_of_odd_names / "index.html").read_text()
    (body,) = re.findall(rf"<{element}>(.*?)</{element}>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
    assert f"{element}-src 'sha256-{digest}'" in policy_of(text)


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
    assert [row["name"] for row in page_data(tmp_path / "r")["frames"]] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


@pytest.mark.parametrize("folder", [".", "file", "file/deep", "full", "link"])
def test_a_folder_that_holds_other_files_is_never_taken_for_a_report(
    folder: str, tmp_path: Path
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "file").write_text("mine")
    (tmp_path / "full/notes.txt").write_text("mine")
    (tmp_path / "link").symlink_to("full")
    for overwrite in (False, True):
        with pytest.raises(OutputError):
            check_report_folder(tmp_path / folder, {}, overwrite=overwrite)
