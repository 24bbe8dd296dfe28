"""Kinds of files that came out badly without a word, each made by the formula of its format.

The right depths are computed here. A kind is read rightly, or refused, or told of; and what is like
it but right is neither.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, ScanOptions
from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan

SAMPLES = Path(__file__).parents[2] / "samples"
INDOOR = SAMPLES / "indoor"
STREET = SAMPLES / "street"
TRUTH = np.asarray(Image.open(INDOOR / "gt.png")) / 1000
"""(480, 640) metres, everywhere known."""
Depth = NDArray[Any]


def some(depth: Depth, count: int = 2000) -> Depth:
    """The depth at so many of the pixels, and 0 at the others."""
    chosen = np.zeros(depth.size, bool)
    chosen[np.random.default_rng(0).permutation(depth.size)[:count]] = True
    return np.where(chosen.reshape(depth.shape), depth, 0)


def read(sparse: Path, image: Path | None = INDOOR / "rgb.png", **options: Any) -> Frame:
    files = {name: options.pop(name) for name in ("gt", "sparse_scale", "calib") if name in options}
    return read_frame(FrameFiles(image=image, sparse=sparse, **files), ReadOptions(**options))


def warnings_of(frame: Frame) -> list[str]:
    return [note for note in frame.notes if note.startswith("warning")]


def save(path: Path, values: Depth) -> Path:
    """Writes floats or 16-bit codes by the suffix, or points where it is .csv or list.npy."""
    if path.name == "list.npy" or path.suffix in (".csv", ".txt"):
        row, column = np.nonzero(values)
        rows = np.column_stack([column, row, values[row, column]])
        if path.suffix == ".npy":
            np.save(path, rows)
        else:
            np.savetxt(path, rows, delimiter="," if path.suffix == ".csv" else " ")
    elif path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, depth=values)
    elif values.dtype.kind == "f" and path.suffix in (".exr", ".pfm"):
        write_depth(path, values.astype(np.float32))
    else:
        Image.fromarray(values).save(path)
    return path


FLOATS = ("a.npy", "a.npz", "a.exr", "a.pfm", "a.tiff", "list.npy", "a.csv", "a.txt")


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("scale", [3.28084, 10.0, 39.3701, 100.0, 1000.0])
def test_a_stated_scale_is_obeyed_in_every_file_of_floats(
    name: str, scale: float, tmp_path: Path
) -> None:
    right = some(TRUTH).astype(np.float32)
    path = save(tmp_path / name, (right * np.float32(scale)).astype(np.float32))
    row, column = np.nonzero(right)
    for how in ({"depth_scale": scale},):
        frame = read(path, **how)
        x, y = frame.points.xy.numpy().astype(int).T
        np.testing.assert_allclose(frame.points.depth, right[y, x], rtol=1e-4)
        assert len(frame.points) == len(row) == len(column)
        assert any(f"÷ {scale:g}" in note for note in frame.notes)


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize(("kind", "factor"), [("inverse", 1.0), ("disparity:386.1", 386.1)])
def test_a_stated_kind_is_obeyed_in_every_file_of_floats(
    name: str, kind: str, factor: float, tmp_path: Path
) -> None:
    right = some(TRUTH).astype(np.float32)
    stored = np.divide(factor, right, out=np.zeros_like(right), where=right > 0)
    frame = read(save(tmp_path / name, stored), sparse_kind=kind)
    x, y = frame.points.xy.numpy().astype(int).T
    np.testing.assert_allclose(frame.points.depth, right[y, x], rtol=1e-4)
    assert len(frame.points) == np.count_nonzero(right)


@pytest.mark.parametrize(
    "stated",
    [
        {"sparse_kind": "inverse"},
        {"sparse_range": True},
        {"unit_scale": 2.0},
    ],
)
def test_what_is_stated_of_a_scan_and_is_of_no_scan_is_refused(stated: dict[str, Any]) -> None:
    scan = ScanOptions(calib=STREET / "calib.txt")
    with pytest.raises(UsageError):
        read(STREET / "000000.bin", STREET / "rgb.png", scan=scan, **stated)


@pytest.mark.parametrize("camera", [0, 1, 2, 3])
def test_a_stated_camera_is_obeyed_or_refused(camera: int) -> None:
    scan = ScanOptions(calib=STREET / "calib.txt", camera=camera)
    rows = dict(line.split(":") for line in (STREET / "calib.txt").read_text().split("\n") if line)
    if f"P{camera}" not in rows:
        with pytest.raises(UsageError, match=f"camera {camera}"):
            read(STREET / "000000.bin", STREET / "rgb.png", scan=scan)
        return
    frame = read(STREET / "000000.bin", STREET / "rgb.png", scan=scan)
    right = np.array(rows[f"P{camera}"].split(), float).reshape(3, 4)[:, :3]
    assert frame.camera is not None
    np.testing.assert_allclose(frame.camera.intrinsics, right)


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd", ".ply", ".txt"])
@pytest.mark.parametrize("scale", [3.28084, 100.0])
def test_a_stated_scale_is_obeyed_in_every_scan(suffix: str, scale: float, tmp_path: Path) -> None:
    xyz = read_scan(STREET / "000000.bin")[0][::9]
    path = tmp_path / f"scan{suffix}"
    rows = (scale * xyz).astype("<f4")
    if suffix == ".bin":
        np.column_stack([rows, np.random.default_rng(0).uniform(size=len(rows))]).astype(
            "<f4"
        ).tofile(path)
    elif suffix == ".npy":
        np.save(path, rows)
    elif suffix == ".txt":
        np.savetxt(path, rows, header="x y z", comments="")
    elif suffix == ".pcd":
        head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        path.write_bytes(f"{head}POINTS {len(rows)}\nDATA binary\n".encode() + rows.tobytes())
    else:
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
        fields = "".join(f"property float {axis}\n" for axis in "xyz")
        path.write_bytes(f"{head}{fields}end_header\n".encode() + rows.tobytes())
    scan = ScanOptions(calib=STREET / "calib.txt", keep_occluded=True)
    frame = read(path, STREET / "rgb.png", scan=scan, depth_scale=scale)
    plain = tmp_path / "plain.npy"
    np.save(plain, xyz)
    right = read(plain, STREET / "rgb.png", scan=scan)
    np.testing.assert_allclose(frame.points.depth, right.points.depth, rtol=1e-4)


def test_a_scale_of_one_files_integers_is_said_not_to_be_of_the_others_floats(
    tmp_path: Path,
) -> None:
    sparse = save(tmp_path / "a.npy", some(TRUTH).astype(np.float32))
    frame = read(sparse, gt=INDOOR / "gt.png", depth_scale=1000.0)
    x, y = frame.points.xy.numpy().astype(int).T
    np.testing.assert_allclose(frame.points.depth, TRUTH[y, x], rtol=1e-6)
    assert any("gt.png" in note and "--depth-scale" in note for note in frame.notes)


def test_a_list_states_the_scale_and_the_kind_of_its_files(tmp_path: Path) -> None:
    save(tmp_path / "inches.npy", (some(TRUTH) * 39.3701).astype(np.float32))
    save(tmp_path / "inverse.npy", np.divide(1, some(TRUTH), where=some(TRUTH) > 0,
                                             out=np.zeros(TRUTH.shape)))  # fmt: skip
    (tmp_path / "rgb.png").write_bytes((INDOOR / "rgb.png").read_bytes())
    (tmp_path / "list.csv").write_text(
        "image,sparse,sparse_scale,sparse_kind,name\n"
        "rgb.png,inches.npy,39.3701,,a\nrgb.png,inverse.npy,,inverse,b\n"
    )
    for files in list_frames(tmp_path / "list.csv")[1]:
        points = read_frame(files, ReadOptions()).points
        x, y = points.xy.numpy().astype(int).T
        np.testing.assert_allclose(points.depth, TRUTH[y, x], rtol=1e-4)


def test_a_colmap_model_has_another_scale() -> None:
    photos = SAMPLES / "photos"
    image = sorted((photos / "images").iterdir())[0]
    with pytest.raises(UsageError, match="--unit-scale"):
        read(photos / "sparse" / "0", image, depth_scale=1000.0)


NEAR, FAR = 0.1, 100.0


@pytest.mark.parametrize(
    ("stored", "why"),
    [
        ((FAR / (FAR - NEAR)) * (1 - NEAR / TRUTH), "a z-buffer of OpenGL and Direct3D"),
        ((TRUTH - TRUTH.min()) / np.ptp(TRUTH), "normalised to 0…1"),
    ],
)
def test_a_map_within_0_and_1_is_no_metres_unless_said(
    stored: Depth, why: str, tmp_path: Path
) -> None:
    stored = np.where(some(TRUTH, 20_000) > 0, stored, 0)
    path = save(tmp_path / "a.npy", stored.astype(np.float32))
    with pytest.raises(InputError, match="--depth-scale"):
        read(path)
    np.testing.assert_allclose(read(path, depth_scale=1.0).points.depth.max(), stored.max())


@pytest.mark.parametrize(("factor", "known"), [(0.5, 0.2), (0.5, 0.8), (0.25, 0.2)])
@pytest.mark.parametrize("interpolation", [cv2.INTER_LINEAR, cv2.INTER_AREA])
def test_a_map_of_half_the_size_whose_pixels_are_means_with_unknown_ones_is_told(
    factor: float, interpolation: int, known: float, tmp_path: Path
) -> None:
    chance = np.random.default_rng(0).random(TRUTH.shape)
    depth = np.where(chance < known, TRUTH, 0).astype(np.float32)
    resized = cv2.resize(depth, None, fx=factor, fy=factor, interpolation=interpolation)
    frame = read(save(tmp_path / "a.npy", resized), None)
    assert any("interpolation" in note for note in warnings_of(frame))
    nearest = cv2.resize(depth, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    frame = read(save(tmp_path / "b.npy", nearest), None)
    assert not any("interpolation" in note for note in warnings_of(frame))


def test_16_bits_that_were_stretched_are_no_depth_unless_a_scale_is_stated(tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, TRUTH.size).reshape(TRUTH.shape)
    stretched = np.rint(65535 * ramp).astype(np.uint16)
    path = save(tmp_path / "a.png", stretched)
    with pytest.raises(InputError, match="normalised"):
        read_depth(path)
    assert read_depth(path, scale=1000.0).values.max() == pytest.approx(65.534)
    saturated = np.where(ramp > 0.9, 65535, 20_000 * ramp).astype(np.uint16)
    assert read_depth(save(tmp_path / "b.png", saturated)).values.max() > 0


@pytest.mark.parametrize("which", ["gt.png", "sparse"])
def test_exchanged_bytes_are_recognised(which: str, tmp_path: Path) -> None:
    codes = np.asarray(
        Image.open(INDOOR / "gt.png" if which == "gt.png" else STREET / "sparse.png")
    )
    codes = codes.astype(np.uint16)
    assert read_depth(save(tmp_path / "right.png", codes)).values.any()
    with pytest.raises(InputError, match="bytes exchanged"):
        read_depth(save(tmp_path / "a.png", codes.byteswap()))


@pytest.mark.parametrize(
    ("interpolation", "factor"),
    [
        *((cv2.INTER_LINEAR, factor) for factor in (0.6, 1.3, 2)),
        *((cv2.INTER_CUBIC, factor) for factor in (0.6, 1.5)),
        (cv2.INTER_AREA, 0.7),
    ],
)
def test_a_sparse_map_that_was_resized_by_interpolation_is_told(
    interpolation: int, factor: float, tmp_path: Path
) -> None:
    depth = np.asarray(Image.open(STREET / "sparse.png")) / np.float32(256)
    size = (round(1242 * factor), round(375 * factor))
    resized = cv2.resize(depth.astype(np.float32), size, interpolation=interpolation)
    path = save(tmp_path / "a.npy", np.maximum(resized, 0))
    assert any("interpolation" in note for note in warnings_of(read(path, None)))
    nearest = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    path = save(tmp_path / "b.npy", nearest)
    assert not any("interpolation" in note for note in warnings_of(read(path, None)))


@pytest.mark.parametrize(("bits", "white"), [(8, 255), (10, 1023), (12, 4095), (14, 16383)])
def test_an_image_of_fewer_bits_than_16_is_not_black(bits: int, white: int, tmp_path: Path) -> None:
    pixels = np.asarray(Image.open(INDOOR / "rgb.png").convert("RGB")) / 255
    codes = np.rint(white * pixels).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), codes[:, :, ::-1])
    image = read_rgb(tmp_path / "a.png")
    np.testing.assert_allclose(image.values, pixels, atol=1 / white)
    assert image.note is not None


def test_a_calibration_of_kitti_says_the_size_of_its_images(tmp_path: Path) -> None:
    image = cv2.imread(str(STREET / "rgb.png"))
    rows = (STREET / "calib.txt").read_text().split("\n")
    p = "721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884"
    text = "\n".join(f"P2: {p}" if row.startswith("P2") else row for row in rows)
    (tmp_path / "calib.txt").write_text(text)
    (tmp_path / "k.txt").write_text("K: 721.5377 0 609.5593 0 721.5377 172.854 0 0 1\n" + "\n".join(
        ["R: 0 -1 0 0 0 -1 1 0 0", "t: 0 0 0"]))  # fmt: skip
    cv2.imwrite(str(tmp_path / "half.png"), cv2.resize(image, (621, 188)))
    cv2.imwrite(str(tmp_path / "cut.png"), image[23:, 13:-13])
    for calib in ("calib.txt", "k.txt"):
        scan = ScanOptions(calib=tmp_path / calib)
        for name in ("half.png", "cut.png"):
            with pytest.raises(InputError, match="1242"):
                read(STREET / "000000.bin", tmp_path / name, scan=scan)
        read(STREET / "000000.bin", STREET / "rgb.png", scan=scan)


def test_a_map_of_half_the_size_of_a_wide_image_has_kittis_scale(tmp_path: Path) -> None:
    codes = np.asarray(Image.open(STREET / "sparse.png")).astype(np.uint16)
    half = np.zeros((188, 621), np.uint16)
    row, column = np.nonzero(codes)
    half[np.minimum(row // 2, 187), column // 2] = codes[row, column]
    scan = ScanOptions(keep_occluded=True)
    frame = read(save(tmp_path / "a.png", half), STREET / "rgb.png", scan=scan)
    assert float(frame.points.depth.max()) == pytest.approx(half.max() / 256)


def gdal_tiff(path: Path, values: Depth, items: str, nothing: str | None) -> Path:
    """A TIFF with GDAL's tags: metadata of a band, and the number of no data."""
    tags = ImageFileDirectory_v2()
    tags[42112] = f"<GDALMetadata>{items}</GDALMetadata>"
    if nothing is not None:
        tags[42113] = nothing
    Image.fromarray(values).save(path, tiffinfo=tags)
    return path


