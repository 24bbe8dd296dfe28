"""COLMAP models as sparse depth, and the cameras that they and calibrations give a frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.dataset.arrays import camera_of_file
from pnpdepth_cli.dataset.frame_files import ReadOptions, ScanOptions
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.dataset.sparse_depth import read_colmap_points
from pnpdepth_cli.errors import InputError, NoPointsError, UsageError
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from tests.colmap_models import HEIGHT, WIDTH, write_text_model
from tests.commands.batches import batch, done, pairs_on_disk
from tests.commands.frames import FrameOnDisk, frame_on_disk, run
from tests.data_sets import image

PHOTOS = Path(__file__).parents[2] / "samples" / "photos"
METRES_PER_UNIT = 0.0876
"""Of the samples' model, found by comparison with their ground truth."""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project of three photos and a text model."""
    write_text_model(tmp_path / "sparse/0", names=("a.png", "b.png", "c.png"))
    for name in "abc":
        image(tmp_path / f"images/{name}.png", HEIGHT, WIDTH)
    return tmp_path


def read(project: Path, name: str = "a.png", **options: Any) -> Any:
    return read_colmap_points(project, project / "images" / name, (HEIGHT, WIDTH), **options)


def change(project: Path, file: str, old: str, new: str) -> None:
    path = project / "sparse" / "0" / file
    path.write_text(path.read_text().replace(old, new))


def refine(project: Path, output: str = "out", **changes: Any) -> FrameRecord:
    files = {"image": project / "images/a.png", "sparse": project / "sparse/0"}
    frame = frame_on_disk(project, HEIGHT, WIDTH)
    return run(frame, output=project / output, **(files | changes))


UNIT_SCALES = pytest.mark.parametrize("unit_scale", [None, 0.5])


@UNIT_SCALES
def test_depth_is_in_units_of_the_model_unless_metres_per_unit_are_stated(
    unit_scale: float | None, project: Path
) -> None:
    record = refine(project, unit_scale=unit_scale, method="alone", iterations=0)
    unit, align = ("model units", "scale") if unit_scale is None else ("m", "auto")
    assert (record.unit, record.refined().settings["align"]) == (unit, align)
    factor = unit_scale or 1.0
    assert (
        3.4
        < record.refined().points.nearest / factor
        < record.refined().points.farthest / factor
        < 4.6
    )


def test_a_depth_map_in_metres_has_256_codes_a_metre(project: Path) -> None:
    refine(project, unit_scale=0.5, method="alone", iterations=0)
    assert read_depth(project / "out/a_depth.png").reading.scale == 256


def test_a_depth_map_in_units_has_another_power_of_two_of_codes_a_unit(project: Path) -> None:
    refine(project, method="alone", iterations=0)
    scale = read_depth(project / "out/a_depth.png").reading.scale
    assert scale != 256
    assert np.log2(scale) % 1 == 0


@UNIT_SCALES
def test_a_photo_that_exif_turns_is_read_as_colmap_reads_it(
    unit_scale: float | None, project: Path
) -> None:
    upright = refine(project, unit_scale=unit_scale)
    photo = project / "images/a.png"
    with Image.open(photo) as opened:
        exif = opened.getexif()
        exif[0x0112] = 6
        opened.save(photo, exif=exif)
    turned = refine(project, "turned", unit_scale=unit_scale)
    assert turned.refined().size == upright.refined().size == (WIDTH, HEIGHT)
    assert turned.refined().points == upright.refined().points


@pytest.mark.parametrize("name", ["03", "04"])
def test_a_real_model_agrees_with_the_ground_truth_up_to_one_scale(name: str) -> None:
    truth = read_depth(PHOTOS / "gt" / f"{name}.png").values
    photo = PHOTOS / "images" / f"{name}.jpg"
    points = read_colmap_points(PHOTOS, photo, truth.shape, unit_scale=METRES_PER_UNIT).points
    assert len(points) > 100
    column, row = np.rint(points.xy).astype(int).T
    known = truth[row, column] > 0
    ratio = points.depth[known] / truth[row, column][known]
    assert np.median(ratio) == pytest.approx(1, abs=0.02)
    assert np.mean(np.abs(ratio - 1) < 0.05) > 0.7


