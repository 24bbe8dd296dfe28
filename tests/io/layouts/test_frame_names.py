"""Names of frames that cannot be, or must not be, file names of results."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset import Hdf5Array, name_problem
from pnpdepth_cli.io.dataset.reading import depth_of, shape_of
from pnpdepth_cli.io.layouts import LAYOUTS, read_frames


def manifest(folder: Path, *names: str) -> Path:
    (folder / "i.png").touch()
    path = folder / "m.jsonl"
    path.write_text("".join(json.dumps({"image": "i.png", "name": n}) + "\n" for n in names))
    return path


@pytest.mark.parametrize(
    ("first", "second"),
    [("a", "./a"), ("x/y", "x//y"), ("x/y", "x/./y"), ("Frame", "frame"), ("ß", "SS")],
)
def test_two_names_of_one_file_are_refused(tmp_path: Path, first: str, second: str) -> None:
    with pytest.raises(FileFormatError, match="line 2: a second frame"):
        read_frames(manifest(tmp_path, first, second))


def test_a_name_is_normalised(tmp_path: Path) -> None:
    names = [frame.name for frame in read_frames(manifest(tmp_path, "./summary", "x//y/."))]
    assert names == ["summary", "x/y"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("a\0b", "NUL"),
        ("a\\b", "backslash"),
        ("C:/frames/a", "drive letter"),
        ("con", "which Windows reserves"),
        ("x/NUL.tar/y", "which Windows reserves"),
        ("Com1", "which Windows reserves"),
        (".", "names no file"),
        ("n" * 240, "longer than 239 bytes"),
        ("x/" + "é" * 120, "longer than 239 bytes"),
    ],
)
def test_a_name_that_is_fit_for_no_file_is_refused(tmp_path: Path, name: str, why: str) -> None:
    with pytest.raises(FileFormatError, match=rf"line 1: .*{why}"):
        read_frames(manifest(tmp_path, name))


@pytest.mark.parametrize("name", ["console", "nullable", "a.con", "n" * 239, "x/y", "é"])
def test_other_names_stay(tmp_path: Path, name: str) -> None:
    assert [frame.name for frame in read_frames(manifest(tmp_path, name))] == [name]


def test_a_nul_in_a_path_of_a_manifest_is_named(tmp_path: Path) -> None:
    (tmp_path / "m.jsonl").write_text('{"image": "i\\u0000.png"}\n')
    with pytest.raises(FileFormatError, match="line 1: image holds a NUL"):
        read_frames(tmp_path / "m.jsonl")


@pytest.mark.parametrize("line", ["1.0 rgb/a\0.png", "9.0 rgb/a\0.png"])
def test_a_nul_in_a_path_of_any_other_list_is_one_line(tmp_path: Path, line: str) -> None:
    (tmp_path / "rgb.txt").write_text(f"{line}\n2.0 rgb/b.png\n")
    (tmp_path / "depth.txt").write_text("1.0 depth/a.png\n2.0 depth/b.png\n")
    with pytest.raises(FileFormatError, match=r"rgb/a\\0\.png: a file name holds a NUL"):
        read_frames(tmp_path)


def test_a_field_beyond_what_csv_takes_is_named(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("image\n" + "x" * 200_000 + "\n")
    with pytest.raises(FileFormatError, match="field larger than field limit"):
        read_frames(tmp_path / "m.csv")


@pytest.mark.parametrize("name", ["../a", "/a", "x/../../a"])
def test_a_name_that_leads_elsewhere_has_no_results(name: str) -> None:
    assert name_problem(name) == "leads out of the output folder"


def test_a_file_name_may_be_too_long_for_the_names_of_its_results() -> None:
    assert name_problem("n" * 240) == "is longer than 239 bytes"
    assert name_problem("C:con") is None  # a name that this system has


def test_millimetres_in_folders_called_as_synthias_are_not_its_centimetres(tmp_path: Path) -> None:
    for folder in ("RGB", "Depth"):
        (tmp_path / folder).mkdir()
        codes = np.full((480, 640), 1500, np.uint16)
        cv2.imwrite(str(tmp_path / folder / "0000001.png"), codes)
    assert not LAYOUTS["synthia"].matches(tmp_path)


def test_synthias_own_size_is_taken_for_it(tmp_path: Path) -> None:
    for folder in ("RGB", "Depth"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "0000001.png"), np.zeros((760, 1280), np.uint16))
    assert LAYOUTS["synthia"].matches(tmp_path)


@pytest.mark.parametrize("kind", ["external link", "soft link", "external storage"])
def test_an_array_in_another_file_is_refused(tmp_path: Path, kind: str) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["depth"] = np.ones((4, 4), np.float32)
    (tmp_path / "raw").write_bytes(np.ones((4, 4), np.float32).tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if kind == "external link":
            file["depth"] = h5py.ExternalLink("secret.h5", "depth")
        elif kind == "soft link":
            file["depth"] = h5py.SoftLink("/other/depth")
            file["other"] = h5py.ExternalLink("secret.h5", "/")
        else:
            raw = [(str(tmp_path / "raw"), 0, 64)]
            file.create_dataset("depth", shape=(4, 4), dtype="<f4", external=raw)
    with pytest.raises(FileFormatError, match="stored outside the file"):
        shape_of(tmp_path / "a.h5", "depth")


def test_an_hdf5_file_cannot_claim_more_values_than_it_can_hold(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("depth", shape=(10**5, 10**5), dtype="<f4", chunks=(100, 100))
    with pytest.raises(FileFormatError, match="10,000,000,000 values"):
        depth_of(Hdf5Array(path=tmp_path / "a.h5", name="depth", axes=(0, 1)))