def test_the_tags_of_gdal_say_scale_offset_and_what_is_no_data(tmp_path: Path) -> None:
    scale = '<Item name="SCALE" sample="0" role="scale">0.001</Item>'
    offset = '<Item name="OFFSET" sample="0" role="offset">0.5</Item>'
    codes = np.rint(1000 * TRUTH).astype(np.uint16)
    codes[:5] = 9999
    right = np.where(codes == 9999, 0, codes / 1000)
    found = read_depth(gdal_tiff(tmp_path / "a.tif", codes, scale, "9999"))
    np.testing.assert_allclose(found.values, right, rtol=1e-6)
    assert not found.reading.assumed
    found = read_depth(gdal_tiff(tmp_path / "b.tif", codes, scale + offset, "9999"))
    np.testing.assert_allclose(found.values, np.where(right > 0, right + 0.5, 0), rtol=1e-6)
    metres = np.where(codes == 9999, -9999, TRUTH).astype(np.float32)
    found = read_depth(gdal_tiff(tmp_path / "c.tif", metres, "", "-9999"))
    np.testing.assert_allclose(found.values, np.where(metres < 0, 0, TRUTH), rtol=1e-6)


@pytest.mark.parametrize("name", ["disparity", "conf", "confidence", "mask", "depth_sigma"])
def test_an_array_whose_name_is_of_no_depth_is_refused(name: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **{name: TRUTH.astype(np.float32)})
    with pytest.raises(InputError, match=name):
        read_depth(tmp_path / "a.npz")