def test_what_does_not_fit_a_model_is_refused(project: Path) -> None:
    frame = frame_on_disk(project, HEIGHT, WIDTH)
    with pytest.raises(UsageError, match="--unit-scale"):
        refine(project, gt=frame.gt)
    with pytest.raises(UsageError, match=r"s\.png is no COLMAP model"):
        run(frame, unit_scale=1.0)
    for scale in (0.0, np.inf, np.nan):
        with pytest.raises(UsageError, match="--unit-scale"):
            ReadOptions(unit_scale=scale)
    for size, why in (((WIDTH, HEIGHT), "turned by 90°"), ((WIDTH, 3 * WIDTH), "same view")):
        with pytest.raises(InputError, match=why):
            read_colmap_points(project, project / "images/a.png", size)
    change(project, "points3D.txt", " 9 9 9 0.5 ", " 9 9 9 5 ")
    with pytest.raises(NoPointsError):
        read(project)


def test_points_with_short_tracks_and_large_errors_are_dropped(project: Path) -> None:
    change(project, "points3D.txt", "9 9 9 0.5 1 0 2 0 3 0", "9 9 9 2.5 1 0 2 0 3 0")
    change(project, "points3D.txt", "9 9 9 0.5 1 1 2 1 3 1", "9 9 9 0.5 1 1 2 1")
    change(project, "points3D.txt", "9 9 9 0.5 1 2 2 2 3 2", "9 9 9 2 1 2 2 2 3 2")
    change(project, "images.txt", "5 5 -1", "5 5 99")  # a point that the model has no longer
    dropped = read(project).points.dropped
    assert dropped["seen in fewer than 3 images"] == 1
    assert dropped["with a reprojection error above 2 px"] == 1
    write_text_model(project / "two", names=("a.png", "b.png"))  # not asked for tracks of three
    pair = read_colmap_points(project / "two", Path("a.png"), (HEIGHT, WIDTH)).points
    assert pair.dropped["seen in fewer than 2 images"] == 0


@pytest.mark.parametrize("tracks", ["", "2 0 3 0 4 0"])
def test_an_image_without_tracks_has_all_visible_points(tracks: str, project: Path) -> None:
    # a fence of 12 × 9 points, 4 units ahead, and a wall of 11 × 8 points behind it
    x, y = np.meshgrid(np.arange(12) * 5 + 4.0, np.arange(9) * 5 + 4.0)
    front = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)])
    behind = front[(front[:, 0] < 58) & (front[:, 1] < 43)] + (2.5, 2.5, 8.0)
    pixels = np.concatenate([front, behind])
    xyz = np.column_stack([(pixels[:, :2] - (32, 22.5)) / (50, 52) * pixels[:, 2:], pixels[:, 2]])
    lines = [f"{n + 1} {' '.join(map(str, p))} 9 9 9 0.5 {tracks}\n" for n, p in enumerate(xyz)]
    (project / "sparse/0/points3D.txt").write_text("".join(lines))
    images = project / "sparse/0/images.txt"
    poses = [line for line in images.read_text().splitlines() if line.endswith(".png")]
    images.write_text("".join(f"{pose}\n\n" for pose in poses))
    sparse = read(project)
    np.testing.assert_allclose(sparse.points.depth, 4)
    assert {tuple(xy) for xy in sparse.points.xy.round(3).tolist()} == set(map(tuple, front[:, :2]))
    assert sparse.points.dropped["hidden by foreground"] == len(behind)
    assert any("no tracks" in note for note in sparse.notes)


def test_points_behind_the_camera_are_counted_or_refused(project: Path) -> None:
    points = project / "sparse/0/points3D.txt"
    lines = points.read_text().splitlines()
    for index, z in enumerate(("-4", "0", "0.5"), start=1):
        number, _, _, _, *rest = lines[index].split()
        lines[index] = " ".join([number, "0", "0", z, *rest])
    points.write_text("\n".join(lines))
    seen = read(project).points
    assert (seen.dropped["behind the camera"], seen.depth.min()) == (2, 0.5)
    change(project, "images.txt", "1 1 0 0 0 0.0 0 0 1", "1 1 0 0 0 0.0 0 -9 1")
    with pytest.raises(InputError, match=r"all 40 points of 'a\.png' .* are behind its camera"):
        read(project)


