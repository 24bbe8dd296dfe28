"""Numbers from sensors that were read wrongly without a word, made from the samples by formula.

The right points are computed here: P2 · (Tr · x) of the calibration for a scan, the file's own
codes for a map.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from PIL import Image

from pnpdepth_cli.commands.eval import evaluate
from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.commands.sample import sample_depth
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, ScanOptions
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import InputError, NoPointsError, UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.refiner import frame_of_arrays

STREET = Path(__file__).parents[2] / "samples" / "street"
INDOOR = STREET.parent / "indoor"
SIZE = (375, 1242)
Rows = NDArray[np.float32]


@pytest.fixture(scope="module")
def scan() -> Rows:
    """(N, 4) x y z reflectance of every fourth point of the sample."""
    return np.fromfile(STREET / "000000.bin", "<f4").reshape(-1, 4)[::4]


def matrix(name: str) -> NDArray[np.float64]:
    rows = dict(line.split(":") for line in (STREET / "calib.txt").read_text().split("\n") if line)
    return np.array(rows[name].split(), float).reshape(3, 4)


def seen(xyz: NDArray[Any]) -> NDArray[np.float64]:
    """(M, 3) u, v and z of all points in the image, the nearest of each pixel, sorted by pixel."""
    whole = matrix("P2") @ np.vstack([matrix("Tr_velo_to_cam"), [0, 0, 0, 1]])
    rows = xyz @ whole[:, :3].T + whole[:, 3]
    rows = rows[rows[:, 2] > 0]
    rows[:, :2] /= rows[:, 2:]
    rows = rows[np.argsort(rows[:, 2])]
    pixel = np.floor(rows[:, :2] + 0.5)
    inside = ((pixel >= 0) & (pixel < SIZE[::-1])).all(axis=1)
    index = pixel[inside] @ (1, SIZE[1])
    return rows[inside][np.unique(index, return_index=True)[1]]


def read(
    sparse: Path,
    calib: Path | None = STREET / "calib.txt",
    gt: Path | None = None,
    image: Path = STREET / "rgb.png",
    **options: Any,
) -> Frame:
    scan = ScanOptions(calib=calib, keep_occluded=True)
    files = FrameFiles(image=image, sparse=sparse, gt=gt)
    return read_frame(files, ReadOptions(**({"scan": scan} | options)))


def same_points(sparse: Path, xyz: NDArray[Any], **options: Any) -> Frame:
    """The frame of a scan, whose points are those of the rows."""
    frame = read(sparse, **options)
    rows = np.column_stack([frame.points.xy.numpy(), frame.points.depth.numpy()])
    got = rows[np.argsort(np.floor(rows[:, :2] + 0.5) @ (1, SIZE[1]))]
    np.testing.assert_allclose(got, seen(np.asarray(xyz, float)), rtol=1e-4, atol=2e-3)
    return frame


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("cut", [0, 1, 2, 3])
@pytest.mark.parametrize("count", range(3, 9))
def test_a_bin_of_any_number_of_fields_has_the_same_points(
    tmp_path: Path, scan: Rows, count: int, cut: int, shuffled: bool
) -> None:
    scan = scan[cut:]  # so that other counts divide its size
    rng = np.random.default_rng(0)
    reflectance = scan[:, 3]
    number = np.arange(len(scan))
    zero = 0 * number
    ring = number // 175 % 64
    fields = {
        3: [],
        4: [reflectance],
        5: [np.rint(255 * reflectance), ring],
        6: [np.tanh(reflectance), rng.gamma(0.3, 0.3, len(scan)), zero],  # Waymo, mmdetection3d
        7: [reflectance, *rng.integers(0, 256, (3, len(scan)))],  # and red, green, blue
        8: [zero + 1, reflectance, ring, number * 2.3e-6, zero],  # as PCL pads points
    }
    rows = np.column_stack([scan[:, :3], *fields[count]])
    order = rng.permutation(len(scan)) if shuffled else number
    rows[order].astype("<f4").tofile(tmp_path / "a.bin")
    same_points(tmp_path / "a.bin", scan[:, :3])


def write_list(path: Path, rows: NDArray[Any]) -> None:
    if path.suffix == ".npy":
        np.save(path, rows)
    else:
        np.savetxt(path, rows, delimiter="," if path.suffix == ".csv" else " ")


@pytest.mark.parametrize("name", ["a.npy", "a.txt", "a.csv"])
@pytest.mark.parametrize("columns", [3, 4])
def test_a_list_is_a_scan_or_of_pixels(tmp_path: Path, scan: Rows, name: str, columns: int) -> None:
    write_list(tmp_path / name, scan[:, :columns])
    same_points(tmp_path / name, scan[:, :3])
    with pytest.raises(InputError, match="--calib"):
        read(tmp_path / name, calib=None)
    rows = np.random.default_rng(0).uniform(1, 300, (50, 3))
    if name != "a.csv":
        write_list(tmp_path / name, rows)
        np.testing.assert_allclose(read(tmp_path / name).points.xy, rows[:, :2], rtol=1e-6)
        write_list(tmp_path / name, rows * (1, 1, 1000))
        in_mm = read(tmp_path / name, depth_scale=1000.0).points
        np.testing.assert_allclose(in_mm.depth, rows[:, 2], rtol=1e-6)


@pytest.mark.parametrize("silent", [0.0, np.nan, [1.2, 0.0, 0.9], [0.0, 0.0, 1e10]])
def test_silent_beams_are_noted(tmp_path: Path, scan: Rows, silent: float | list[float]) -> None:
    rows = np.concatenate([scan, np.zeros((9000, 4))])
    rows[-9000:, :3] = silent
    rows = rows[np.random.default_rng(0).permutation(len(rows))].astype("<f4")
    rows.tofile(tmp_path / "a.bin")
    frame = same_points(tmp_path / "a.bin", scan[:, :3])
    assert 9000 in frame.sources["sparse"].dropped.values()
    assert any("9,000 of" in note for note in frame.notes)


def test_a_scan_in_millimetres_stops_and_is_read_by_the_option(tmp_path: Path, scan: Rows) -> None:
    np.save(tmp_path / "a.npy", 1000 * scan[:, :3])
    with pytest.raises(InputError, match="--depth-scale 1000"):
        read(tmp_path / "a.npy")
    gt = STREET / "gt.png"  # which states its own scale
    frame = same_points(tmp_path / "a.npy", scan[:, :3], depth_scale=1000.0, gt=gt)
    np.testing.assert_allclose(frame.gt, codes_of(gt) / 256, rtol=1e-6)


def codes_of(path: Path) -> NDArray[np.float64]:
    return np.asarray(Image.open(path)).astype(np.float64)


@pytest.mark.parametrize("far", [1e10, 65504, 10000, 1000])
def test_a_far_plane_is_neither_scored_nor_sampled_nor_a_point(tmp_path: Path, far: float) -> None:
    truth = codes_of(STREET / "gt.png") / 256
    prediction, gt, sparse = (tmp_path / f"{name}.npy" for name in ("prediction", "gt", "sparse"))
    np.save(prediction, np.where(truth > 0, truth + 0.25, 50).astype(np.float32))
    np.save(gt, np.where(truth > 0, truth, far).astype(np.float32))
    result = evaluate(EvalRequest(prediction=prediction, ground_truth=gt))
    assert result.mean["mae"] == pytest.approx(0.25, abs=1e-5)
    assert result.counts["pixels"] == np.count_nonzero(truth)
    assert any(f"{np.count_nonzero(truth == 0):,} of" in note for note in result.notes)
    drawn, _, _ = sample_depth(gt, tmp_path / "drawn.npy", SamplePattern(count=3000))
    assert drawn.depth.max() <= truth.max()
    depth = codes_of(STREET / "sparse.png") / 256
    depth[:40, ::7] = far
    np.save(sparse, depth.astype(np.float32))
    assert len(read(sparse).points) == np.count_nonzero((depth > 0) & (depth < far))


def warnings_of(sparse: Path = STREET / "000000.bin", **scan: Any) -> list[str]:
    options = ScanOptions(calib=STREET / "calib.txt", **scan)
    return [note for note in read(sparse, scan=options).notes if note.startswith("warning: ")]


@pytest.mark.parametrize("axis", [1, 2])
def test_a_mirrored_scan_is_warned_of_with_the_better_reading(axis: int, tmp_path: Path) -> None:
    mirrored = np.fromfile(STREET / "000000.bin", "<f4").reshape(-1, 4)
    mirrored[:, axis] *= -1
    mirrored.tofile(tmp_path / "mirrored.bin")
    (warning,) = warnings_of(tmp_path / "mirrored.bin")
    assert f"with {'xyz'[axis]} of the scan negated" in warning


def test_a_calibration_that_the_image_contradicts_is_warned_of(tmp_path: Path) -> None:
    assert warnings_of() == []
    (warning,) = warnings_of(camera=1)
    assert "with --camera 2" in warning
    turn = cv2.Rodrigues(np.radians([0.0, 2, 0]))[0]  # about the camera's y
    turned = tmp_path / "turned.txt"
    mirrored = tmp_path / "mirrored.txt"
    pose = matrix("Tr_velo_to_cam")
    np.savetxt(turned, np.column_stack([turn @ pose[:, :3], pose[:, 3]]))
    (warning,) = warnings_of(extrinsics=turned)
    about = [float(text) for text in re.findall(r"(-?[\d.]+)°", warning)]
    assert about == pytest.approx([0, -2, 0], abs=0.3)
    np.savetxt(mirrored, pose * (1, -1, 1, 1))
    with pytest.raises(InputError, match="determinant −1"):
        warnings_of(extrinsics=mirrored)


def test_a_valid_calibration_is_not_warned_of_for_beams_without_return(tmp_path: Path) -> None:
    whole = np.fromfile(STREET / "000000.bin", "<f4").reshape(-1, 4)
    silent = np.zeros((3 * len(whole), 4), "<f4")
    np.concatenate([silent, whole]).tofile(tmp_path / "silent.bin")
    np.savetxt(tmp_path / "pose.txt", matrix("Tr_velo_to_cam"))
    assert warnings_of(tmp_path / "silent.bin", extrinsics=tmp_path / "pose.txt") == []


def indoor(
    sparse: Path, mask: Path | None = None, least: float | None = None, **files: Any
) -> Frame:
    asked = {"sparse": sparse, "sparse_mask": mask, "min_confidence": least}
    options = ReadOptions(sparse_range=files.pop("sparse_range", False))
    return read_frame(FrameFiles(image=INDOOR / "rgb.png", **asked, **files), options)


@pytest.mark.parametrize(
    ("suffix", "of"), [(".png", 2), (".png", 255), (".npy", 2), (".npy", 255), (".exr", 1)]
)
def test_only_depth_of_enough_confidence_is_used(tmp_path: Path, suffix: str, of: int) -> None:
    rng = np.random.default_rng(0)
    truth = codes_of(INDOOR / "gt.png") / 1000
    small = truth[1::4, 1::4].copy()  # of a phone, a quarter of the image's size
    confidence = rng.integers(0, 3, small.shape)
    small[confidence < 2] *= rng.uniform(0.5, 2, (confidence < 2).sum())
    np.save(tmp_path / "sparse.npy", small.astype(np.float32))
    stored = (confidence * of / 2).astype(np.float32 if suffix == ".exr" else np.uint8)
    path = tmp_path / f"confidence{suffix}"
    if suffix == ".exr":
        OpenEXR.File({}, {"Z": stored}).write(str(path))
    elif suffix == ".npy":
        np.save(path, stored)
    else:
        Image.fromarray(stored).save(path)
    sparse = tmp_path / "sparse.npy"
    frame = indoor(sparse, path, of)
    assert len(frame.points) == np.count_nonzero((confidence == 2) & (small > 0))
    column, row = frame.points.xy.numpy().round().astype(int).T
    expected = truth[1::4, 1::4][row // 4, column // 4]
    np.testing.assert_allclose(frame.points.depth, expected, rtol=1e-6)
    assert any(f"{len(frame.points):,} of" in note for note in frame.notes)
    for least in (None, float(stored[stored > 0].min())):
        assert len(indoor(sparse, path, least).points) == np.count_nonzero(confidence)
    assert len(indoor(sparse, path, 0).points) == np.count_nonzero(small)
    with pytest.raises(NoPointsError):
        indoor(sparse, path, of + 1)
    with pytest.raises(UsageError):
        indoor(sparse, None, of)


def test_a_mask_is_no_depth_and_is_said_where_it_is_not_used(tmp_path: Path) -> None:
    np.save(tmp_path / "mask.npy", np.arange(640) < np.full((480, 1), 320))
    frame = indoor(INDOOR / "sparse.png", tmp_path / "mask.npy")
    assert len(frame.points) == np.count_nonzero(codes_of(INDOOR / "sparse.png")[:, :320])
    with pytest.raises(InputError, match=r"mask\.npy"):
        indoor(tmp_path / "mask.npy")
    frame = indoor(INDOOR / "sparse.png", masks=(tmp_path / "mask.npy",))  # of no ground truth
    assert any("sparse_mask" in note for note in frame.notes)


def test_distances_from_a_wide_camera_become_depth(tmp_path: Path) -> None:
    truth = codes_of(INDOOR / "sparse.png") / 1000
    x = (np.arange(640) - 319.5) / 320  # 90° across
    y = (np.arange(480) - 239.5) / 320
    length = np.sqrt(1 + x**2 + y[:, None] ** 2)
    assert length.max() == pytest.approx(1.6, abs=0.01)  # 60 % in the corners
    np.save(tmp_path / "distance.npy", (truth * length).astype(np.float32))
    (tmp_path / "calib.txt").write_text("K: [320, 0, 319.5, 0, 320, 239.5, 0, 0, 1]")
    asked = {"sparse": tmp_path / "distance.npy", "sparse_range": True}
    frame = indoor(**asked, calib=tmp_path / "calib.txt")
    column, row = frame.points.xy.numpy().astype(int).T
    assert len(frame.points) == np.count_nonzero(truth)
    np.testing.assert_allclose(frame.points.depth, truth[row, column], rtol=1e-6)
    with pytest.raises(UsageError, match="--calib"):
        indoor(**asked)
    with pytest.raises(UsageError, match="no depth map or list"):
        read(STREET / "000000.bin", sparse_range=True)


@pytest.mark.parametrize("name", ["a.npy", "a.png", "list.npy"])
@pytest.mark.parametrize(("kind", "factor"), [("inverse", 1.0), ("disparity:52.5", 52.5)])
def test_disparity_and_inverse_depth_become_depth(
    name: str, kind: str, factor: float, tmp_path: Path
) -> None:
    truth = codes_of(INDOOR / "sparse.png") / 1000
    stored = np.divide(factor, truth, out=np.zeros(truth.shape), where=truth > 0)
    options: dict[str, Any] = {"sparse_kind": kind}
    row, column = np.nonzero(truth)
    if name == "a.png":
        cv2.imwrite(str(tmp_path / name), np.rint(400 * stored).astype(np.uint16))
        options["depth_scale"] = 400.0
    elif name == "a.npy":
        np.save(tmp_path / name, stored.astype(np.float32))
    else:
        np.save(tmp_path / name, np.column_stack([column, row, stored[row, column]]))
    frame = read(tmp_path / name, calib=None, image=INDOOR / "rgb.png", **options)
    column, row = frame.points.xy.numpy().astype(int).T
    np.testing.assert_allclose(frame.points.depth, truth[row, column], rtol=2e-2)
    assert len(frame.points) == np.count_nonzero(truth)


@pytest.mark.parametrize(("factor", "advice"), [(1.0, "inverse"), (386.0, "disparity:386")])
def test_depth_of_the_opposite_order_is_refused_with_what_reads_it(
    factor: float, advice: str, tmp_path: Path
) -> None:
    truth = codes_of(INDOOR / "gt.png") / 1000
    np.save(tmp_path / "truth.npy", truth.astype(np.float32))
    some = np.where(np.random.default_rng(0).uniform(size=truth.shape) < 0.01, truth, 0)
    stored = np.divide(factor, some, out=np.zeros(some.shape), where=some > 0)
    np.save(tmp_path / "a.npy", stored.astype(np.float32))
    with pytest.raises(InputError, match=advice):
        read(tmp_path / "a.npy", None, tmp_path / "truth.npy", image=INDOOR / "rgb.png")


def test_what_a_kind_does_not_apply_to_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--sparse-kind"):
        read(STREET / "000000.bin", sparse_kind="inverse")
    for kind in ("disparity", "disparity:0", "z", "disparity:x"):
        with pytest.raises(UsageError, match="--sparse-kind"):
            ReadOptions(sparse_kind=kind)
    both = {"sparse_kind": "inverse", "sparse_range": True}
    with pytest.raises(UsageError, match="--sparse-kind"):
        read(INDOOR / "sparse.png", image=INDOOR / "rgb.png", **both)


def test_an_image_of_16_bits_that_holds_8_is_read_as_of_8(tmp_path: Path) -> None:
    pixels = np.asarray(Image.open(INDOOR / "rgb.png")).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "rgb.png"), pixels[:, :, ::-1])
    image = read_rgb(tmp_path / "rgb.png")
    np.testing.assert_allclose(image.values, pixels / 255, atol=1e-6)
    assert image.note is not None
    frame = frame_of_arrays(pixels, codes_of(INDOOR / "sparse.png") / 1000)
    np.testing.assert_allclose(frame.image, pixels / 255, atol=1e-6)


def test_extrinsics_with_kittis_calibration_are_rectified_too(tmp_path: Path, scan: Rows) -> None:
    turn = cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0]
    np.savetxt(tmp_path / "pose.txt", turn.T @ matrix("Tr_velo_to_cam"))  # of the unrectified one
    rows = {"P2": matrix("P2"), "R0_rect": turn, "Tr_velo_to_cam": np.eye(3, 4)}
    lines = [f"{name}: {' '.join(map(str, row.ravel()))}" for name, row in rows.items()]
    (tmp_path / "calib.txt").write_text("\n".join(lines))
    np.save(tmp_path / "a.npy", scan[:, :3])
    given = {"calib": tmp_path / "calib.txt", "extrinsics": tmp_path / "pose.txt"}
    same_points(tmp_path / "a.npy", scan[:, :3], scan=ScanOptions(keep_occluded=True, **given))


@pytest.mark.parametrize(("part", "least"), [(0.5, None), (0.5, 1.0), (1.0, None), (1.0, 1.0)])
def test_a_confidence_that_is_no_number_counts_as_none_and_is_said(
    tmp_path: Path, part: float, least: float | None
) -> None:
    confidence = np.full((240, 320), 2, np.float32)  # of half the size
    confidence[: round(240 * part)] = np.nan
    np.save(tmp_path / "confidence.npy", confidence)
    if part == 1:
        with pytest.raises(NoPointsError, match="no number; use another mask"):
            indoor(INDOOR / "sparse.png", tmp_path / "confidence.npy", least)
        return
    frame = indoor(INDOOR / "sparse.png", tmp_path / "confidence.npy", least)
    codes = codes_of(INDOOR / "sparse.png")
    assert len(frame.points) == np.count_nonzero(codes[240:])
    (note,) = (note for note in frame.notes if "confidence" in note)
    assert f"no number to {np.count_nonzero(codes[:240]):,} of them" in note
    assert "nan" not in note.lower().replace("confidence.npy", "")
