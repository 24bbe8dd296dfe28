from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli import Refiner, load_network
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.settings import Settings
from tests.commands.batches import batch
from tests.commands.frames import FrameOnDisk, run
from tests.completion.unregistered import SIZE, UNREGISTERED
from tests.completion.unregistered import frame as unregistered


def write_frame(root: Path, seed: int, count: int) -> dict[str, Path]:
    """Writes a frame that is not registered into rgb/ and sparse/; returns its files."""
    rgb, points = unregistered(seed, UNREGISTERED, count)
    files = {"image": root / f"rgb/{seed:03}.png", "sparse": root / f"sparse/{seed:03}.png"}
    for path in files.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(files["image"]), np.rint(rgb[..., ::-1] * 255).astype(np.uint8))
    depth = np.zeros(SIZE, np.float32)
    column, row = points.xy.numpy().astype(int).T
    depth[row, column] = points.depth.numpy()
    write_depth(files["sparse"], depth, scale=1000)
    return files


def refined(folder: Path, own: FrameOnDisk, count: int = 500, **options: Any) -> FrameRecord:
    """The record of the frame, refined with these options."""
    files: dict[str, Any] = write_frame(folder, 0, count)
    return run(own, **files | {"output": folder / "out", "overwrite": True} | options)


def test_an_unregistered_image_is_moved_but_not_if_off_nor_by_the_papers_method(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    moved = refined(tmp_path, frame)
    assert moved.registration is not None
    assert moved.registration["zoom"] == pytest.approx(UNREGISTERED.zoom, abs=0.012)
    assert any(note.startswith("image: moved") for note in moved.notes)
    assert refined(tmp_path, frame, method="paper").registration is None
    assert refined(tmp_path, frame, registration="off").registration is None
    given = refined(tmp_path, frame, registration=(0.9, -5.0, 3.0)).registration
    assert given == {"zoom": 0.9, "right": -5.0, "down": 3.0}


def test_a_moved_image_gives_what_the_same_image_moved_on_disk_gives(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    refined(tmp_path, frame, registration=(1.0, -4.0, 3.0), output=tmp_path / "a.npy")
    files = write_frame(tmp_path, 0, 500)
    image = cv2.imread(str(files["image"]))
    moved = np.pad(image, ((0, 3), (4, 0), (0, 0)), mode="edge")[3:, :-4]
    cv2.imwrite(str(tmp_path / "moved.png"), moved)
    changes: dict[str, Any] = {"image": tmp_path / "moved.png", "registration": "off"}
    refined(tmp_path, frame, output=tmp_path / "b.npy", **changes)
    assert np.array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))


def test_held_out_points_take_no_part(tmp_path: Path, frame: FrameOnDisk) -> None:
    whole = refined(tmp_path, frame, count=800).registration
    record = refined(tmp_path, frame, count=800, holdout=0.5, seed=3)
    assert record.points is not None
    assert record.points.used == 400
    assert None not in (whole, record.registration)
    assert record.registration != whole


def test_the_frames_of_a_batch_share_a_registration_that_none_shows_alone(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    assert refined(tmp_path / "alone", frame, count=80).registration is None
    for seed in range(8):
        write_frame(tmp_path / "in", seed, 80)
    network = {"model": str(frame.model), "checkpoint": frame.checkpoint}
    batch(tmp_path, source=tmp_path / "in", refine=network)
    records = (tmp_path / "out").glob("0*.json")
    first, *others = (FrameRecord.read(path).registration for path in records)
    assert first is not None
    assert first["zoom"] == pytest.approx(UNREGISTERED.zoom, abs=0.02)
    assert others == [first] * 7
    # So do arrays of a sequence.
    frames = [unregistered(seed, UNREGISTERED, 80) for seed in range(8)]
    network, fixed = load_network("compact"), Settings(propagate="none")
    with Refiner(network, fixed) as alone, Refiner(network, fixed) as together:
        together.share_registration(frames)
        moved = [refiner.refine(*frames[0]).registration for refiner in (alone, together)]
    assert moved[0] is None
    assert moved[1] is not None
    assert moved[1].zoom == pytest.approx(UNREGISTERED.zoom, abs=0.02)
