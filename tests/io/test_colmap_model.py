"""Sparse models of COLMAP in text and binary, whole, damaged and lying."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.colmap_model import MODELS, name_in_model, read_model
from pnpdepth_cli.sensors.lens import pixels_of
from tests.colmap_models import CAMERAS, write_binary_model, write_text_model

COLUMNS = ["number", "xyz", "error", "track"]


@pytest.fixture
def binary_model(tmp_path: Path) -> Path:
    """The folder of a binary model, two folders below `tmp_path`."""
    folder = tmp_path / "sparse" / "0"
    write_binary_model(folder)
    return folder


def test_a_model_is_found_in_its_folder_and_in_folders_above_it(binary_model: Path) -> None:
    for above in (binary_model.parents[1], binary_model.parent, binary_model):
        assert read_model(above).folder == binary_model


def test_a_folder_beside_the_model_is_refused(binary_model: Path) -> None:
    with pytest.raises(InputError):
        read_model(binary_model.parent / "1")


def test_the_camera_of_a_binary_model_is_read_as_written(binary_model: Path) -> None:
    camera = read_model(binary_model).images["dir/1.png"].camera
    assert (camera.source, camera.size) == ("SIMPLE_RADIAL camera", (48, 64))
    assert camera.intrinsics.tolist() == [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]
    assert (camera.lens, camera.distortion) == ("radial-tangential", (0.1, 0, 0, 0))


def test_the_pose_and_points_of_an_image_of_a_binary_model_are_read_as_written(
    binary_model: Path,
) -> None:
    image = read_model(binary_model).images["dir/2.png"]
    assert (image.pose.translation.tolist(), image.points.tolist()) == ([0.2, 0, 0], [7])


def test_the_points_of_a_binary_model_are_read_as_written(binary_model: Path) -> None:
    points = read_model(binary_model).points
    values = [points[name].tolist() for name in COLUMNS]
    assert values == [[7], [[0.5, -0.25, 4]], [0.75], [2]]


def test_a_text_model_is_read_as_written(tmp_path: Path) -> None:
    write_text_model(tmp_path, points=3)
    rows = "# comment\n\n7 1 2 3 9 8 7 0.5 1 0 2 0\n8 4 5 6 9 8 7 1\n"
    (tmp_path / "points3D.txt").write_text(rows)
    model = read_model(tmp_path)
    points = [[7, 8], [[1, 2, 3], [4, 5, 6]], [0.5, 1], [2, 0]]
    assert [model.points[name].tolist() for name in COLUMNS] == points
    assert model.images["b.png"].points.tolist() == [1, 2, 3]
    assert model.images["b.png"].pose.translation.tolist() == [0.1, 0, 0]


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_binary_file_cut_short_or_whose_counts_lie_is_one_line(part: str, tmp_path: Path) -> None:
    write_binary_model(tmp_path)
    file = tmp_path / f"{part}.bin"
    whole = file.read_bytes()
    counts = {"cameras": [0], "images": [0, 82], "points3D": [0, 51]}[part]
    lies = [whole[:at] + struct.pack("<Q", 2**40) + whole[at + 8 :] for at in counts]
    for content in [*lies, *(whole[:end] for end in range(1, len(whole)))]:
        file.write_bytes(content)
        with pytest.raises(InputError, match=f"^.*{file}.*$"):
            read_model(tmp_path)


IMAGE = "1 1 0 0 0 0 0 0 1 a.png\n"


@pytest.mark.parametrize(
    ("part", "text"),
    [
        ("cameras", "1 EQUIRECTANGULAR 64 32 64 32\n"),
        ("cameras", "5 PINHOLE 64 48 50 52 32 24\n"),
        ("cameras", "1 PINHOLE 64 48\n"),
        ("cameras", "\n\n1 PINHOLE 64 48 1 2 3 x\n"),
        ("images", f"{IMAGE}5 5 -1\n\n{IMAGE}"),
        ("images", f"{IMAGE}5 5\n"),
        ("images", "1 nan 0 0 0 0 0 0 1 a.png\n\n"),
        ("images", "1 0 0 0 0 0 0 0 1 a.png\n\n"),
        ("points3D", "# x\n7 1 2 3 9 8 7 0.5 1\n"),
    ],
)
def test_a_faulty_line_of_a_text_model_is_refused(part: str, text: str, tmp_path: Path) -> None:
    write_text_model(tmp_path)
    (tmp_path / f"{part}.txt").write_text(text)
    with pytest.raises(InputError):
        read_model(tmp_path)


@pytest.mark.parametrize("name", CAMERAS)
def test_points_project_as_in_pycolmap_for_every_camera_model(name: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_text_model(tmp_path, camera=name)
    ours = read_model(tmp_path).images["a.png"].camera
    theirs = pycolmap.Reconstruction(str(tmp_path)).cameras[1]
    assert (theirs.model.name, int(theirs.model)) == (name, MODELS[name][0])
    xy = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    points = np.column_stack([xy, np.ones(200)]) * 3
    expected = theirs.img_from_cam(points) - 0.5  # pixel centres are at .5 in COLMAP
    np.testing.assert_allclose(pixels_of(ours, points), expected, atol=1e-6)


def test_a_photo_is_found_by_the_longest_name_that_ends_its_path(tmp_path: Path) -> None:
    write_text_model(tmp_path, names=("left/1.png", "right/1.png", "2.png"))
    model = read_model(tmp_path)
    assert name_in_model(model, Path("/photos/right/1.png")) == "right/1.png"
    assert name_in_model(model, Path("anywhere/2.png")) == "2.png"
    for name in ("1.png", "9.png"):
        with pytest.raises(InputError):
            name_in_model(model, Path("/photos") / name)
