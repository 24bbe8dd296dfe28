"""`batch --batch-size N`: frames of one size go through the network together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.io.depth import read_depth
from tests.commands.batches import NAMES, RecordingListener, add_frame, batch, pairs_on_disk


def depths(folder: Path) -> dict[str, Any]:
    return {path.name: read_depth(path).values for path in sorted(folder.glob("*_depth.png"))}


def test_frames_that_go_together_are_those_of_one_at_a_time_but_for_rounding(
    tmp_path: Path,
) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    add_frame(root, "e", np.zeros((20, 33, 3), np.uint8), gt=False)
    cv2.imwrite(str(root / "sparse/e.png"), np.full((20, 33), 2000, np.uint16))
    (root / "rgb/b.png").write_bytes(b"no image")
    batch(root, output=root / "alone")
    listener = RecordingListener()
    batch(root, listener, batch_size=3)
    assert [row["status"] for row in listener.rows] == ["done", "failed", "done", "done", "done"]
    alone, together = depths(root / "alone"), depths(root / "out")
    assert alone.keys() == together.keys()
    for name, depth in alone.items():
        np.testing.assert_allclose(together[name], depth, rtol=2e-3)
    note = "refined together with 1 others, which alters the last bits"
    records = [json.loads((root / f"out/{name}.json").read_text()) for name in "ae"]
    assert [note in record["notes"] for record in records] == [True, False]


MEAN = "        rgb = rgb * (0.5 + rgb.mean())\n        return"


@pytest.mark.parametrize(
    ("code", "why", "times"),
    [
        (MEAN, "frames that go together influence each other", 1),
        ("        assert len(rgb) == 1\n        return", "one at a time; together:", 2),
    ],
)
def test_a_network_that_does_not_take_frames_together_gets_one_at_a_time(
    tmp_path: Path, code: str, why: str, times: int
) -> None:
    root = pairs_on_disk(tmp_path / "drive", NAMES[:3])
    for name in "0e":  # the first and the last of two groups
        add_frame(root, name, np.full((46, 62, 3), 255, np.uint8))
    model = root / "net/my_net.py"
    model.write_text(model.read_text().replace("        return", code, 1))
    batch(root, output=root / "alone")
    listener = RecordingListener()
    batch(root, listener, batch_size=3)
    assert sum(why in text for text in listener.messages) == times
    alone, together = depths(root / "alone"), depths(root / "out")
    assert all(np.array_equal(together[name], depth) for name, depth in alone.items())


def test_tiles_take_one_frame_at_a_time_and_say_so(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive", NAMES[:2])
    listener = RecordingListener()
    batch(root, listener, batch_size=2, refine={"iterations": 1, "tile": 64})
    assert {row["status"] for row in listener.rows} == {"done"}
    assert any(text.startswith("batch size: 1; only frames of a") for text in listener.messages)
