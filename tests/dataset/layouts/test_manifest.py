"""Manifests, and the names of frames that cannot be, or must not be, file names of results."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.dataset.frame_files import FrameFiles, name_problem
from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.protocols import ODOMETRY_PART
from tests.data_sets import read_frames, touch


def manifest(folder: Path, text: str) -> Path:
    """A list beside the image i.png."""
    touch(folder / "i.png")
    (folder / "m.csv").write_text(text, encoding="utf-8")
    return folder / "m.csv"


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
        ("image,deep\ni.png,s.png\n", "line 1: column 'deep' is not one of"),
        ("image,gt,gt\ni.png,s.png,s.png\n", "line 1: column 'gt'"),
        ("image,camera\ni.png,left\n", "line 2"),
        ("image\ni.png\ni.png\n", "line 3: a second frame 'i'; "),
        ("image,gt\n,i.png\n", "neither image nor sparse"),
        ("image\ni.png,more\n", "line 2"),
        ("image,gt_size_ok\ni.png,maybe\n", "gt_size_ok is 'maybe', not true or false"),
        ("image\n" + "x" * 200_000 + "\n", "field larger than field limit"),
        ("image\ni\0.png\n", "no file can have this name"),
        *(
            (f"image,name\ni.png,{first}\ni.png,{second}\n", "line 3")  # of one file
            for first, second in (("a", "./a"), ("x/y", "x/./y"), ("Frame", "frame"), ("ß", "SS"))
        ),
    ],
)
def test_a_line_that_means_nothing_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_frames(manifest(tmp_path, text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_of_a_manifest_is_named_with_its_line(tmp_path: Path) -> None:
    _, _, ((lost, why),) = list_frames(manifest(tmp_path, "image\n\nlost.png\n"))
    assert lost == tmp_path / "lost.png"
    assert "line 3" in why


NAMES = {
    "console": "console", "a.con": "a.con", "n" * 239: "n" * 239, "x/y": "x/y", "é": "é",
    "./s": "s", "z//y/.": "z/y",
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "names"),
    [
        # of one stem, by their folders
        ("image,name\none/x.png,\ntwo/x.png,\ny.png,mine\n", ["one/x", "two/x", "mine"]),
        ('image\n"a\nb.png"\nc\u2028d.png\n', ["a\nb", "c\u2028d"]),
        ("\n".join(["image,name", *(f"i.png,{name}" for name in NAMES)]), list(NAMES.values())),
    ],
)
def test_names_stay_but_for_dots_and_slashes(text: str, names: list[str], tmp_path: Path) -> None:
    for file in ("one/x.png", "two/x.png", "y.png", "a\nb.png", "c\u2028d.png"):
        touch(tmp_path / file)
    assert [frame.name for frame in read_frames(manifest(tmp_path, text))] == names


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        *((name, "leads out of the output folder") for name in ("../a", "/a", "x/../../a")),
        *((name, "on Windows") for name in ("a\\b", "C:/frames/a")),
        *((name, "no file name has") for name in ("a\0b", "\ud800")),
        (".", "names no file"),
        *((name, "is longer than 239 bytes") for name in ("n" * 240, "x/" + "é" * 120)),
    ],
)
def test_a_name_that_no_file_can_have_is_refused(name: str, problem: str) -> None:
    assert problem in (name_problem(name) or "")
    assert name_problem("n" * 239) is None
