from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pnpdepth_cli.errors import (
    DivergedError,
    InputError,
    LayerError,
    NoPointsError,
    OutputError,
    PnpDepthError,
    SizeError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.models.network import load_network
from tests.commands.frames import FrameOnDisk, run


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_folder_gets_depth_preview_improvement_map_and_record(frame: FrameOnDisk) -> None:
    outcome = run(frame)
    out = frame.folder / "out"
    assert files(out) == {"img_depth.png", "img_preview.png", "img_improvement.png", "img.json"}
    assert json.loads((out / "img.json").read_text()) == json.loads(json.dumps(outcome.record))
    assert read_depth(out / "img_depth.png").values.shape == frame.depth.shape


def test_refinement_lowers_the_error_at_the_points_and_against_the_truth(
    frame: FrameOnDisk,
) -> None:
    record = run(frame, gt=frame.gt, iterations=40, lr="20%", update="adam").record
    for measured in ("sparse_error", "scores"):
        assert record[measured]["after"]["mae"] < 0.8 * record[measured]["before"]["mae"]
    assert len(record["loss"]) == 41
    assert record["loss"][-1] < record["loss"][0]
    assert 0 < record["improved_fraction"] < 1


def test_ground_truth_that_is_the_sparse_depth_is_warned_of(frame: FrameOnDisk) -> None:
    leaked = run(frame, gt=frame.sparse).record["notes"]
    assert any(
        "warning: 60 of 60 pixels (100.0%) of the ground truth are the sparse depth" in note
        for note in leaked
    )
    notes = run(frame, gt=frame.gt, overwrite=True).record["notes"]
    assert not any("sparse depth itself" in note for note in notes)


def test_a_wrong_scale_of_the_ground_truth_is_warned_of(frame: FrameOnDisk) -> None:
    notes = run(frame, gt=frame.gt, gt_scale=256.0, iterations=0).record["notes"]
    assert any("the ground truth is 3.91 times the sparse depth" in note for note in notes)
    notes = run(frame, gt=frame.gt, iterations=0, overwrite=True).record["notes"]
    assert not any("times the sparse depth" in note for note in notes)


def test_a_point_beyond_everything_is_dropped_with_a_note(frame: FrameOnDisk) -> None:
    depth = read_depth(frame.sparse).values.copy()
    rows, columns = np.nonzero(depth)
    depth[rows[0], columns[0]] = 1e30
    write_depth(frame.folder / "far.npy", depth)
    record = run(frame, sparse=frame.folder / "far.npy", iterations=0).record
    assert record["points"]["used"] == len(rows) - 1
    assert record["points"]["farthest"] < 10
    assert any("dropped 1 of 60 points more than 1,000 times" in note for note in record["notes"])


def test_the_scores_of_the_record_are_those_of_the_written_file(frame: FrameOnDisk) -> None:
    record = run(frame, gt=frame.gt, format="npy").record
    written = read_depth(frame.folder / "out" / "img_depth.npy").values
    error = np.abs(written.astype(np.float64) - read_depth(frame.gt).values)
    assert record["scores"]["after"]["mae"] == pytest.approx(error.mean(), abs=1e-9)


def test_no_iterations_give_the_networks_own_prediction_bit_for_bit(frame: FrameOnDisk) -> None:
    run(frame, iterations=0, output=frame.folder / "plain.npy")
    network = load_network(str(frame.model), frame.checkpoint)
    rgb = torch.from_numpy(_read_rgb(frame.image)).permute(2, 0, 1)[None]
    padded = torch.nn.functional.pad(rgb, (0, 2, 0, 2), mode="replicate")
    with torch.no_grad():
        own = network.module(padded)[0, 0, : rgb.shape[2], : rgb.shape[3]]
    assert np.array_equal(np.load(frame.folder / "plain.npy"), own.numpy())


def _read_rgb(path: Path) -> Any:
    from pnpdepth_cli.io.rgb import read_rgb

    return read_rgb(path).values


def test_same_inputs_options_and_seed_give_the_same_bytes(frame: FrameOnDisk) -> None:
    digests = []
    for name in ("a", "b"):
        run(frame, output=frame.folder / name, holdout=0.3, seed=3, gt=frame.gt)
        paths = sorted((frame.folder / name).glob("*.png"))
        digests.append([hashlib.sha256(path.read_bytes()).hexdigest() for path in paths])
    assert len(digests[0]) == 3
    assert digests[0] == digests[1]


def test_held_out_points_are_a_seeded_share_that_the_loss_never_sees(frame: FrameOnDisk) -> None:
    record = run(frame, holdout=0.25, seed=1).record
    assert record["points"]["held_out"] == 15
    assert record["points"]["used"] == 45
    assert record["held_out_error"]["after"]["points"] == 15
    other = run(frame, holdout=0.25, seed=2, output=frame.folder / "other").record
    assert other["loss"] != record["loss"]


def test_a_depth_file_as_output_is_written_alone(frame: FrameOnDisk) -> None:
    before = files(frame.folder)
    for suffix in ("exr", "npy", "npz", "pfm", "tiff", "png"):
        run(frame, output=frame.folder / f"depth.{suffix}")
    assert files(frame.folder) - before == {
        f"depth.{suffix}" for suffix in ("exr", "npy", "npz", "pfm", "tiff", "png")
    }


def test_integer_output_takes_the_scale_of_the_sparse_file(frame: FrameOnDisk) -> None:
    run(frame)
    assert read_depth(frame.folder / "out" / "img_depth.png").scale == 1000


def test_existing_results_are_kept_unless_overwriting_is_asked_for(frame: FrameOnDisk) -> None:
    run(frame)
    old = (frame.folder / "out" / "img_depth.png").read_bytes()
    with pytest.raises(OutputError, match="--overwrite"):
        run(frame, iterations=0)
    assert (frame.folder / "out" / "img_depth.png").read_bytes() == old
    run(frame, iterations=0, overwrite=True)
    assert (frame.folder / "out" / "img_depth.png").read_bytes() != old


def test_of_a_result_that_cannot_be_written_whole_nothing_stays(
    frame: FrameOnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise StorageError("the disk is full")

    monkeypatch.setattr("pnpdepth_cli.commands.refinement.output_files.write_json", full)
    with pytest.raises(StorageError):
        run(frame)
    assert not list((frame.folder / "out").iterdir())


def test_the_record_has_every_setting_that_changes_the_depth(frame: FrameOnDisk) -> None:
    plain = run(frame).record["settings"]
    for name, value in (("propagate", "gp"), ("output_kind", "inverse"), ("normalise", "bytes")):
        other = run(frame, overwrite=True, **{name: value}).record["settings"]
        assert {key for key in other if other[key] != plain[key]} == {name}
        assert other[name] == value


def test_an_input_is_never_overwritten(frame: FrameOnDisk) -> None:
    with pytest.raises(OutputError, match="one of the inputs"):
        run(frame, output=frame.sparse, overwrite=True)


def test_sparse_depth_of_another_size_is_mapped_only_when_asked_for(frame: FrameOnDisk) -> None:
    half = frame.folder / "half.npy"
    write_depth(half, frame.depth[::2, ::2])
    with pytest.raises(SizeError, match=r"31×23 but .* is 62×46"):
        run(frame, sparse=half)
    assert run(frame, sparse=half, sparse_size_ok=True).record["points"]["used"] == 23 * 31


def test_point_lists_with_fractions_of_pixels_work_and_points_outside_are_counted(
    frame: FrameOnDisk,
) -> None:
    points = frame.folder / "points.csv"
    points.write_text("x,y,depth\n10.25,20.5,2.0\n30,31.75,2.5\n500,2,3\n")
    record = run(frame, sparse=points).record
    assert record["points"]["used"] == 2
    assert any("1 points outside the image" in note for note in record["notes"])


def test_one_point_is_enough(frame: FrameOnDisk) -> None:
    points = frame.folder / "point.csv"
    points.write_text("30 20 2.0\n")
    record = run(frame, sparse=points, iterations=20).record
    assert record["sparse_error"]["after"]["mae"] < record["sparse_error"]["before"]["mae"]


def test_a_divergence_writes_the_last_good_depth_and_is_reported(frame: FrameOnDisk) -> None:
    model = frame.folder / "bad.py"
    text = frame.model.read_text().replace(
        "2 + 3 * self.decode(torch.tanh(self.middle(self.encode(rgb))))",
        "torch.exp(self.decode(self.middle(self.encode(rgb))))",
    )
    model.write_text(text)
    outcome = run(frame, model=str(model), lr="1e4", gt=frame.gt)
    assert isinstance(outcome.diverged, DivergedError)
    assert outcome.record["diverged"] == str(outcome.diverged)
    written = read_depth(frame.folder / "out" / "img_depth.png").values
    assert np.isfinite(written).all()
    assert (written > 0).all()


def test_the_networks_crop_leaves_the_rest_unknown_and_refuses_points_only_there(
    frame: FrameOnDisk,
) -> None:
    model = frame.folder / "cropped.py"
    text = frame.model.read_text().replace("Multiple(4)", "Fixed(32, 32, fit='crop')")
    model.write_text(text.replace("Multiple,", "Fixed,"))
    run(frame, model=str(model), output=frame.folder / "d.npy")
    depth = np.load(frame.folder / "d.npy")
    assert (depth[:, 8:54] > 0).all()
    assert (depth[:, :8] == 0).all()
    assert (depth[:, 54:] == 0).all()
    left = frame.folder / "left.csv"
    left.write_text("1 5 2.0\n2 9 2.0\n")
    with pytest.raises(NoPointsError, match="none of the 2 sparse points"):
        run(frame, model=str(model), sparse=left)


def test_a_layer_can_be_a_share_of_the_definitions_layers(frame: FrameOnDisk) -> None:
    for share, layer in (("0", "encode"), ("1", "middle"), ("0.2", "encode")):
        record = run(frame, layer=share, output=frame.folder / f"at{share}").record
        assert record["settings"]["layer"] == layer


BAD = [
    ({"iterations": -1}, UsageError, "iterations must be a whole number >= 0, got -1"),
    ({"lr": "nan"}, UsageError, "lr must be a step size above 0"),
    ({"lr": "0"}, UsageError, "lr must be a step size above 0"),
    ({"lr": "fast"}, UsageError, "lr must be a step size above 0"),
    ({"holdout": 1.0}, UsageError, "--holdout must be a fraction"),
    ({"layer": "1.5"}, UsageError, "between 0 and 1"),
    ({"layer": "midle"}, LayerError, "did you mean middle"),
    ({"layer": "unused"}, LayerError, "never runs"),
    ({"image": None}, PnpDepthError, "takes an rgb image"),
    ({"device": "cuda:7"}, PnpDepthError, "--device cpu"),
    ({"device": "tpu"}, PnpDepthError, "--device cpu"),
    ({"format": "jpg"}, UsageError, "not one of"),
    ({"depth_scale": -1.0}, UsageError, "scale"),
    ({"time_budget_s": 5.0}, UsageError, "--propagate makes none"),
]


@pytest.mark.parametrize(("changes", "error", "message"), BAD)
def test_a_mistake_gives_one_clear_line_and_writes_nothing(
    frame: FrameOnDisk, changes: dict[str, Any], error: type[PnpDepthError], message: str
) -> None:
    before = files(frame.folder)
    with pytest.raises(error, match=message) as caught:
        run(frame, **changes)
    assert "\n" not in str(caught.value)
    assert files(frame.folder) == before


def test_a_truth_of_another_size_or_without_depth_is_refused(frame: FrameOnDisk) -> None:
    small, empty = frame.folder / "small.npy", frame.folder / "empty.npy"
    np.save(small, frame.depth[:10])
    np.save(empty, 0 * frame.depth)
    with pytest.raises(SizeError, match="ground truth"):
        run(frame, gt=small)
    with pytest.raises(InputError, match="no pixel with known depth"):
        run(frame, gt=empty)
