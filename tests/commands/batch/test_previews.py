"""The images of a frame are for a person, and may be deleted."""

from __future__ import annotations

from pathlib import Path

from tests.commands.batches import RecordingListener, batch, pairs_on_disk


def test_deleted_images_are_not_made_again_and_a_report_does_without(tmp_path: Path) -> None:
    root, report = pairs_on_disk(tmp_path / "frames", ("a", "b")), tmp_path / "report"
    batch(root)
    for kind in ("preview", "improvement"):
        (root / f"out/a_{kind}.png").unlink()
    listener = RecordingListener()
    batch(root, listener, html=report)
    assert listener.to_do == 0
    assert len({path.name[0] for path in (report / "images").iterdir()}) == 1
