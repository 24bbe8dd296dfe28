"""The scene renderer: known depth in every kind of scene, the same bytes for the same seed."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("embreex", reason="embreex is not installed (extra [train])")

from model_zoo_defs.training.rendering import render
from model_zoo_defs.training.scenes import scenes

pytestmark = pytest.mark.slow

HEIGHT, WIDTH = 48, 64


@pytest.mark.parametrize("kind", scenes.KINDS)
def test_every_kind_renders_a_full_scene_of_known_depth(kind: str) -> None:
    frames = scenes.scene_frames(11, 0, height=HEIGHT, width=WIDTH, kinds=(kind,))
    assert len(frames) == scenes.VIEWS_PER_SCENE
    for frame in frames:
        assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
        assert frame.rgb.std() > 3
        known = frame.depth[frame.depth > 0]
        assert known.size > 0.3 * HEIGHT * WIDTH
        assert 0.05 < known.min() <= known.max() <= 120
        assert frame.kind == scenes.KINDS.index(kind)


def test_a_seed_gives_the_same_bytes_by_any_number_of_workers_and_another_seed_does_not(
    tmp_path: Path,
) -> None:
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
