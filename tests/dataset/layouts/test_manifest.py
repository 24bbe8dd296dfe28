"""Manifests, and the names of frames that cannot be, or must not be, file names of results."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.dataset.frame_files import FrameFiles, name_problem
from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.protocols import ODOMETRY_PART
from tests.data_sets import read_frames, touch


def manifest(folder: Path, text: str) -> Path:
    """A list beside the image i.png."""
    touch(folder / "i.png")
    (folder / "m.csv").write_text(text, encoding="utf-8")
    return folder / "m.csv"


def frames_named(folder: Path, *names: str) -> list[FrameFiles]:
    rows = "".join(f"i.png,{name}\n" for name in names)
    return read_frames(manifest(folder, f"image,name\n{rows}"))


def test_a_manifest_has_all_that_a_frame_can_have(tmp_path: Path) -> None:
    touch(*(tmp_path / name for name in ("i.png", "s.bin", "c.txt", "deep/g.png", "m.png")))
    row = {
        "image": "i.png", "sparse": "s.bin", "gt": "deep/g.png", "calib": "c.txt", "camera": 3,
        "sparse_scale": "", "gt_scale": 1000, "name": "first", "protocol": "kitti-odometry",
        "mask": "m.png", "gt_size_ok": "yes", "group": "room",
    }  # fmt: skip
    (tmp_path / "m.csv").write_text(f"{','.join(row)}\n{','.join(map(str, row.values()))}\n")
    (frame,) = read_frames(tmp_path / "m.csv")
    assert frame == FrameFiles(
        name="first",
        image=tmp_path / "i.png",
        sparse=tmp_path / "s.bin",
        gt=tmp_path / "deep/g.png",
        calib=tmp_path / "c.txt",
        camera=3,
        gt_scale=1000,
        part=ODOMETRY_PART,
        masks=(tmp_path / "m.png",),
        gt_other_size=True,
        group="room",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image,depth\ni.png,s.png\n", "'depth' is not one of"),
        ("image,camera\ni.png,left\n", "line 2"),
        ("image\ni.png\ni.png\n", "line 3: a second frame 'i'"),
        ("image,gt\n,i.png\n", "neither image nor sparse"),
        ("image\ni.png,more\n", "more than the header has"),
        ("image,gt_size_ok\ni.png,maybe\n", "gt_size_ok is 'maybe', not true or false"),
        ("image\n" + "x" * 200_000 + "\n", "field larger than field limit"),
        ("image\ni\0.png\n", "no file can have this name"),
    ],
)
def test_a_line_that_means_nothing_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_frames(manifest(tmp_path, text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_of_a_manifest_is_named_with_its_line(tmp_path: Path) -> None:
    _, _, (lost,) = list_frames(manifest(tmp_path, "image\n\nlost.png\n"))
    assert lost.path == tmp_path / "lost.png"
    assert "line 3" in str(lost)


def test_frames_of_one_stem_are_named_by_their_folders(tmp_path: Path) -> None:
    touch(*(tmp_path / "data" / name for name in ("one/x.png", "two/x.png", "y.png")))
    rows = "data/one/x.png,\ndata/two/x.png,\ndata/y.png,mine\n"
    frames = read_frames(manifest(tmp_path, f"image,name\n{rows}"))
    assert [frame.name for frame in frames] == ["one/x", "two/x", "mine"]


def test_a_manifest_may_name_files_with_new_lines(tmp_path: Path) -> None:
    touch(tmp_path / "a\nb.png", tmp_path / "c\u2028d.png")
    frames = read_frames(manifest(tmp_path, 'image\n"a\nb.png"\nc\u2028d.png\n'))
    assert [frame.name for frame in frames] == ["a\nb", "c\u2028d"]


@pytest.mark.parametrize(
    ("first", "second"), [("a", "./a"), ("x/y", "x/./y"), ("Frame", "frame"), ("ß", "SS")]
)
def test_two_names_of_one_file_are_refused(tmp_path: Path, first: str, second: str) -> None:
    with pytest.raises(FileFormatError, match="line 3"):
        frames_named(tmp_path, first, second)


def test_names_stay_but_for_dots_and_double_slashes(tmp_path: Path) -> None:
    given = ["console", "a.con", "n" * 239, "x/y", "é", "./s", "z//y/."]
    read = ["console", "a.con", "n" * 239, "x/y", "é", "s", "z/y"]
    assert [frame.name for frame in frames_named(tmp_path, *given)] == read


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        *((name, "leads out of the output folder") for name in ("../a", "/a", "x/../../a")),
        *((name, "on Windows") for name in ("a\\b", "C:/frames/a")),
        ("a\0b", "no file name has"),
        ("\ud800", "no file name has"),
        (".", "names no file"),
        ("n" * 240, "is longer than 239 bytes"),
        ("x/" + "é" * 120, "is longer than 239 bytes"),
    ],
)
def test_a_name_that_no_file_can_have_is_refused(name: str, problem: str) -> None:
    assert problem in (name_problem(name) or "")
    assert name_problem("n" * 239) is None
