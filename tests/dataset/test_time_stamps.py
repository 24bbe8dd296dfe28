"""Times in the names of an image and its depth."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from pnpdepth_cli.dataset.time_stamps import time_of, time_warning
from tests.data_sets import touch


@pytest.mark.parametrize(
    ("name", "time_s"),
    [
        ("1305031102.175304.png", 1305031102.175304),  # TUM RGB-D
        ("1403636579763555584.png", 1403636579.763555584),  # EuRoC
        ("n015-2018__LIDAR_TOP__1532402927647951.pcd.bin", 1532402927.647951),  # nuScenes
        ("depth_1532402927647.png", 1532402927.647),
        ("41069021_305.244.png", 305.244),  # ARKitScenes
        ("0000000005.png", None),  # KITTI
        ("frame-000010.color.jpg", None),
        ("2011_09_26_drive_0002_sync_image_0000000005_image_02.png", None),
        ("v1.25.png", None),
    ],
)
def test_a_name_says_a_time_where_it_is_a_stamp(name: str, time_s: float | None) -> None:
    found = time_of(Path(name))
    assert found == (None if time_s is None else pytest.approx(time_s, abs=1e-6))


def warned(folder: Path, image_s: float, depth_s: float, others: tuple[float, ...] = ()) -> bool:
    image = folder / f"rgb/{image_s:.6f}.png"
    depth = folder / f"depth/{depth_s:.6f}.png"
    touch(image, depth, *(folder / f"depth/{other:.6f}.png" for other in others))
    return time_warning(image, depth) is not None


@pytest.mark.parametrize(
    ("apart_s", "is_warned"),
    [(0.0, False), (0.015, False), (-0.019, False), (0.025, True), (-0.3, True), (1e9, False)],
)
def test_depth_of_another_moment_is_told_of_frames_33_ms_apart(
    apart_s: float, is_warned: bool, tmp_path: Path
) -> None:
    of_depth = tuple(100 + apart_s + step / 30 for step in range(-3, 4))
    assert warned(tmp_path, 100.0, 100.0 + apart_s, of_depth) is is_warned


@pytest.mark.parametrize(("apart_s", "is_warned"), [(0.05, False), (0.07, True)])
def test_alone_in_its_folder_depth_is_taken_for_a_lidars(
    apart_s: float, is_warned: bool, tmp_path: Path
) -> None:
    assert warned(tmp_path, 100.0, 100.0 + apart_s) is is_warned


def test_the_time_of_a_scan_may_be_that_of_its_end(tmp_path: Path) -> None:
    image = tmp_path / "cam/1532402927612460.jpg"
    scans = [tmp_path / f"lidar/{1532402927647951 + 50_000 * n}.pcd.bin" for n in range(-2, 3)]
    touch(image, *scans)
    assert time_warning(image, scans[2]) is None
    later = time_warning(image, scans[4])
    assert later is not None
    assert "nearer" in later


def test_the_folder_of_depth_is_listed_once_for_all_frames_of_a_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = [tmp_path / f"rgb/{100 + step / 30:.6f}.png" for step in range(20)]
    depths = [tmp_path / f"depth/{100.025 + step / 30:.6f}.png" for step in range(20)]
    touch(*images, *depths)
    listed = list[Path]()
    list_folder = Path.iterdir

    def counted(folder: Path) -> Iterator[Path]:
        listed.append(folder)
        return list_folder(folder)

    monkeypatch.setattr(Path, "iterdir", counted)
    warnings = [time_warning(image, depth) for image, depth in zip(images, depths, strict=True)]
    assert None not in warnings
    assert listed == [tmp_path / "depth"]


def test_a_folder_that_grew_is_listed_again(tmp_path: Path) -> None:
    image = tmp_path / "rgb/100.000000.png"
    depth = tmp_path / "depth/100.070000.png"
    touch(image, depth)
    assert "nearer" not in str(time_warning(image, depth))
    touch(tmp_path / "depth/100.010000.png")
    changed_ns = depth.parent.stat().st_mtime_ns + 1_000_000_000
    os.utime(depth.parent, ns=(changed_ns, changed_ns))
    assert "100.010000.png is nearer" in str(time_warning(image, depth))
