"""Which frames of a batch get images of their result."""

from __future__ import annotations

import json
from pathlib import Path

from tests.commands.batches import RecordingListener, batch, pairs_on_disk

IMAGES = ("preview", "improvement")


def with_images(root: Path) -> set[str]:
    """Frames with images; each has both or none."""
    names = {
        kind: {p.name.split("_")[0] for p in root.glob(f"out/*_{kind}.png")} for kind in IMAGES
    }
    assert names["preview"] == names["improvement"]
    return names["preview"]


def worse(root: Path) -> set[str]:
    records = {p.stem: json.loads(p.read_text()) for p in root.glob("out/?.json")}
    return {name for name, record in records.items() if record["linear"]["worse"]}


def test_all_frames_none_or_those_worse_than_linear_interpolation_have_images(
    tmp_path: Path,
) -> None:
    root = pairs_on_disk(tmp_path, ("a", "b"))
    batch(root)
    assert with_images(root) == {"a", "b"}
    batch(root, refine={"previews": "worst"})
    assert with_images(root) == worse(root)
    batch(root, refine={"previews": "none"})
    assert with_images(root) == set()
    assert {p.name for p in root.glob("out/*_depth.png")} == {"a_depth.png", "b_depth.png"}


def test_a_batch_without_images_is_done_when_it_runs_again(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path, ("a", "b"))
    batch(root, refine={"previews": "none"})
    listener = RecordingListener()
    batch(root, listener, refine={"previews": "none"})
    assert listener.to_do == 0


def test_the_report_has_frames_without_images(tmp_path: Path) -> None:
    root, report = pairs_on_disk(tmp_path / "frames", ("a",)), tmp_path / "report"
    batch(root, refine={"previews": "none"}, html=report)
    assert (report / "index.html").exists()
    assert not list((report / "images").glob("*.jpg"))
