"""Which frames of a batch get images of their result."""

from __future__ import annotations

import json
from pathlib import Path

from tests.commands.batches import RecordingListener, batch, pairs_on_disk


def with_images(root: Path) -> list[set[str]]:
    kinds = ("preview", "improvement", "depth")
    return [{path.name[0] for path in root.glob(f"out/*_{kind}.png")} for kind in kinds]


def test_all_frames_none_or_those_worse_than_linear_interpolation_have_images(
    tmp_path: Path,
) -> None:
    root, report = pairs_on_disk(tmp_path / "frames", ("a", "b")), tmp_path / "report"
    batch(root)
    assert with_images(root) == [{"a", "b"}] * 3
    batch(root, refine={"previews": "worst"})
    records = {path.stem: json.loads(path.read_text()) for path in root.glob("out/?.json")}
    worse = {name for name, record in records.items() if record["linear"]["worse"]}
    assert with_images(root) == [worse, worse, {"a", "b"}]
    for to_do in (2, 0):
        listener = RecordingListener()
        batch(root, listener, refine={"previews": "none"}, html=report)
        assert (listener.to_do, with_images(root)) == (to_do, [set(), set(), {"a", "b"}])
    assert not list((report / "images").glob("*.jpg"))