def test_images_of_mixed_cameras_have_each_their_own(project: Path) -> None:
    cameras = project / "sparse/0/cameras.txt"
    cameras.write_text(f"{cameras.read_text()}2 SIMPLE_PINHOLE 32 24 25 16.25 11.5\n")
    change(project, "images.txt", "2 1 0 0 0 0.1 0 0 1 b.png", "2 1 0 0 0 0.1 0 1 2 b.png")
    small = read(project, "b.png")
    np.testing.assert_allclose(small.pose, [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, -1]])
    assert small.points.size == read(project).points.size
    assert any("32×24" in note and "64×48" in note for note in small.notes)


def test_each_registered_photo_of_the_largest_model_is_a_frame(project: Path) -> None:
    image(project / "images/new.png")
    (project / "images/c.png").unlink()
    write_text_model(project / "sparse/1", names=("d.png",))
    layout, frames, unmatched = list_frames(project)
    assert (layout, [frame.name for frame in frames]) == ("colmap", ["a", "b"])
    assert frames[1].pose == ((1, 0, 0, -0.1), (0, 1, 0, 0), (0, 0, 1, 0))
    lost = [path.relative_to(project).as_posix() for path, _ in unmatched]
    assert lost == ["images/new.png", "sparse/1", "images/c.png"]


CALIB = "K: [50, 0, 30, 0, 50, 20, 0, 0, 1]\n"


def test_a_calibration_beside_a_depth_map_is_that_of_the_camera(frame: FrameOnDisk) -> None:
    calib = frame.folder / "k.txt"
    calib.write_text(f"{CALIB}distortion: [-0.1, 0, 0, 0]\n")
    record = run(frame, scan=ScanOptions(calib=calib))
    assert record.refined().camera.intrinsics == [[50, 0, 30], [0, 50, 20], [0, 0, 1]]
    assert record.refined().camera.distortion == [-0.1, 0, 0, 0]
    calib.write_text(f"{CALIB}size: [64, 48]\n")
    with pytest.raises(InputError, match=r"\b64×48"):
        run(frame, scan=ScanOptions(calib=calib), overwrite=True)


def test_exif_is_used_where_nothing_else_gives_the_camera_of_a_view(frame: FrameOnDisk) -> None:
    opened = Image.open(frame.image)
    photo = frame.folder / "img.jpg"
    exif = opened.getexif()
    exif[0x8769] = {0xA405: 26}
    opened.save(photo, exif=exif)
    record = run(replace(frame, image=photo), view_3d=True)
    assert " 26 mm" in record.refined().camera.source
    assert any("no distortion (EXIF" in note for note in record.notes)


def test_the_camera_of_a_part_sees_the_same_directions(tmp_path: Path) -> None:
    part = FramePart(halved=True, crop=(20, 30), anchor="bottom")
    frame = frame_on_disk(tmp_path, 60, 80)
    calib = tmp_path / "k.txt"
    calib.write_text(CALIB)
    record = run(frame, part=part, scan=ScanOptions(calib=calib))
    camera, _ = record.refined().camera.read()
    whole, _ = camera_of_file(calib, None, (60, 80))
    xy = np.array([[33, 41], [50, 47]], np.float32)
    rays = unproject(whole, xy, np.ones(2))
    points = part.points_in_crop(SparsePoints(xy=xy, depth=xy[:, 0], size=(60, 80)))
    assert pixels_of(camera, rays) == pytest.approx(points.xy, abs=1e-4)


def test_a_batch_records_the_cameras_of_its_frames(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path, ("a",))
    with pytest.raises(UsageError, match="--calib"):
        batch(root, html=tmp_path.parent / "report", html_3d=True)
    for focal_px in ("50", "60"):  # another calibration makes the frame new
        (root / "calib.txt").write_text(CALIB.replace("50", focal_px))
        assert done(root) == ["a"]
    record = FrameRecord.read(root / "out/a.json")
    assert record.refined().camera.intrinsics[0][0] == 60
