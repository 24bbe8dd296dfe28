from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli import Refiner, load_network
from pnpdepth_cli.commands.refinement.refine_image import read_requested
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.completion.image_registration import estimate_registration, evidence
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.settings import Settings
from tests.commands.batches import batch
from tests.commands.frames import FrameOnDisk, run
from tests.completion.unregistered import SIZE, UNREGISTERED, frame


def write_frame(root: Path, seed: int, count: int) -> dict[str, Path]:
    """Writes a frame that is not registered into rgb/ and sparse/; returns its files."""
    rgb, points = frame(seed, UNREGISTERED, count)
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


def test_an_unregistered_image_is_moved_and_the_record_says_so(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    record = refined(tmp_path / "a", frame)
    assert record.registration is not None
    assert record.registration["zoom"] == pytest.approx(UNREGISTERED.zoom, abs=0.012)
    assert any(note.startswith("image: moved") for note in record.notes)


def test_off_and_the_papers_method_leave_the_image_and_numbers_are_recorded(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    assert refined(tmp_path / "a", frame, method="paper").registration is None
    assert refined(tmp_path / "a", frame, registration="off").registration is None
    request = RefineRequest().with_fields(**write_frame(tmp_path, 0, 500), registration="off")
    assert read_requested(request).one_view
    record = refined(tmp_path / "a", frame, registration=(0.9, -5.0, 3.0))
    assert record.registration == {"zoom": 0.9, "right": -5.0, "down": 3.0}


def test_a_moved_image_gives_what_the_same_image_moved_on_disk_gives(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    refined(tmp_path, frame, registration=(1.0, -4.0, 3.0), output=tmp_path / "a.npy")
    files = write_frame(tmp_path, 0, 500)
    image = cv2.imread(str(files["image"]))
    rows = (np.arange(SIZE[0]) + 3).clip(0, SIZE[0] - 1)
    columns = (np.arange(SIZE[1]) - 4).clip(0, SIZE[1] - 1)
    cv2.imwrite(str(tmp_path / "moved.png"), image[rows][:, columns])
    changes: dict[str, Any] = {"image": tmp_path / "moved.png", "registration": "off"}
    refined(tmp_path, frame, output=tmp_path / "b.npy", **changes)
    assert np.array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))


def test_held_out_points_take_no_part(tmp_path: Path, frame: FrameOnDisk) -> None:
    files = write_frame(tmp_path, 0, 800)
    inputs = read_requested(RefineRequest().with_fields(**files))
    record = refined(tmp_path, frame, count=800, holdout=0.5, seed=3)
    assert inputs.image is not None
    all_points = evidence(inputs.image, inputs.points)
    assert all_points is not None
    whole = estimate_registration([all_points])
    assert whole is not None
    assert record.points is not None
    assert record.points.used == 400
    assert record.registration is not None
    assert record.registration["right"] != whole.right


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


def test_arrays_of_a_sequence_share_a_registration_that_one_alone_does_not_show() -> None:
    frames = [frame(seed, UNREGISTERED, 80) for seed in range(8)]
    network, fixed = load_network("compact"), Settings(propagate="none")
    with Refiner(network, fixed) as alone, Refiner(network, fixed) as together:
        together.share_registration(frames)
        moved = [refiner.refine(*frames[0]).registration for refiner in (alone, together)]
    assert moved[0] is None
    assert moved[1] is not None
    assert moved[1].zoom == pytest.approx(UNREGISTERED.zoom, abs=0.02)
