"""The scene renderer: exact depth, the same bytes for the same seed, resuming, sample files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="embreex is not installed (extra [train])")

from model_zoo_defs.training.rendering import render, shapes
from model_zoo_defs.training.rendering.materials import Palette
from model_zoo_defs.training.rendering.shading import seen
from model_zoo_defs.training.rendering.shapes import Group
from model_zoo_defs.training.scenes import scenes
from model_zoo_defs.training.scenes.world import Sky, World, looking

pytestmark = pytest.mark.slow

HEIGHT, WIDTH = 48, 64


def test_the_depth_of_a_slanted_floor_solves_its_plane_equation() -> None:
    palette = Palette(np.random.default_rng(0))
    group = Group()
    floor = [(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)]
    group.add(shapes.quads([floor]), palette.new("plain"))
    mesh, materials = group.merged()
    white, grey = (1.0, 1.0, 1.0), (0.5, 0.5, 0.5)
    sky = Sky(
        zenith=white, horizon=white, clouds=0.0, ambient_up=grey, ambient_down=grey, haze_m=0.0,
        occlusion_m=1.0,
    )  # fmt: skip
    world = World(mesh=mesh, face_material=materials, table=palette.frozen(), lights=(), sky=sky)
    turn, size = (0.4, -0.7, 0.05), (HEIGHT, WIDTH)
    view = looking((0.3, -0.2, 1.5), turn, fov_deg=70, shift=(0.1, 0), size=size)
    _, depth = seen(world, view, np.random.default_rng(0))
    _, directions = view.grid()
    expected = (-1.5 / directions[:, 2].astype(float)).reshape(HEIGHT, WIDTH)
    assert (depth > 0).all()
    np.testing.assert_allclose(depth, expected, rtol=1e-5)


@pytest.fixture(scope="module", params=scenes.KINDS)
def rendered(request: pytest.FixtureRequest) -> tuple[str, list[scenes.Frame]]:
    """A kind of scene with its frames."""
    return request.param, scenes.scene_frames(
        11, 0, height=HEIGHT, width=WIDTH, kinds=(request.param,)
    )


def test_a_scene_has_its_views_and_they_are_of_its_kind(
    rendered: tuple[str, list[scenes.Frame]],
) -> None:
    kind, frames = rendered
    assert len(frames) == scenes.VIEWS_PER_SCENE
    assert {frame.kind for frame in frames} == {scenes.KINDS.index(kind)}


def test_a_view_shows_something(rendered: tuple[str, list[scenes.Frame]]) -> None:
    for frame in rendered[1]:
        assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
        assert frame.rgb.std() > 3


def test_a_view_has_depth_of_a_room_or_a_street_at_a_third_of_its_pixels(
    rendered: tuple[str, list[scenes.Frame]],
) -> None:
    for frame in rendered[1]:
        known = frame.depth[frame.depth > 0]
        assert known.size > 0.3 * HEIGHT * WIDTH
        assert 0.05 < known.min() <= known.max() <= 120


def test_only_the_same_seed_gives_the_same_bytes_by_any_number_of_workers(tmp_path: Path) -> None:
    files = []
    for name, seed, workers in (("a", 5, 1), ("b", 5, 2), ("c", 6, 1)):
        job = render.Job(
            out=tmp_path / name, seed=seed, height=HEIGHT, width=WIDTH, frames=8, shard_frames=4,
            kinds=("desk",),
        )  # fmt: skip
        render.render_all(job, workers=workers)
        files.append([path.read_bytes() for path in sorted((tmp_path / name).iterdir())])
    assert files[0] == files[1]
    assert files[0] != files[2]
