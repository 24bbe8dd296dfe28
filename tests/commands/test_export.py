"""Exports are read back by the programs they are for, or by their published layouts."""

from __future__ import annotations

import json
import shutil
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from pnpdepth_cli.commands.export import export_results
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.scans import read_scan
from tests.colmap_models import HEIGHT, WIDTH
from tests.commands.projects import DEPTH, NAMES, project, results


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return project(tmp_path)


def test_maps_have_the_layout_that_colmap_publishes_and_are_in_model_units(root: Path) -> None:
    export_results(results(root, unit_scale=0.25), root, to="colmap")
    assert (root / "stereo/fusion.cfg").read_text() == "a.png\nb.png\nc.png\n"

    def values(kind: str, channels: int) -> np.ndarray:
        """The map, of which columns come first."""
        data = (root / f"stereo/{kind}_maps/a.png.geometric.bin").read_bytes()
        *header, rest = data.split(b"&", 3)
        assert [int(number) for number in header] == [WIDTH, HEIGHT, channels]
        columns = np.frombuffer(rest, "<f4").reshape((WIDTH, HEIGHT, channels), order="F")
        return columns.transpose(1, 0, 2)

    assert values("depth", 1)[..., 0] == pytest.approx(DEPTH, rel=1e-6)
    normals = values("normal", 3)
    assert np.linalg.norm(normals, axis=2) == pytest.approx(1, abs=1e-5)
    assert (normals[..., 2] < 0).all()  # towards the camera


