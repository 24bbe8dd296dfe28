"""Evaluations of files and folders: which belong together, values by numpy, and every warning."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.eval import Evaluation, evaluate, means_table
from pnpdepth_cli.commands.evaluation.scoring import scores_of
from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.dataset.frame_record import CameraRecord, FrameRecord
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.file_record import FileRecord, SamplePattern
from pnpdepth_cli.measures import MEASURES
from pnpdepth_cli.sensors.projection import as_depth_image
from pnpdepth_cli.sensors.simulation import sample_points
from tests.builders import result_record
from tests.commands.predictions import code_image, depth_file, frame, scored
from tests.data_sets import SELECTED, image, touch
from tests.plain_scores import brute


def says(evaluation: Evaluation, text: str) -> bool:
    return any(text in note for note in evaluation.notes)


def folders(root: Path, predictions: Iterable[str], truths: Iterable[str]) -> Path:
    """Depth of 2 m in these files of out/ and gt/."""
    for folder, names in (("out", predictions), ("gt", truths)):
        (root / folder).mkdir()
        for name in names:
            depth_file(root / folder / name, np.full((3, 4), 2))
    return root


IMAGE, TRUTH = (SELECTED.format(kind) for kind in ("image", "groundtruth_depth"))
# the frame of each ground truth, and its prediction
MATCHED = {
    "b.png": ("b", "b_depth.png"),
    "ä.npy": ("ä", "ä_depth.exr"),
    "one/1.png": ("one/1", "one/1_depth.png"),
    "two/1.png": ("two/1", "two/1_depth.png"),
    "two/2.png": ("two/2", "."),
    "0.png": ("0", "0.depth.png"),
    f"{TRUTH}.png": (SELECTED.replace("_{}", ""), f"{IMAGE}_depth.png"),
}


def test_files_are_matched_by_name(tmp_path: Path) -> None:
    predictions = [name for _, name in MATCHED.values() if name != "."]
    others = ["b_preview.png", "b.png", ".hidden/c_depth.png"]  # of a refinement, and hidden
    names = dict[str, tuple[str, str]]()
    for found in scored(folders(tmp_path, [*predictions, *others], MATCHED)).frames:
        files = {side: Path(file.path) for side, file in found.inputs.items()}
        prediction = files.get("prediction", tmp_path / "out").relative_to(tmp_path / "out")
        names[files["gt"].relative_to(tmp_path / "gt").as_posix()] = (found.name, str(prediction))
    assert names == MATCHED


UNMATCHED = [
    ("a.npy a.png", "a.png", "out", "gt", InputError, "one frame"),
    ("a_depth.png a.depth.png", "a.png", "out", "gt", InputError, "one frame"),
    ("a.png", "", "out", "gt", InputError, "gt holds no depth file"),
    ("a.png", "a.png", "out/b.png", "gt/a.png", InputError, "b.png"),
    ("1.png", "0001.png", "out", "gt", InputError, "are 1; ground truth is 0001"),
    ("a.png", "a.png", "out/a.png", "list.csv", UsageError, "two files"),
    ("a.png", "a.png", "out", "list.csv", InputError, "'manifest'"),  # without ground truth
]


@pytest.mark.parametrize(("out", "gt", "first", "second", "error", "message"), UNMATCHED)
def test_what_cannot_be_matched_is_refused(
    tmp_path: Path, out: str, gt: str, first: str, second: str, error: type[Exception], message: str
) -> None:
    touch(folders(tmp_path, out.split(), gt.split()) / "a.png")
    (tmp_path / "list.csv").write_text("image,sparse,name\na.png,out/a.png,a")
    with pytest.raises(error, match=message):
        evaluate(EvalRequest(prediction=tmp_path / first, ground_truth=tmp_path / second))


def test_a_folder_of_data_sets_is_read_as_a_batch_reads_it(tmp_path: Path) -> None:
    for place in ("north", "south"):
        touch(tmp_path / f"gt/{place}/image/0.png")
        depth_file(tmp_path / f"gt/{place}/depth/0.png", [[2]])
        depth_file(tmp_path / f"out/{place}/0_depth.png", [[2]])
    (tmp_path / "out/summary.json").write_text(json.dumps({"layout": "image-depth"}))
    statuses = {found.name: found.status for found in scored(tmp_path).frames}
    assert statuses == {"north/0": "done", "south/0": "done"}


@pytest.fixture
def three_frames(tmp_path: Path) -> Path:
    """Two predictions with their ground truth and sparse depth, and ground truth without one."""
    depth_file(tmp_path / "gt" / "c.npy", [[1, 1]])
    sparse = FileRecord(path=str(depth_file(tmp_path / "sparse.npy", [[0, 9]])), kind="depth")
    for name, prediction, gt in (("a", [2, 3], [1, 4]), ("ü b", [8, 0], [5, 5])):
        frame(tmp_path, [prediction], [gt], name)
        FrameRecord(inputs={"sparse": sparse}).write(tmp_path / "out" / f"{name}.json")
    return tmp_path


def test_images_count_alike_and_one_without_prediction_not_at_all(three_frames: Path) -> None:
    result = scored(three_frames)
    assert [found.name for found in result.frames if found.status == "failed"] == ["c"]
    assert result.mean["rmse"] == (1 + 3) / 2


def test_coverage_is_of_the_frames_with_a_prediction(three_frames: Path) -> None:
    result = scored(three_frames)
    assert "2 of 3 frames" in means_table(result).title
    assert result.to_json()["counts"] == {"frames": 3, "scored": 2, "pixels": 3, "coverage": 3 / 4}


def test_scored_pixels_of_the_sparse_input_are_said_unless_they_are_excluded(
    three_frames: Path,
) -> None:
    assert says(scored(three_frames), "1 of the scored pixels")
    without = scored(three_frames, exclude_sparse=True)
    assert without.counts["pixels"] == 2
    assert not says(without, "of the scored pixels")


FAULTS: dict[str, tuple[list[float], list[float], str]] = {
    "damaged": ([1, 1], [5, 5], "damaged_depth.npy"),
    "empty": ([0, 0], [5, 5], "empty_depth.npy"),
    "large": ([1, 1, 1], [5, 5], "large_depth.npy"),
    "unknown": ([1, 1], [0, 0], "unknown.npy"),
}
"""A prediction and its ground truth by name, and the file that is at fault."""


@pytest.fixture
def with_faults(tmp_path: Path) -> Path:
    """One good frame, those with faults, and a prediction without ground truth."""
    frame(tmp_path, [[8, 2]], [[5, 5]], "good")
    for name, (prediction, gt, _) in FAULTS.items():
        frame(tmp_path, [prediction], [gt], name)
    (tmp_path / "out" / "damaged_depth.npy").write_bytes(b"no depth")
    depth_file(tmp_path / "out" / "extra.depth.npy", [[1]])
    return tmp_path


def test_frames_that_failed_are_warned_of_once_and_then_counted(with_faults: Path) -> None:
    result = scored(with_faults)
    assert says(result, "warning: 1 of 6 predictions")
    assert says(result, "warning: frame damaged")
    assert says(result, "1 more frame")


def test_a_frame_that_failed_has_a_message_that_names_the_file(with_faults: Path) -> None:
    frames = scored(with_faults).frames
    messages = {found.name: found.message or "" for found in frames if found.status == "failed"}
    assert messages.keys() == FAULTS.keys()
    assert all(file in messages[name] for name, (*_, file) in FAULTS.items())


@pytest.mark.parametrize("name", FAULTS)
def test_a_frame_that_fails_in_a_folder_is_an_error_where_it_is_alone(
    name: str, with_faults: Path
) -> None:
    prediction = with_faults / "out" / f"{name}_depth.npy"
    truth = with_faults / "gt" / f"{name}.npy"
    with pytest.raises(InputError, match=FAULTS[name][2]):
        evaluate(EvalRequest(prediction=prediction, ground_truth=truth))


def test_the_means_are_of_the_frames_that_did_not_fail(with_faults: Path) -> None:
    result = scored(with_faults)
    assert (result.mean["rmse"], result.interval) == (3, None)


# options, the size of the frames, the bounds of what is scored and (top, bottom, left, right)
PROTOCOLS: list[tuple[dict[str, Any], tuple[int, int], tuple[float, float], tuple[int, ...]]] = [
    ({"protocol": "nyu-eigen"}, (480, 640), (1e-3, 10), (45, 471, 41, 601)),
    ({"protocol": "garg", "max_depth": 6.0}, (375, 1242), (1e-3, 6), (153, 371, 44, 1197)),
    ({"protocol": "eigen"}, (375, 1242), (1e-3, 80), (124, 342, 44, 1197)),
    ({"max_depth": 5.0, "delta": 1.25}, (48, 64), (0, 5), (0, 48, 0, 64)),
]


@pytest.mark.parametrize(("options", "size", "bounds", "window"), PROTOCOLS)
def test_a_protocol_is_what_plain_numpy_makes_of_its_definition(
    options: dict[str, Any], size: Any, bounds: Any, window: Any, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    low, high = bounds
    top, bottom, left, right = window
    gt = rng.uniform(0.2, 12, (2, *size)).astype(np.float32)
    prediction = (gt * np.exp(rng.normal(0, 0.2, gt.shape))).astype(np.float32)
    gt[rng.random(gt.shape) < 0.3] = 0
    prediction[rng.random(gt.shape) < 0.1] = 0
    for number in range(2):
        frame(tmp_path, prediction[number], gt[number], str(number))
    truth = np.zeros_like(gt)
    truth[:, top:bottom, left:right] = gt[:, top:bottom, left:right]
    truth[(gt <= low) | (gt >= high)] = 0
    coverage = np.mean(prediction[truth > 0] > 0)
    if "protocol" in options:
        prediction = np.clip(prediction, np.float32(low), high)  # empty ones too, as BTS does
    rows = [brute(*maps) for maps in zip(prediction, truth, strict=True)]
    result = scored(tmp_path, **options)
    assert result.mean == {
        measure.key: pytest.approx(np.mean([row[measure.key] for row in rows]), rel=1e-9)
        for measure in MEASURES
    }
    assert result.counts["coverage"] == pytest.approx(coverage)


def test_an_interval_ends_at_what_a_measure_can_be_and_few_groups_have_none(tmp_path: Path) -> None:
    for name, depth in zip("abcdefgh", [2.0] * 6 + [2.1, 9.0], strict=True):
        frame(tmp_path / "one", [[depth]], [[2]], name)
        frame(tmp_path / "two", [[depth]], [[2]], f"{'fg'[name > 'd']}/{name}")
    found = scored(tmp_path / "one").interval or {}
    assert (found["rmse"][0], found["delta1"][1]) == (0.0, 1.0)
    assert found["rmse"][1] > 7 / 8 > found["delta1"][0]
    result = scored(tmp_path / "two")
    assert result.interval is None
    assert says(result, "no interval: 2 groups of frames are too few")
    assert [found.group for found in result.frames] == ["f"] * 4 + ["g"] * 4


def test_integer_files_are_read_by_option_then_themselves_then_protocol(tmp_path: Path) -> None:
    for folder in ("out", "gt"):
        code_image(tmp_path / folder / "a.png", np.full((480, 640), 1000))
    by_option = scored(tmp_path, pred_scale=1000.0, gt_scale=1000.0)
    assert (by_option.mean["mae"], by_option.frames[0].inputs["gt"].scale) == (0, 1000)
    assert says(scored(tmp_path, protocol="nyu-eigen"), "÷ 1000; --gt-scale to change")
    depth_file(tmp_path / "out" / "a.png", np.ones((480, 640)), scale=100)
    own = scored(tmp_path, protocol="nyu-eigen")
    assert own.mean["rmse"] == 0
    assert says(own, "÷ 100 (from the file)")


def test_a_scale_that_was_assumed_and_is_wrong_stops_and_names_the_option(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).integers(1, 9, (6, 8))
    for side, opposite, option in (("gt", "out", "gt_scale"), ("out", "gt", "pred_scale")):
        root = tmp_path / option
        depth_file(root / opposite / "a.npy", depth)
        code_image(root / side / "a.png", depth * 1000)
        with pytest.raises(InputError, match=rf"--{option.replace('_', '-')} 1000 \(now 256\)"):
            scored(root)
        assert scored(root, **{option: 1000.0}).mean["rmse"] == 0
        assert says(scored(root, **{option: 256.0}), "a scale is probably wrong")


def test_points_that_a_record_names_are_counted_and_can_be_excluded(tmp_path: Path) -> None:
    gt = np.random.default_rng(0).uniform(1, 4, (10, 10)).astype(np.float32)
    points = as_depth_image(sample_points(gt, SamplePattern(count=30), 7))
    frame(tmp_path, np.where(points > 0, gt, gt + 1), gt)
    path = str(depth_file(tmp_path / "points.npy", points))
    record = tmp_path / "out" / "a.json"
    pattern = SamplePattern(kind="uniform", count=30, seed=7)
    drawn = FileRecord(path=path, kind="sampled", sampled=pattern)
    for source, size, count in (
        (FileRecord(path=path, kind="depth"), None, 30),
        (FileRecord(path=path, kind="scan", calibration="calib.txt"), None, None),
        (drawn, (10, 10), 30),  # drawn again
        (drawn, (9, 9), None),
    ):
        result = None if size is None else result_record(size=size)
        FrameRecord(inputs={"sparse": source}, result=result).write(record)
        assert scores_of(scored(tmp_path).frames[0])["given"] == count
        if count is None:
            with pytest.raises(InputError, match="no frame could be scored"):
                scored(tmp_path, exclude_sparse=True)
        else:
            without = scored(tmp_path, exclude_sparse=True)
            assert (without.counts["pixels"], without.mean["mae"]) == (70, pytest.approx(1))
    record.write_text("not JSON at all")
    assert scores_of(scored(tmp_path).frames[0])["given"] is None


def test_a_prediction_in_model_units_is_warned_of_unless_it_is_scaled(tmp_path: Path) -> None:
    frame(tmp_path, [[2, 3]], [[1, 4]])
    frame(tmp_path, [[8, 9]], [[5, 5]], "b")
    FrameRecord(unit="model units").write(tmp_path / "out" / "a.json")
    assert says(scored(tmp_path), "warning: 1 prediction in model units")
    result = scored(tmp_path, scale_by="median")
    assert not says(result, "model units")
    assert says(result, "scale-by median: factor 0.7941 (median of 2 images)")


def test_a_smaller_prediction_is_resized_on_request(tmp_path: Path) -> None:
    frame(tmp_path, [[1, 3]], [[1, 1, 3, 3], [1, 1, 3, 3]])
    assert scored(tmp_path, resize=True).mean["mae"] == 0.25
    frame(tmp_path, [[0, 3]], [[1, 1, 3, 3], [1, 1, 3, 3]])
    result = scored(tmp_path, resize=True)
    assert (result.counts["pixels"], result.mean["mae"]) == (4, 0)


def test_the_development_kit_takes_the_largest_code_for_a_depth(tmp_path: Path) -> None:
    code_image(tmp_path / "out" / "a.png", [[65535, 512]])
    code_image(tmp_path / "gt" / "a.png", [[256, 512]])
    devkit = scored(tmp_path, protocol="kitti-devkit")
    assert devkit.mean["mae"] == pytest.approx((65535 / 256 - 1) / 2)
    assert scored(tmp_path).counts["pixels"] == 1


def test_additional_measures_follow_the_default_ones(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name, farthest in (("a", 9), ("c", 9), ("near", 3)):
        gt = rng.uniform(2, farthest, (20, 30))
        frame(tmp_path, gt * rng.uniform(0.9, 1.1, gt.shape), gt, name)
    default = scored(tmp_path)
    more = scored(tmp_path, columns=("mae", "boundary_f1"), depth_limits=(4.0, 6.0))
    assert [*more.mean.items()][: len(default.mean)] == [*default.mean.items()]
    first, second, near = (scores_of(found)["rmse_far"] for found in more.frames)
    assert math.isnan(near)
    assert more.mean["rmse_far"] == pytest.approx((first + second) / 2)
    assert [measure.key for measure in more.shown] == ["mae", "boundary_f1"]


def test_the_sigma_beside_a_prediction_is_evaluated(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    gt = rng.uniform(1, 9, (40, 50))
    frame(tmp_path, gt + rng.normal(0, 0.1, gt.shape), gt)
    depth_file(tmp_path / "out" / "a_sigma.npy", np.full(gt.shape, 0.1))
    result = scored(tmp_path)
    assert result.mean["within_1_sigma"] == pytest.approx(0.683, abs=0.03)
    assert not says(result, "have no ground truth")
    depth_file(tmp_path / "out" / "a_sigma.npy", np.ones((2, 2)))
    with pytest.raises(InputError, match=r"a_sigma\.npy"):
        scored(tmp_path)


def test_distances_of_a_wide_camera_are_scored_as_depth(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).uniform(2, 4, (48, 64))
    x = (np.arange(64) - 31.5) / 32  # 90° across
    y = (np.arange(48) - 23.5) / 32
    frame(tmp_path, depth + 1, depth * np.sqrt(1 + x**2 + y[:, None] ** 2))
    request = EvalRequest(prediction=tmp_path / "out", ground_truth=tmp_path / "gt", gt_range=True)
    with pytest.raises(InputError, match="calib"):
        evaluate(request)
    intrinsics = np.array([[32.0, 0, 31.5], [0, 32, 23.5], [0, 0, 1]])
    camera = CameraRecord.of(Camera(intrinsics=intrinsics), None)
    FrameRecord(result=result_record(camera=camera)).write(tmp_path / "out" / "a.json")
    by_record = evaluate(request)
    (tmp_path / "out" / "a.json").unlink()
    image(tmp_path / "a.png", 48, 64)
    (tmp_path / "calib.txt").write_text(f"K: {intrinsics.ravel().tolist()}")
    (tmp_path / "list.csv").write_text("image,gt,calib,name\na.png,gt/a.npy,calib.txt,a")
    for found in (by_record, evaluate(replace(request, ground_truth=tmp_path / "list.csv"))):
        assert found.mean["mae"] == pytest.approx(1, abs=1e-6)
        assert found.frames[0].inputs["gt"].read_as == "float32 NPY, distances"


def request(name: str, **changes: Any) -> EvalRequest:
    return EvalRequest(prediction=Path(), ground_truth=Path(), protocol=name, **changes)


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("papre", {}, "paper, whole"),
    ("eigen", {"max_depth": 0.0}, "--max-depth"),
    ("paper", {"delta": 1.0}, "--delta"),
    ("paper", {"pred_scale": float("nan")}, "--pred-scale"),
    ("paper", {"columns": ("rmse", "boundary")}, "delta3, boundary_f1"),
    ("paper", {"depth_limits": (2.0, 1.0)}, "--by-depth"),
    ("kitti-devkit", {"delta": 1.01}, "kitti-devkit"),
    ("kitti-devkit", {"depth_limits": (1.0, 2.0)}, "kitti-devkit"),
    ("kitti-devkit", {"columns": ("boundary_f1",)}, "abs_relative"),
]


@pytest.mark.parametrize(("name", "changes", "named"), REFUSED)
def test_a_setting_without_sense_is_refused(name: str, changes: dict[str, Any], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        request(name, **changes)


def test_rules_that_score_alike_are_equal_whatever_they_are_called() -> None:
    assert request("paper").scoring == request("kitti", resize=True).scoring
    kinds = ("paper", "nyu-eigen", "kitti-devkit", "eigen", "garg")
    asked = [*map(request, kinds), request("paper", exclude_sparse=True)]
    rules = [asking.scoring for asking in (*asked, request("paper", scale_by="median"))]
    assert all(a != b for i, a in enumerate(rules) for b in rules[:i])


@pytest.mark.parametrize("least", [-3.0, -0.1])
@pytest.mark.parametrize("scale_by", ["affine", "affine-disparity"])
def test_predictions_up_to_scale_and_shift_may_be_below_0(
    scale_by: str, least: float, tmp_path: Path
) -> None:
    gt = np.random.default_rng(0).uniform(1, 9, (30, 40)).astype(np.float32)
    target = 1 / gt if scale_by == "affine-disparity" else gt
    noise = np.random.default_rng(1).normal(0, 0.02 * np.ptp(target), gt.shape)
    predicted = (target - target.min() + noise) / 2 + least
    assert (predicted <= 0).mean() > 0.005
    for folder, values in (("out", predicted), ("gt", gt)):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "a.npy", values.astype(np.float32))
    result = scored(tmp_path, scale_by=scale_by)
    assert result.counts["coverage"] == 1
    factor, shift = (scores_of(result.frames[0])[key] for key in ("factor", "shift"))
    # by numpy's own least squares over all pixels
    expected = np.polyfit(predicted.ravel(), target.ravel(), 1)
    assert (factor, shift) == pytest.approx(tuple(expected), rel=1e-3)


@pytest.mark.parametrize(
    ("stored", "scale_by", "said"),
    [
        ("disparity", "none", "disparity or 1/depth"),
        ("disparity", "affine", "disparity or 1/depth"),
        ("disparity", "affine-disparity", ""),
        ("depth", "affine-disparity", "--scale-by affine"),
        ("depth", "affine", ""),
    ],
)
def test_predictions_of_the_opposite_order_are_warned_of(
    stored: str, scale_by: str, said: str, tmp_path: Path
) -> None:
    gt = np.random.default_rng(0).uniform(1, 9, (30, 40)).astype(np.float32)
    frame(tmp_path, 10 / gt if stored == "disparity" else gt / 2, gt)
    found = [note for note in scored(tmp_path, scale_by=scale_by).notes if "rank" in note]
    assert len(found) == (1 if said else 0)
    assert all(said in note for note in found)


def test_ground_truth_of_disparity_is_read_and_a_scale_of_floats_is_obeyed(tmp_path: Path) -> None:
    gt = np.random.default_rng(0).uniform(1, 9, (30, 40)).astype(np.float32)
    frame(tmp_path, gt * 39.3701, 386.1 / gt)
    result = scored(tmp_path, gt_kind="disparity:386.1", pred_scale=39.3701)
    assert result.mean["mae"] == pytest.approx(0, abs=1e-4)
