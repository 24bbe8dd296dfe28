"""`pnpdepth cloud` writes one cloud of the depth maps it is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.commands.cloud import write_depth_cloud
from pnpdepth_cli.commands.requests.cloud_request import CloudRequest
from pnpdepth_cli.dataset.frame_record import CameraRecord, FrameRecord
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.scans import read_scan
from tests.builders import result_record

HEIGHT, WIDTH = 24, 32
STILL = "1 0 0 0 0 1 0 0 0 0 1 0\n"


def frame(folder: Path, name: str, depth: float = 2.0, **entries: Any) -> Path:
    """A depth file as `refine` writes it, with its image and these entries of its result."""
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}_depth.png"
    write_depth(path, np.full((HEIGHT, WIDTH), depth, np.float32))
    image = folder / f"{name}.png"
    cv2.imwrite(str(image), np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8))
    record = FrameRecord(
        inputs={"image": FileRecord(path=str(image), kind="image")},
        result=result_record(size=(WIDTH, HEIGHT), **entries),
    )
    record.write(folder / f"{name}.json")
    return path


def camera(right: float | None) -> CameraRecord:
    """A camera that is so far to the right in the world; None: its pose is unknown."""
    pose = None if right is None else [[1.0, 0, 0, right], [0, 1, 0, 0], [0, 0, 1, 0]]
    lens = "radial-tangential"
    intrinsics = [[20.0, 0, 0], [0, 20, 0], [0, 0, 1]]
    return CameraRecord(intrinsics=intrinsics, lens=lens, source="of the test", pose=pose)


def points_of(path: Path) -> np.ndarray:
    return read_scan(path)[0][:, :3]


def written(path: Path, output: Path, **values: Any) -> tuple[int, str]:
    """The number of points in the cloud, and all that is said."""
    calib = output.parent / "k.txt"
    calib.write_text(f"30 0 {WIDTH / 2} 0 30 {HEIGHT / 2} 0 0 1\n")
    request = CloudRequest(**({"depth": path, "output": output, "calib": calib} | values))
    what, notes = write_depth_cloud(request)
    count = len(points_of(output))
    assert what.startswith(f"{count:,} points")
    return count, " ".join([what, *notes])


def test_the_camera_and_the_pose_come_from_the_record(tmp_path: Path) -> None:
    path = frame(tmp_path, "a", camera=camera(5))
    assert "of the test" in written(path, tmp_path / "a.ply", calib=None)[1]
    last = [5 + 2 * (WIDTH - 1) / 20, 2 * (HEIGHT - 1) / 20, 2]
    assert points_of(tmp_path / "a.ply")[-1] == pytest.approx(last)


def test_a_cloud_is_replaced_only_if_asked(tmp_path: Path) -> None:
    path = frame(tmp_path, "a")
    written(path, tmp_path / "a.ply")
    with pytest.raises(OutputError, match="--overwrite"):
        written(path, tmp_path / "a.ply")


def test_a_calibration_that_is_given_places_every_pixel(tmp_path: Path) -> None:
    path = frame(tmp_path, "b")
    assert written(path, tmp_path / "b.ply")[0] == HEIGHT * WIDTH
    corner = [-WIDTH / 2 / 15, -HEIGHT / 2 / 15, 2]  # by the calibration of `written`
    assert points_of(tmp_path / "b.ply")[0] == pytest.approx(corner, rel=1e-5)


def test_points_have_the_colours_of_the_image_that_the_record_names(tmp_path: Path) -> None:
    path = frame(tmp_path, "b")
    written(path, tmp_path / "b.ply")
    row = (tmp_path / "b.ply").read_bytes().split(b"end_header\n")[1][:27]
    assert list(row[24:27]) == [30, 20, 10]  # OpenCV wrote blue, green, red


def test_an_image_that_is_not_there_is_named_with_the_folder_it_was_looked_for_from(
    tmp_path: Path,
) -> None:
    path = frame(tmp_path, "b")
    (tmp_path / "b.png").unlink()
    said = written(path, tmp_path / "lost.ply")[1]
    assert "b.png" in said
    assert str(Path.cwd()) in said


def far_wall(folder: Path) -> tuple[Path, np.ndarray]:
    """A file of depth from 2 to 8 m, with a far plane in the first five rows."""
    depth = np.linspace(2, 8, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    depth[:5] = 1e10
    write_depth(folder / "d.exr", depth)
    return folder / "d.exr", depth


def test_a_far_plane_is_no_part_of_a_cloud(tmp_path: Path) -> None:
    path, _ = far_wall(tmp_path)
    count, said = written(path, tmp_path / "d.ply")
    assert count == (HEIGHT - 5) * WIDTH
    assert "far plane" in said
    assert "without colours" in said


def test_pixels_beyond_the_largest_depth_are_left_out(tmp_path: Path) -> None:
    path, depth = far_wall(tmp_path)
    assert written(path, tmp_path / "e.ply", max_depth=5)[0] == (depth <= 5).sum()


def test_pixels_that_are_not_valid_or_not_sure_are_left_out(tmp_path: Path) -> None:
    path = frame(tmp_path, "a", outputs={"sigma": "a_sigma.png", "valid": "a_valid.png"})
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[:4] = 0
    cv2.imwrite(str(tmp_path / "a_valid.png"), valid)
    sigma = np.full((HEIGHT, WIDTH), 0.05, np.float32)
    sigma[:, :8] = 0.5
    write_depth(tmp_path / "a_sigma.png", sigma)
    assert written(path, tmp_path / "a.ply")[0] == (HEIGHT - 4) * WIDTH
    assert written(path, tmp_path / "b.ply", max_sigma=0.1)[0] == (HEIGHT - 4) * (WIDTH - 8)


def test_frames_are_one_cloud_in_which_views_agree_and_voxels_merge(tmp_path: Path) -> None:
    out, cloud, poses = tmp_path / "out", tmp_path / "o.ply", tmp_path / "poses.txt"
    for name, depth in (("a", 2.0), ("b", 2.0), ("c", 3.0)):
        frame(out, name, depth)
    # Three cameras at one place, of which one is wrong.
    poses.write_text(3 * STILL)
    asked = {"poses": poses, "overwrite": True}
    for views, agreed in ((1, 3), (2, 2)):
        assert written(out, cloud, min_views=views, **asked)[0] == agreed * HEIGHT * WIDTH
    with pytest.raises(UsageError, match="--min-views 4 needs as many frames with poses"):
        written(out, cloud, min_views=4, **asked)
    # The second one is far to the right.
    poses.write_text(STILL + "1 0 0 100 0 1 0 0 0 0 1 0\n" + STILL)
    assert written(out, cloud, **asked)[0] == 3 * HEIGHT * WIDTH
    points = points_of(cloud)
    first, second, _ = np.split(points, 3)
    assert second == pytest.approx(first + np.array([100, 0, 0]), abs=1e-4)
    merged = written(out, cloud, voxel=0.5, **asked)[0]
    assert merged == len(np.unique(np.floor(points / 0.5), axis=0))


def test_what_cannot_be_done_is_an_error_and_writes_nothing(tmp_path: Path) -> None:
    out, cloud = tmp_path / "out", tmp_path / "o.ply"
    frame(out, "a", camera=camera(5))
    b = frame(out, "b", camera=camera(None))
    c = frame(tmp_path, "c")
    big, resized = tmp_path / "big.png", tmp_path / "c_depth.exr"
    cv2.imwrite(str(big), np.zeros((HEIGHT * 2, WIDTH, 3), np.uint8))
    write_depth(resized, np.ones((HEIGHT // 2, WIDTH // 2), np.float32))
    cases: list[tuple[Path, dict[str, Any], type[Exception], str]] = [
        (c, {"calib": None}, UsageError, "--calib"),
        (c, {"max_depth": 0.5}, InputError, "c_depth"),
        (c, {"min_views": 2}, UsageError, "--min-views"),
        (c, {"max_sigma": 0.1}, InputError, "c"),
        (out, {"calib": None}, InputError, "b_depth"),  # it alone has no pose
        (out, {"image": big}, UsageError, "--image"),
        (b, {"image": big}, InputError, "--image"),
        (resized, {}, InputError, "c_depth"),
    ]
    for path, values, error, named in cases:
        with pytest.raises(error, match=named):
            written(path, cloud, **values)
    assert not cloud.exists()