def test_colmap_reads_the_maps_and_fuses_them_into_the_surface(root: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    depth = np.full((HEIGHT, WIDTH), 4, np.float32)  # all cameras look along z at a wall
    export_results(results(root, depth), root, to="colmap")
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 3
    (root / "fused").mkdir()
    fused = pycolmap.stereo_fusion(root / "fused", root, options=options)
    xyz = np.array([point.xyz for point in fused.points3D.values()])
    assert len(xyz) > 500
    assert xyz[:, 2] == pytest.approx(4, abs=1e-3)


def test_3dgs_gets_the_inverse_depth_of_the_model_at_every_pixel(root: Path) -> None:
    depth = DEPTH.copy()
    depth[:2] = 0  # unknown: taken from the nearest pixel
    folder = results(root, depth, unit_scale=0.25)
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[5] = 0  # not valid: its own depth
    for name in NAMES:
        cv2.imwrite(str(folder / f"{name}_valid.png"), valid)
    _, notes = export_results(folder, root, to="gaussian-splatting")
    assert any(f"{3 * 3 * WIDTH:,} pixels are unknown" in note for note in notes)
    parameters = json.loads((root / "sparse/0/depth_params.json").read_text())
    assert set(parameters) == set(NAMES)
    for name, coding in parameters.items():
        png = cv2.imread(str(root / f"inverse_depths/{name}.png"), cv2.IMREAD_UNCHANGED)
        assert png.dtype == np.uint16
        inverse = png.astype(np.float32) / float(2**16) * coding["scale"] + coding["offset"]
        assert inverse == pytest.approx(1 / np.concatenate([DEPTH[[2, 2]], DEPTH[2:]]), rel=2e-4)


class Scene(NamedTuple):
    """An export for Nerfstudio: the metres of a model unit, what was returned, and the files."""

    unit_scale: float | None
    root: Path
    folder: Path
    what: str
    notes: list[str]
    content: Any

    @property
    def entry(self) -> Any:
        """The second frame, of the image b."""
        return self.content["frames"][1]

    @property
    def depth(self) -> np.ndarray:
        """Its depth (H, W) in metres, or in model units where their length is not known."""
        path = self.folder / self.entry["depth_file_path"]
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * 1e-3


@pytest.fixture(scope="module", params=[None, 0.25])
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    root = project(tmp_path_factory.mktemp("scene"))
    far = DEPTH.copy()
    # 16 bits of millimetres just hold it.
    far[:2] = np.array([[65.532], [65.534]]) / (request.param or 1)
    folder = root / "scene"
    what, notes = export_results(results(root, far, request.param), folder, to="nerfstudio")
    content = json.loads((folder / "transforms.json").read_text())
    return Scene(request.param, root, folder, what, notes, content)


def test_the_unit_of_an_export_is_said(scene: Scene) -> None:
    assert scene.what == f"3 frames in {'m' if scene.unit_scale else 'model units'}"
    assert scene.notes == []


def test_transforms_have_the_images_and_the_camera_of_the_model(scene: Scene) -> None:
    assert (scene.content["camera_model"], len(scene.content["frames"])) == ("OPENCV", 3)
    assert (scene.entry["w"], scene.entry["h"]) == (WIDTH, HEIGHT)
    copied = scene.folder / scene.entry["file_path"]
    assert copied.read_bytes() == (scene.root / "images/b.png").read_bytes()


def test_depth_of_transforms_is_in_millimetres_as_far_as_16_bits_go(scene: Scene) -> None:
    assert scene.depth[:2, 0] == pytest.approx([65.532, 65.534])


def test_transforms_name_depth_as_instant_ngp_does_too(scene: Scene) -> None:
    assert scene.content["enable_depth_loading"]
    assert scene.content["integer_depth_scale"] == 1e-3
    assert scene.entry["depth_path"] == scene.entry["depth_file_path"]


def test_transforms_put_pixels_and_points_where_the_model_does(scene: Scene) -> None:
    u, v = 10, 20
    z = DEPTH[v, u]
    # Nerfstudio's ray of a pixel centre, in OpenGL's axes; depth is z
    across = (u + 0.5 - scene.entry["cx"]) / scene.entry["fl_x"]
    up = -(v + 0.5 - scene.entry["cy"]) / scene.entry["fl_y"]
    at = [*(scene.depth[v, u] * np.array([across, up, -1])), 1]
    world = np.array(scene.entry["transform_matrix"]) @ at
    # The model of tests/colmap_models: 50 and 52 pixels, centre at 32.5 and 23, b at x = -0.1
    metres = scene.unit_scale or 1
    expected = np.array([(u - 32) / 50 * z - 0.1, (v - 22.5) / 52 * z, z]) * metres
    assert world[:3] == pytest.approx(expected, rel=1e-3)
    start = read_scan(scene.folder / scene.content["ply_file_path"])[0]
    assert np.median(start[:, 2]) == pytest.approx(np.median(DEPTH) * world[2] / z, rel=0.01)


@pytest.mark.parametrize(("farthest", "factor"), [(65.535, 0.002), (300.0, 0.005), (9000.0, 0.2)])
def test_codes_of_nerfstudio_are_larger_where_the_scene_is(
    root: Path, farthest: float, factor: float
) -> None:
    scene = root / "scene"
    far = DEPTH.copy()
    far[0] = farthest
    _, notes = export_results(results(root, far), scene, to="nerfstudio")
    assert f"--depth-unit-scale-factor {factor:g}`" in notes[0]
    content = json.loads((scene / "transforms.json").read_text())
    assert content["integer_depth_scale"] == content["depth_unit_scale_factor"] == factor
    png = cv2.imread(str(scene / content["frames"][0]["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(png * factor, far, atol=0.51 * factor)


def test_3dgs_leaves_out_what_is_unknown_where_asked(root: Path) -> None:
    depth = DEPTH.copy()
    depth[:2] = 0
    export_results(results(root, depth), root, to="gaussian-splatting", unknown="zero")
    png = cv2.imread(str(root / "inverse_depths/a.png"), cv2.IMREAD_UNCHANGED)
    assert not png[:2].any()
    assert png[2:].all()


@pytest.fixture(scope="module")
def splats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with its export for 3DGS in scene/."""
    pytest.importorskip("pycolmap")
    root = project(tmp_path_factory.mktemp("splats"))
    what, _ = export_results(
        results(root, unit_scale=0.25), root / "scene", to="gaussian-splatting"
    )
    assert what == "3 frames in model units"
    return root


def test_3dgs_finds_points_of_the_refined_depth(splats: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(splats / "scene/sparse/0")
    assert model.num_points3D() > 500
    depths = [point.xyz[2] for point in model.points3D.values()]
    assert np.median(depths) == pytest.approx(np.median(DEPTH), rel=0.01)


def test_3dgs_finds_the_images_with_the_cameras_and_poses_of_the_model(splats: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    original = pycolmap.Reconstruction(splats / "sparse")
    pose_of = {image.name: image.cam_from_world().matrix() for image in original.images.values()}
    for image in pycolmap.Reconstruction(splats / "scene/sparse/0").images.values():
        assert image.cam_from_world().matrix() == pytest.approx(pose_of[image.name], abs=1e-6)
        assert image.camera.params == pytest.approx([50, 52, 32.5, 23])
        assert (splats / "scene/images" / image.name).is_file()


def test_3dgs_gets_no_other_model_where_colmap_has_made_one(root: Path) -> None:
    pytest.importorskip("pycolmap")
    folder = results(root, unit_scale=0.25)
    shutil.copytree(root / "sparse", root / "sparse/0")
    export_results(folder, root, to="gaussian-splatting")
    original, kept = (root / path / "cameras.txt" for path in ("sparse", "sparse/0"))
    assert kept.read_bytes() == original.read_bytes()


def test_lens_distortion_is_kept_for_nerfstudio_and_warned_of_elsewhere(tmp_path: Path) -> None:
    folder = results(project(tmp_path, "OPENCV"))
    export_results(folder, tmp_path, to="nerfstudio")
    entry, *_ = frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    # images in the folder itself are not copied
    assert [frame["file_path"] for frame in frames] == [f"images/{n}.png" for n in NAMES]
    names = ("k1", "k2", "p1", "p2", "k3")
    assert [entry[name] for name in names] == [-0.1, 0.02, 0.001, -0.002, 0]
    for to in ("colmap", "gaussian-splatting"):
        notes = "".join(export_results(folder, tmp_path / to, to=to)[1])
        assert " 3 of 3 images have lens distortion" in notes
        assert ("sparse/0 has no model" in notes) == (to == "gaussian-splatting")


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("result.camera.pose", None),
        ("unit", "m"),  # the others are in model units
        ("inputs.sparse.image", "b.png"),  # as of the next frame
        ("result.size", [9, 9]),
        ("result.camera.distortion", [0.1] * 8),  # not Nerfstudio's
        ("result.camera.pose", [1, 2]),
        ("inputs.sparse.image", "../../../ESC"),
        ("inputs.sparse.image", "/etc/x.png"),
    ],
)
def test_what_cannot_be_exported_is_one_line(root: Path, entry: str, value: object) -> None:
    folder = results(root)
    record = json.loads((folder / "a.json").read_text())
    *parents, name = entry.split(".")
    reduce(dict.__getitem__, parents, record)[name] = value
    (folder / "a.json").write_text(json.dumps(record))
    before = sorted(path for path in root.parent.rglob("*") if path.is_file())
    with pytest.raises(
        InputError, match=r"a(_depth\.exr|\.json|\.png)|out|model units|lens"
    ) as caught:
        export_results(folder, root / "dense", to="nerfstudio")
    assert "\n" not in str(caught.value)
    assert sorted(path for path in root.parent.rglob("*") if path.is_file()) == before


def test_results_need_depth_and_masks_of_one_size_and_stay_unasked(root: Path) -> None:
    folder = results(root)
    dense = root / "dense"
    export_results(folder, dense, to="colmap")
    export_results(folder, dense, to="colmap", overwrite=True)
    cv2.imwrite(str(folder / "a_valid.png"), np.zeros((2, 2), np.uint8))
    for source, output, error, named in (
        (root / "images", root / "new", InputError, "NAME_depth"),
        (folder, dense, OutputError, "--overwrite"),
        (folder, root / "new", InputError, "a_valid"),
    ):
        with pytest.raises(error, match=named):
            export_results(source, output, to="colmap")


def test_a_bag_of_frames_without_times_has_steps_and_names_what_it_lacks(root: Path) -> None:
    rosbags = pytest.importorskip("rosbags.highlevel")
    _, notes = export_results(results(root), root / "bag", to="mcap")
    assert "0.1 s" in notes[0]
    with rosbags.AnyReader([root / "bag"]) as reader:
        topics = {topic: info.msgcount for topic, info in reader.topics.items()}
        times = sorted({time_ns for _, time_ns, _ in reader.messages()})
    assert np.diff(times).tolist() == [10**8] * 2
    assert topics["/camera/depth/image"] == topics["/tf"] == 3
    assert "/camera/depth/sigma" not in topics
    assert sorted(path.name for path in (root / "bag").iterdir()) == [
        "metadata.yaml",
        "results.mcap",
    ]
    with pytest.raises(OutputError, match="--overwrite"):
        export_results(root / "out", root / "bag", to="mcap")


def test_the_depth_image_of_a_bag_has_the_numbers_of_the_result_row_by_row(root: Path) -> None:
    rosbags = pytest.importorskip("rosbags.highlevel")
    folder = results(root)
    export_results(folder, root / "bag", to="mcap")
    with rosbags.AnyReader([root / "bag"]) as reader:
        wanted = [found for found in reader.connections if found.topic == "/camera/depth/image"]
        _, _, data = next(reader.messages(connections=wanted))
        image = reader.deserialize(data, wanted[0].msgtype)
    depth = read_depth(folder / "a_depth.exr").values
    valid = depth > 0
    assert (image.encoding, image.height, image.width) == ("32FC1", *depth.shape)
    assert image.step == 4 * image.width
    values = image.data.view("<f4").reshape(depth.shape)
    assert np.array_equal(values[valid], depth[valid])


@pytest.mark.parametrize(
    ("camera", "model", "count"),
    [("PINHOLE", "plumb_bob", 5), ("OPENCV_FISHEYE", "equidistant", 4)],
)
def test_a_bag_has_the_lens_as_ros_names_it(
    root: Path, tmp_path: Path, camera: str, model: str, count: int
) -> None:
    rosbags = pytest.importorskip("rosbags.highlevel")
    other = tmp_path / "other"
    other.mkdir()
    project(other, camera)
    export_results(results(other), other / "bag", to="mcap")
    with rosbags.AnyReader([other / "bag"]) as reader:
        topic = "/camera/camera_info"
        wanted = [found for found in reader.connections if found.topic == topic]
        _, _, data = next(reader.messages(connections=wanted))
        info = reader.deserialize(data, wanted[0].msgtype)
    assert (info.distortion_model, len(info.d)) == (model, count)
    of_record = FrameRecord.read(other / "out/a.json").refined().camera
    assert of_record is not None
    expected = np.zeros(count)
    given = of_record.distortion[:count]
    expected[: len(given)] = given
    assert info.d.tolist() == expected.tolist()


def test_maps_of_a_model_whose_unit_is_the_metre_are_said_to_be_in_metres(root: Path) -> None:
    what, _ = export_results(results(root, unit_scale=1.0), root, to="colmap")
    assert what == "3 frames in m"
