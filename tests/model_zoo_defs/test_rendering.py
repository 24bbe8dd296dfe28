"""The scene renderer: exact depth, the same bytes for the same seed, resuming, sample files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="embreex is not installed (extra [train])")

from PIL import Image

from model_zoo_defs.training.rendering import make_samples, render, shapes
from model_zoo_defs.training.rendering.materials import Palette
from model_zoo_defs.training.rendering.shading import seen
from model_zoo_defs.training.rendering.shapes import Group
from model_zoo_defs.training.scenes import scenes
from model_zoo_defs.training.scenes.world import Sky, View, World, looking

pytestmark = pytest.mark.slow

HEIGHT, WIDTH = 48, 64


def world_of(group: Group, palette: Palette) -> World:
    mesh, materials = group.merged()
    sky = Sky(
        zenith=(0.5, 0.7, 1.0),
        horizon=(1.0, 1.0, 1.0),
        clouds=0.0,
        ambient_up=(0.5, 0.5, 0.5),
        ambient_down=(0.2, 0.2, 0.2),
        haze_m=0.0,
        occlusion_m=1.0,
    )
    return World(mesh=mesh, face_material=materials, table=palette.frozen(), lights=(), sky=sky)


def plain_world(mesh: shapes.Mesh) -> World:
    palette, group = Palette(np.random.default_rng(0)), Group()
    group.add(mesh, palette.new("plain"))
    return world_of(group, palette)


def tiny_view(yaw: float = 0.0, pitch: float = 0.0) -> View:
    return looking(
        (0.3, -0.2, 1.5), (yaw, pitch, 0.05), fov_deg=70, shift=(0.1, 0), size=(HEIGHT, WIDTH)
    )


def points_of(view: View, depth: np.ndarray) -> np.ndarray:
    """Unprojects with the pinhole equations alone."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    local = np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, np.ones_like(u)], axis=2)
    return (local * depth[..., None]) @ view.axes.T.astype(float) + view.position


def job(out: Path, **changes: object) -> render.Job:
    settings: dict[str, object] = {
        "out": out, "seed": 5, "height": HEIGHT, "width": WIDTH, "frames": 8, "shard_frames": 4,
        "kinds": ("desk",),
    }  # fmt: skip
    return render.Job(**{**settings, **changes})  # type: ignore[arg-type]


def test_the_depth_of_an_upright_plane_is_its_distance_along_the_axis() -> None:
    square = [(-40, 4, -40), (40, 4, -40), (40, 4, 40), (-40, 4, 40)]
    view = looking((0, 0, 0), (0, 0, 0), fov_deg=80, size=(HEIGHT, WIDTH))
    _, depth = seen(plain_world(shapes.quads([square])), view, np.random.default_rng(0))
    np.testing.assert_allclose(depth, 4.0, rtol=1e-6)


def test_the_depth_of_a_slanted_floor_solves_its_plane_equation() -> None:
    floor = [(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)]
    view = tiny_view(yaw=0.4, pitch=-0.7)
    _, depth = seen(plain_world(shapes.quads([floor])), view, np.random.default_rng(0))
    _, directions = view.grid()
    expected = (-1.5 / directions[:, 2].astype(float)).reshape(HEIGHT, WIDTH)
    assert (depth > 0).all()
    np.testing.assert_allclose(depth, expected, rtol=1e-5)


def test_unprojected_pixels_lie_on_the_triangles_they_show() -> None:
    world, plan = scenes.build("room", scenes.generator(3, 0, 0))
    rng = scenes.generator(3, 0, 1)
    view = scenes.pick_view(world, plan, "room", rng, size=(HEIGHT, WIDTH))
    hits = world.cast(*view.grid())
    points = points_of(view, hits.t.reshape(HEIGHT, WIDTH)).reshape(-1, 3)[hits.met]
    corners = world.mesh.vertices[world.mesh.faces[hits.face[hits.met]]].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    away = np.abs(np.einsum("ij,ij->i", points - corners[:, 0], normal))
    assert away.max() < 1e-4 * max(1.0, float(hits.t.max()))


