"""`pnpdepth refine` through files: what is written, recorded, warned of and refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.frame_record import FrameRecord, PointsRecord
from pnpdepth_cli.errors import (
    InputError,
    LayerError,
    NoPointsError,
    OutputError,
    PnpDepthError,
    SizeError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.network import load_network
from tests.commands.frames import FrameOnDisk, run


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def noted(record: FrameRecord, text: str) -> bool:
    return any(text in note for note in record.notes)


def points_of(record: FrameRecord) -> PointsRecord:
    assert record.points is not None
    return record.points


def change_of(record: FrameRecord, basis: str) -> float:
    """The MAE of the result as a fraction of that before."""
    before, after = (record.errors[basis][stage]["mae"] for stage in ("before", "after"))
    assert before is not None
    assert after is not None
    return after / before


def test_refinement_lowers_the_error_and_the_scores_are_those_of_the_file(
    frame: FrameOnDisk,
) -> None:
    asked = {"gt": frame.gt, "iterations": 40, "lr": "20%", "update": "adam", "format": "npy"}
    record = run(frame, **asked)
    for basis in ("used", "ground_truth"):
        assert change_of(record, basis) < 0.8
    first, *updated = record.loss
    assert len(updated) == 40
    assert updated[-1] is not None
    assert first is not None
    assert updated[-1] < first
    written = np.load(frame.folder / "out" / "img_depth.npy").astype(np.float64)
    error = np.abs(written - read_depth(frame.gt).values)
    assert record.errors["ground_truth"]["after"]["mae"] == pytest.approx(error.mean(), abs=1e-9)
    range_of_points = points_of(record).nearest, points_of(record).farthest
    known = read_depth(frame.sparse).values
    assert range_of_points == (float(known[known > 0].min()), float(known.max()))


@pytest.mark.parametrize("scale", [1000.0, 1.0])
def test_ground_truth_whose_assumed_scale_is_another_one_in_use_stops_and_names_the_option(
    frame: FrameOnDisk, scale: float
) -> None:
    codes = np.rint(read_depth(frame.gt).values * scale).astype(np.uint16)
    Image.fromarray(codes).save(frame.folder / "codes.png")  # 256 is assumed
    with pytest.raises(InputError, match="gt_scale"):
        run(frame, gt=frame.folder / "codes.png")
    assert not (frame.folder / "out").exists()
    if scale > 1:
        run(frame, gt=frame.folder / "codes.png", gt_scale=scale, iterations=0)


def test_no_iterations_give_the_networks_own_prediction_bit_for_bit(frame: FrameOnDisk) -> None:
    run(frame, iterations=0, output=frame.folder / "plain.npy")
    network = load_network(str(frame.model), frame.checkpoint)
    rgb = torch.from_numpy(read_rgb(frame.image).values).permute(2, 0, 1)[None]
    padded = torch.nn.functional.pad(rgb, (0, 2, 0, 2), mode="replicate")
    with torch.no_grad():
        own = network.module(padded)[0, 0, : rgb.shape[2], : rgb.shape[3]]
    assert np.array_equal(np.load(frame.folder / "plain.npy"), own.numpy())


def test_held_out_points_are_a_seeded_share_that_the_loss_never_sees(frame: FrameOnDisk) -> None:
    first, again, other = (
        run(frame, holdout=0.25, seed=seed, output=frame.folder / name, gt=frame.gt)
        for name, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    assert (points_of(first).held_out, points_of(first).used) == (15, 45)
    assert first.errors["held_out"]["after"]["points"] == 15
    assert first.loss == again.loss != other.loss
    for path in (frame.folder / "a").glob("*.png"):
        assert path.read_bytes() == (frame.folder / "b" / path.name).read_bytes()


def test_the_part_that_improved_is_of_the_ground_truth_else_of_held_out_points(
    frame: FrameOnDisk,
) -> None:
    before, after = (
        run(frame, iterations=count, gt=frame.gt, output=frame.folder / f"{count}.npy")
        for count in (0, 5)
    )
    truth = read_depth(frame.gt).values
    errors = [np.abs(np.load(frame.folder / f"{count}.npy") - truth) for count in (0, 5)]
    fell = (errors[1] < errors[0])[truth > 0].mean()
    assert (before.improved_fraction, after.improved_fraction) == (0, pytest.approx(fell, abs=1e-3))
    assert 0 < fell < 1
    of_points = run(frame, holdout=0.25, output=frame.folder / "held").improved_fraction
    assert of_points in [n / 15 for n in range(16)]
    assert run(frame).improved_fraction is None


def test_existing_results_are_replaced_only_on_request_and_inputs_never(frame: FrameOnDisk) -> None:
    run(frame)
    depth = frame.folder / "out" / "img_depth.png"
    old = depth.read_bytes()
    with pytest.raises(OutputError, match="--overwrite"):
        run(frame, iterations=0)
    assert depth.read_bytes() == old
    run(frame, iterations=0, overwrite=True)
    assert depth.read_bytes() != old
    with pytest.raises(OutputError, match="one of the inputs"):
        run(frame, output=frame.sparse, overwrite=True)


def test_of_a_result_that_cannot_be_written_whole_nothing_stays(
    frame: FrameOnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise StorageError("the disk is full")

    monkeypatch.setattr("pnpdepth_cli.dataset.frame_record.write_json", full)
    with pytest.raises(StorageError):
        run(frame)
    assert not list((frame.folder / "out").iterdir())


def test_a_point_between_pixels_is_enough_and_points_outside_are_counted(
    frame: FrameOnDisk,
) -> None:
    points = frame.folder / "points.csv"
    points.write_text("x,y,depth\n30.25,20.5,2.0\n500,2,3\n")
    record = run(frame, sparse=points, iterations=20)
    assert points_of(record).used == 1
    assert noted(record, "1 points outside the image")
    assert change_of(record, "used") < 1


def test_the_networks_crop_leaves_the_rest_unknown_and_refuses_points_only_there(
    frame: FrameOnDisk,
) -> None:
    model = frame.folder / "cropped.py"
    text = frame.model.read_text().replace("Multiple(4)", "Fixed(32, 32, fit='crop')")
    model.write_text(text.replace("Multiple,", "Fixed,"))
    record = run(frame, model=str(model), output=frame.folder / "d.npy", gt=frame.gt)
    known = np.load(frame.folder / "d.npy") > 0
    assert (known == ((np.arange(62) >= 8) & (np.arange(62) < 54))).all()
    scored = np.count_nonzero(known & (read_depth(frame.gt).values > 0))
    stages = record.errors["ground_truth"]
    assert stages["linear"]["pixels"] == stages["after"]["pixels"] == scored
    left = frame.folder / "left.csv"
    left.write_text("1 5 2.0\n2 9 2.0\n")
    with pytest.raises(NoPointsError, match="none of the 2 sparse points"):
        run(frame, model=str(model), sparse=left)


BAD: list[tuple[dict[str, Any], type[PnpDepthError], str]] = [
    ({"holdout": 1.0}, UsageError, "--holdout must be a fraction"),
    ({"layer": "1.5"}, UsageError, "between 0 and 1"),
    ({"layer": "midle"}, LayerError, "did you mean middle"),
    ({"image": None}, PnpDepthError, "takes an rgb image"),
    ({"device": "cuda:7"}, PnpDepthError, "device cpu"),
    ({"depth_scale": -1.0}, UsageError, "scale"),
    ({"gt": "small.npy"}, SizeError, "ground truth .* is 62×10 but the image is 62×46"),
    ({"sparse": None}, InputError, "has no sparse depth; add it, or sample the ground truth"),
    ({"sparse": ".", "scan": ScanOptions(camera=1)}, UsageError, "of a LiDAR scan do not app"),
    ({"sparse": "far.csv"}, NoPointsError, "none of its 1 points lies in the image"),
    ({"view_3d": True}, UsageError, r"--html-3d needs the camera, .* give --calib"),
    ({"uncertainty": True, "output": Path("a.exr")}, UsageError, "--uncertainty writes a second"),
]


@pytest.mark.parametrize(("changes", "error", "message"), BAD)
def test_a_mistake_gives_one_clear_line_and_writes_nothing(
    frame: FrameOnDisk, changes: dict[str, Any], error: type[PnpDepthError], message: str
) -> None:
    np.save(frame.folder / "small.npy", frame.depth[:10])
    (frame.folder / "far.csv").write_text("x,y,depth\n500,5,2\n")
    before = files(frame.folder)
    paths = {part: changes[part] for part in ("gt", "sparse") if changes.get(part)}
    changes = changes | {part: frame.folder / path for part, path in paths.items()}
    with pytest.raises(error, match=message) as caught:
        run(frame, **changes)
    assert "\n" not in str(caught.value)
    assert files(frame.folder) == before
