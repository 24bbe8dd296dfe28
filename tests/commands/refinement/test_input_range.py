"""The input range of a network that states none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.batch.running import spread
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.frames.resolve import NORMALISATIONS, choose_input_range
from tests.commands.batches import batch, pairs_on_disk


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ({"unit": 0.064, "imagenet": 0.062, "symmetric": 0.07, "bytes": 0.3}, ("unit", "imagenet")),
        ({"unit": 0.06, "imagenet": 0.15, "symmetric": 0.2, "bytes": 0.3}, ("unit", None)),
        ({"unit": 0.2, "imagenet": 0.05, "symmetric": 0.15, "bytes": 0.3}, ("imagenet", None)),
        ({"unit": 0.2, "imagenet": 0.05, "symmetric": 0.06, "bytes": 1}, ("imagenet", "symmetric")),
    ],
)
def test_0_to_1_is_kept_unless_clearly_beaten(
    errors: dict[str, float], expected: tuple[str, str | None]
) -> None:
    assert choose_input_range(errors) == expected


def test_the_ranges_are_those_of_their_names() -> None:
    ends = np.array([[0.0], [1.0]])
    ranges = {name: (ends - how.mean) / how.std for name, how in NORMALISATIONS.items()}
    for name, (low, high) in {"unit": (0, 1), "symmetric": (-1, 1), "bytes": (0, 255)}.items():
        assert ranges[name].tolist() == [[low] * 3, [high] * 3]
    assert ranges["imagenet"][1].round(3).tolist() == [2.249, 2.429, 2.64]  # as is often printed


def test_a_batch_compares_input_ranges_on_three_frames(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    model = root / "net" / "my_net.py"
    model.write_text(model.read_text().replace("build=Net", "build=Net, normalisation=None"))
    batch(root)
    record = FrameRecord.read(root / "out" / "a.json")
    assert record.settings["normalise"] in NORMALISATIONS
    assert any("mean of 3 frames" in note for note in record.notes)


def test_the_frames_that_decide_are_spread_from_the_first_to_the_last() -> None:
    assert spread(37) == [0, 2, 4, 7, 9, 12, 14, 16, 19, 21, 24, 26, 28, 31, 33, 36]
    assert [spread(count) for count in (1, 3)] == [[0], [0, 1, 2]]