@pytest.mark.parametrize("kind", scenes.KINDS)
def test_every_kind_renders_a_full_scene_of_known_depth(kind: str) -> None:
    frames = scenes.scene_frames(11, 0, height=HEIGHT, width=WIDTH, kinds=(kind,))
    assert len(frames) == scenes.VIEWS_PER_SCENE
    for frame in frames:
        assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
        assert frame.rgb.std() > 3
        assert np.isfinite(frame.depth).all()
        assert (frame.depth > 0).mean() > 0.3
        assert frame.depth[frame.depth > 0].min() > 0.05
        assert frame.depth.max() <= 120
        assert frame.kind == scenes.KINDS.index(kind)


def test_a_seed_gives_the_same_bytes_by_any_number_of_workers_and_another_seed_does_not(
    tmp_path: Path,
) -> None:
    files = []
    for name, seed, workers in (("a", 5, 1), ("b", 5, 2), ("c", 6, 1)):
        render.render_all(job(tmp_path / name, seed=seed), workers=workers)
        files.append([path.read_bytes() for path in sorted((tmp_path / name).iterdir())])
    assert files[0] == files[1]
    assert files[0] != files[2]


def test_a_shard_on_disk_is_left_alone_and_missing_ones_are_filled_in(tmp_path: Path) -> None:
    render.render_all(job(tmp_path), workers=1)
    whole = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sorted(whole) == ["shard_00000.npz", "shard_00001.npz"]
    (tmp_path / "shard_00001.npz").unlink()
    (tmp_path / "shard_00000.npz").write_bytes(b"kept")
    render.render_all(job(tmp_path), workers=1)
    assert (tmp_path / "shard_00000.npz").read_bytes() == b"kept"
    assert (tmp_path / "shard_00001.npz").read_bytes() == whole["shard_00001.npz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(whole)


def test_a_shard_holds_the_frames_with_their_intrinsics(tmp_path: Path) -> None:
    render.render_all(job(tmp_path, frames=6), workers=1)
    with np.load(tmp_path / "shard_00001.npz") as shard:
        assert shard["rgb"].shape == (2, HEIGHT, WIDTH, 3)
        assert shard["rgb"].dtype == np.uint8
        assert shard["depth"].shape == (2, HEIGHT, WIDTH)
        assert shard["depth"].dtype == np.float32
        assert shard["intrinsics"].shape == (2, 4)
        assert shard["kind"].tolist() == [2, 2]


def test_the_street_samples_scan_lands_on_the_depth_the_camera_sees() -> None:
    square = [(-60, 20, -60), (60, 20, -60), (60, 20, 60), (-60, 20, 60)]
    world = plain_world(shapes.quads([square]))
    view = looking((0, 0, 1.65), (0, 0, 0), fov_deg=80, size=(375, 1242))
    rng = np.random.default_rng(0)
    turn = make_samples.laser_axes()
    scan = make_samples.laser_scan(world, view, turn, rng)
    sparse = make_samples.projected(scan, turn, view)
    assert (sparse > 0).sum() > 5000
    np.testing.assert_allclose(sparse[sparse > 0], 20.0, atol=0.1)


def test_a_written_depth_states_its_scale_and_reads_back(tmp_path: Path) -> None:
    depth = np.array([[0.0, 1.234], [65.0, 0.001]])
    make_samples.write_depth(tmp_path / "d.png", depth, 1000)
    with Image.open(tmp_path / "d.png") as image:
        assert image.info["pnpdepth:scale"] == "1000"
        np.testing.assert_array_equal(np.asarray(image), (depth * 1000).round())
    with pytest.raises(ValueError, match=r"\b66\.0 m does not fit"):
        make_samples.write_depth(tmp_path / "d.png", depth + 1, 1000)