def listed(path: Path, xy: Depth) -> Path:
    """A list of points with these coordinates, and the depth of the sample there."""
    pixel = POINTS.astype(int)
    np.save(path, np.column_stack([xy, TRUTH[pixel[:, 1], pixel[:, 0]]]))
    return path


POINTS = np.random.default_rng(0).uniform(0, 1, (300, 2)) * (639, 479)


@pytest.mark.parametrize(
    ("xy", "advice"),
    [
        (np.where(np.arange(300)[:, None] == 5, 1.02, POINTS / (640, 480)), "640 and 480"),
        (2 * POINTS / (640, 480) - 1, "320 and 240"),
        (2 * POINTS, "is 2 times"),
        (1.5 * POINTS, r"is 1\.51? times"),
    ],
)
def test_coordinates_that_are_no_pixels_are_refused_with_what_makes_them_such(
    xy: Depth, advice: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=advice):
        read(listed(tmp_path / "a.npy", xy))


@pytest.mark.parametrize("largest", [100, 255])
def test_coordinates_of_a_square_are_warned_of(largest: int, tmp_path: Path) -> None:
    frame = read(listed(tmp_path / "a.npy", largest * POINTS / (640, 480)))
    assert any("upper left corner" in note for note in warnings_of(frame))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_a_list_may_be_of_any_usual_encoding_and_system(encoding: str, tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    for name in ("rgb/a.png", "rgb/é.png"):
        (tmp_path / name).write_bytes((INDOOR / "rgb.png").read_bytes())
    text = "image,sparse,name\rrgb\\a.png,rgb\\a.png,a\rrgb\\é.png,rgb\\é.png,b\r"
    (tmp_path / "list.csv").write_bytes(text.encode(encoding))
    frames = list_frames(tmp_path / "list.csv")[1]
    assert [frame.image.name for frame in frames if isinstance(frame.image, Path)] == [
        "a.png",
        "é.png",
    ]


def test_depth_that_grows_downwards_is_warned_of(tmp_path: Path) -> None:
    codes = np.asarray(Image.open(STREET / "sparse.png")).astype(float)
    disparity = np.divide(386 * 256, codes, out=np.zeros(codes.shape), where=codes > 0)
    for stored in (disparity, codes[::-1] / 256):
        path = save(tmp_path / "a.npy", stored.astype(np.float32))
        assert any("bottom" in note for note in warnings_of(read(path, STREET / "rgb.png")))
    frame = read(path, STREET / "rgb.png", sparse_kind="disparity:386")
    assert not any("bottom" in note for note in warnings_of(frame))


@pytest.mark.parametrize(
    "away", [np.zeros(3), np.array([50.0, 20, 3]), np.array([4.6e5, 5.4e6, 100])]
)
def test_a_cloud_of_a_world_has_the_points_of_its_scan(away: Depth, tmp_path: Path) -> None:
    xyz = read_scan(STREET / "000000.bin")[0].astype(float)
    np.savetxt(tmp_path / "cloud.txt", xyz + away, header="x y z", comments="", fmt="%.6f")
    rows = dict(line.split(":") for line in (STREET / "calib.txt").read_text().split("\n") if line)
    pose = np.array(rows["Tr_velo_to_cam"].split(), float).reshape(3, 4)
    pose[:, 3] -= pose[:, :3] @ away
    np.savetxt(tmp_path / "pose.txt", pose)
    k = np.array(rows["P2"].split(), float).reshape(3, 4)[:, :3]
    (tmp_path / "k.txt").write_text(f"K: {' '.join(map(str, k.ravel()))}\n")
    both = {"calib": tmp_path / "k.txt", "extrinsics": tmp_path / "pose.txt"}
    frame = read(tmp_path / "cloud.txt", STREET / "rgb.png", scan=ScanOptions(**both))
    kept = ScanOptions(**both, keep_occluded=True)
    every = read(tmp_path / "cloud.txt", STREET / "rgb.png", scan=kept)
    np.savetxt(
        tmp_path / "pose.txt", np.column_stack([pose[:, :3], pose[:, 3] + pose[:, :3] @ away])
    )
    np.save(tmp_path / "scan.npy", xyz)
    right = read(tmp_path / "scan.npy", STREET / "rgb.png", scan=kept)
    assert len(every.points) == pytest.approx(len(right.points), rel=1e-3)
    assert float(every.points.depth.max()) == pytest.approx(
        float(right.points.depth.max()), abs=0.02
    )
    assert 0.5 * len(right.points) < len(frame.points) < len(right.points)
    assert warnings_of(frame) == []


def test_a_depth_map_of_colmap_is_named_as_such(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"640&480&1&" + TRUTH.astype("<f4").tobytes())
    for calib in (None, STREET / "calib.txt"):
        with pytest.raises(InputError, match="COLMAP"):
            read(tmp_path / "a.bin", scan=ScanOptions(calib=calib))


@pytest.mark.parametrize(
    "text",
    [
        "# camera: 1\n525 0 319.5\n0 525 239.5\n0 0 1\n",
        "K 525 0 319.5 0 525 239.5 0 0 1\nsize 640 480  # pixels\n",
        "525 525 319.5 239.5\n",
        "# K of 3×4\n525 0 319.5 0\n0 525 239.5 0\n0 0 1 0\n",
        "K = [525, 0, 319.5; 0, 525, 239.5; 0, 0, 1]\n",
        "fx 525\nfy 525\ncx 319.5\ncy 239.5\n",
        "fx = 525\nfy = 525\ncx = 319.5\ncy = 239.5\nwidth = 640\nheight = 480\n",
        '{"fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5}',
    ],
)
def test_a_calibration_may_have_comments_and_no_colons(text: str, tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(text)
    camera = read_calibration(tmp_path / "calib.txt").camera
    np.testing.assert_array_equal(camera.intrinsics, [[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])


def test_a_projection_of_a_moved_camera_is_no_k(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("K: 525 0 319.5 44 0 525 239.5 0 0 0 1 0\n")
    with pytest.raises(InputError, match="last column"):
        read_calibration(tmp_path / "calib.txt")


@pytest.mark.parametrize("scale", [1000.0, 10_000.0, 4000.0])
def test_the_recorder_of_open3d_says_camera_and_scale(scale: float, tmp_path: Path) -> None:
    sidecar = tmp_path / "intrinsic.json"
    content = {
        "width": 640,
        "height": 480,
        "intrinsic_matrix": [525, 0, 0, 0, 520, 0, 319.5, 239.5, 1],
        "depth_scale": scale,
        "depth_format": "Z16",
        "color_format": "RGB8",
    }
    sidecar.write_text(json.dumps(content))
    camera = read_calibration(sidecar).camera
    np.testing.assert_array_equal(camera.intrinsics, [[525, 0, 319.5], [0, 520, 239.5], [0, 0, 1]])
    assert camera.size == (480, 640)
    (tmp_path / "depth").mkdir()
    codes = np.rint(some(np.minimum(TRUTH, 6)) * scale)  # of 16 bits
    path = save(tmp_path / "depth" / "00000.png", codes.astype(np.uint16))
    found = read_depth(path)
    np.testing.assert_allclose(found.values, codes / scale, rtol=1e-6)
    assert not found.reading.assumed
    # What the user states comes first, and a file elsewhere has no sidecar.
    assert read_depth(path, scale=256.0).values.max() == pytest.approx(codes.max() / 256)
    assert read_depth(save(tmp_path / "a.png", codes.astype(np.uint16))).reading.assumed
    sidecar.write_text(json.dumps({**content, "depth_scale": 0}))
    with pytest.raises(InputError, match="depth_scale"):
        read_depth(path)


def tiff_of_floats(values: Depth) -> bytes:
    """An uncompressed TIFF (H, W) or (H, W, C) of floats of any size, by TIFF 6.0."""
    height, width, channels = (*values.shape, 1)[:3]
    bits, short, long = 8 * values.itemsize, 3, 4
    fields = {
        256: (long, width),
        257: (long, height),
        258: (short, bits),
        259: (short, 1),
        262: (short, 2 if channels > 1 else 1),
        273: (long, None),
        277: (short, channels),
        278: (long, height),
        279: (long, values.nbytes),
        339: (short, 3),
    }
    after = 10 + 12 * len(fields) + 4
    extra, entries = b"", b""
    for tag, (kind, value) in fields.items():
        count = channels if tag in (258, 339) else 1
        if count > 2:
            extra += struct.pack(f"<{count}H", *[value] * count)
            entries += struct.pack("<HHII", tag, kind, count, after + len(extra) - 2 * count)
        elif kind == short:
            entries += struct.pack("<HHI4s", tag, kind, count, struct.pack("<HH", value, 0))
        else:
            where = after + 2 * (2 * channels if channels > 2 else 0)
            entries += struct.pack("<HHII", tag, kind, 1, where if value is None else value)
    head = b"II*\0" + struct.pack("<IH", 8, len(fields))
    return head + entries + struct.pack("<I", 0) + extra + values.tobytes()


@pytest.mark.parametrize(
    ("values", "named"),
    [
        (TRUTH.astype("<f8"), "64-bit floats"),
        (np.repeat(TRUTH[:, :, None], 3, axis=2).astype("<f4"), "3 channels"),
        (np.repeat(TRUTH[:, :, None], 4, axis=2).astype("<f8"), "4 channels"),
    ],
)
def test_a_tiff_of_other_floats_says_what_it_holds(
    values: Depth, named: str, tmp_path: Path
) -> None:
    (tmp_path / "a.tif").write_bytes(tiff_of_floats(values))
    with pytest.raises(InputError, match=named):
        read_depth(tmp_path / "a.tif")
    (tmp_path / "b.tif").write_bytes(tiff_of_floats(TRUTH.astype("<f4")))
    np.testing.assert_array_equal(read_depth(tmp_path / "b.tif").values, TRUTH.astype(np.float32))


def test_rows_that_were_cut_off_above_are_no_false_alarm(tmp_path: Path) -> None:
    image = cv2.imread(str(STREET / "rgb.png"))
    rows = (STREET / "calib.txt").read_text().split("\n")
    k = np.array(next(row for row in rows if row.startswith("P2")).split()[1:], float)
    k = k.reshape(3, 4)
    k[1] -= 119 * k[2]
    text = "\n".join(
        f"P2: {' '.join(map(str, k.ravel()))}" if row.startswith("P2") else row for row in rows
    )
    (tmp_path / "calib.txt").write_text(text)
    cv2.imwrite(str(tmp_path / "cut.png"), image[119:])
    scan = ScanOptions(calib=tmp_path / "calib.txt")
    assert warnings_of(read(STREET / "000000.bin", tmp_path / "cut.png", scan=scan)) == []
