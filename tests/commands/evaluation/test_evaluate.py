"""Evaluations of files and folders: which belong together, values by numpy, and every warning."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.evaluate import Evaluation, evaluate, means_table
from pnpdepth_cli.commands.evaluation.scoring import FILES, scores_of
from pnpdepth_cli.dataset.frame_record import CameraRecord, FrameRecord
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.file_record import FileRecord, SamplePattern, Sampling
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.measures import MEASURES
from pnpdepth_cli.sensors.pixels import as_depth_image
from pnpdepth_cli.sensors.simulation import sample_points
from tests.core.test_metrics import brute
from tests.data_sets import touch


def depth_file(path: Path, rows: Any, scale: float = 1000) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth(path, np.array(rows, np.float32), scale=scale)
    return path


def frame(root: Path, prediction: Any, gt: Any, name: str = "a") -> Path:
    """A prediction in out/ and its ground truth in gt/."""
    depth_file(root / "gt" / f"{name}.npy", gt)
    return depth_file(root / "out" / f"{name}_depth.npy", prediction)


def code_image(path: Path, codes: Any) -> None:
    """A PNG that does not say its scale."""
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.array(codes, np.uint16))


def scored(root: Path, **options: Any) -> Evaluation:
    return evaluate(EvalRequest(prediction=root / "out", ground_truth=root / "gt", **options))


def says(evaluation: Evaluation, text: str) -> bool:
    return any(text in note for note in evaluation.notes)


def folders(root: Path, predictions: str, truths: str) -> Path:
    """Depth of 2 m in these files of out/ and gt/."""
    for folder, names in (("out", predictions), ("gt", truths)):
        (root / folder).mkdir()
        for name in names.split():
            depth_file(root / folder / name, np.full((3, 4), 2))
    return root


DRIVE = "2011_09_26_drive_0002_sync{}_0000000005_image_02"
MATCHED: list[tuple[str, str, dict[str, str | None]]] = [
    (  # the files of a refinement, and ground truth without images
        "b_depth.png b_preview.png b.png ä_depth.exr .hidden/c_depth.png",
        "b.png ä.npy",
        {"b": "b_depth.png", "ä": "ä_depth.exr"},
    ),
    (  # frames in folders of their own
        "one/1_depth.png two/1_depth.png",
        "one/1.png two/1.png two/2.png",
        {"one/1": "1_depth.png", "two/1": "1_depth.png", "two/2": None},
    ),
    (
        f"{DRIVE.format('_image')}_depth.png 0.depth.png",
        f"{DRIVE.format('_groundtruth_depth')}.png 0.png",
        {"0": "0.depth.png", DRIVE.format(""): f"{DRIVE.format('_image')}_depth.png"},
    ),
    ("_depth.png", "_depth.png", {"_depth": "_depth.png"}),
]


@pytest.mark.parametrize(("predictions", "truths", "expected"), MATCHED)
def test_files_are_matched_by_name(
    tmp_path: Path, predictions: str, truths: str, expected: dict[str, str | None]
) -> None:
    names = dict.fromkeys(expected)
    for each in scored(folders(tmp_path, predictions, truths)).frames:
        if "prediction" in each.inputs:
            names[each.name] = Path(each.inputs["prediction"].path).name
    assert names == expected


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
    touch(folders(tmp_path, out, gt) / "a.png")
    (tmp_path / "list.csv").write_text("image,sparse,name\na.png,out/a.png,a")
    with pytest.raises(error, match=message):
        evaluate(EvalRequest(prediction=tmp_path / first, ground_truth=tmp_path / second))


def test_a_folder_of_data_sets_is_read_as_a_batch_reads_it(tmp_path: Path) -> None:
    for place in ("north", "south"):
        touch(tmp_path / f"gt/{place}/image/0.png")
        depth_file(tmp_path / f"gt/{place}/depth/0.png", [[2]])
        depth_file(tmp_path / f"out/{place}/0_depth.png", [[2]])
    (tmp_path / "out/summary.json").write_text(json.dumps({"layout": "image-depth"}))
    found = {each.name: each.status for each in scored(tmp_path).frames}
    assert found == {"north/0": "done", "south/0": "done"}


def test_the_record_beside_a_prediction_names_its_sparse_depth(tmp_path: Path) -> None:
    out = folders(tmp_path, "a_depth.png b_depth.png c_depth.png", "a.png b.png c.png") / "out"
    sparse, image = (depth_file(tmp_path / name, np.ones((3, 4))) for name in ("s.png", "i.png"))
    inputs = {"sparse": FileRecord(path=str(sparse)), "image": FileRecord(path=str(image))}
    FrameRecord(inputs=inputs).write(out / "a.json")
    scan = FileRecord(path=str(sparse), calibration="calib.txt")
    FrameRecord(inputs={"sparse": scan}).write(out / "b.json")
    (out / "c.json").write_text("not JSON at all")
    files = [each.inputs for each in scored(tmp_path).frames]
    assert [[*each] for each in files] == [[*FILES], [*FILES][:2], [*FILES][:2]]
    assert (files[0]["sparse"].path, files[0]["image"].path) == (str(sparse), str(image))


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """Two frames: errors of 1 and 1 m over two pixels, and of 3 m over one, half predicted."""
    frame(tmp_path, [[2, 3]], [[1, 4]])
    frame(tmp_path, [[8, 0]], [[5, 5]], "ü b")
    return tmp_path


@pytest.mark.parametrize(("exclude_sparse", "pixels", "known"), [(False, 3, 4), (True, 2, 2)])
def test_images_count_alike_and_one_without_prediction_in_neither_means_nor_coverage(
    two: Path, exclude_sparse: bool, pixels: int, known: int
) -> None:
    depth_file(two / "gt" / "c.npy", [[1, 1]])
    sparse = FileRecord(path=str(depth_file(two / "sparse.npy", [[0, 9]])))
    for name in ("a", "ü b"):
        FrameRecord(inputs={"sparse": sparse}).write(two / "out" / f"{name}.json")
    result = scored(two, exclude_sparse=exclude_sparse)
    assert [each.name for each in result.frames if each.status == "failed"] == ["c"]
    assert result.mean["rmse"] == (1 + 3) / 2
    assert "coverage over 2 of 3 frames" in means_table(result).title
    counts = {"frames": 3, "scored": 2, "pixels": pixels, "coverage": pixels / known}
    assert result.to_json()["counts"] == counts


FAULTS = [
    (lambda p: p.write_bytes(b"no depth"), "a_depth.npy"),
    (lambda p: depth_file(p, [[0, 0]]), "holds no valid depth"),
    (lambda p: depth_file(p, [[1, 1, 1]]), "is 3×1 but the ground truth"),
]


@pytest.mark.parametrize(("spoil", "message"), FAULTS)
def test_a_failed_frame_is_reported_and_the_others_are_scored(
    two: Path, spoil: Any, message: str
) -> None:
    path, truth = two / "out" / "a_depth.npy", two / "gt" / "a.npy"
    alone = EvalRequest(prediction=path, ground_truth=truth)
    assert (evaluate(alone).mean["rmse"], evaluate(alone).interval) == (1, None)
    spoil(path)
    depth_file(two / "out" / "extra.depth.npy", [[1]])
    result = scored(two)
    assert [each.status for each in result.frames] == ["failed", "done"]
    assert message in (result.frames[0].message or "")
    assert says(result, "warning: frame a was not scored")
    assert says(result, "warning: 1 of 3 predictions have no ground truth")
    assert result.mean["rmse"] == 3
    with pytest.raises(InputError, match=re.escape(str(path))):
        evaluate(alone)
    depth_file(truth, [[0, 0]])
    with pytest.raises(InputError, match=re.escape(str(truth))):
        evaluate(alone)


PROTOCOLS: list[tuple[dict[str, Any], float, float, tuple[int, int, int, int]]] = [
    ({"protocol": "nyu-eigen"}, 1e-3, 10, (45, 471, 41, 601)),
    ({"protocol": "garg", "max_depth": 6.0}, 1e-3, 6, (195, 476, 23, 616)),
    ({"max_depth": 5.0, "delta": 1.25}, 0, 5, (0, 480, 0, 640)),
]


@pytest.mark.parametrize(("options", "low", "high", "window"), PROTOCOLS)
def test_a_protocol_is_what_plain_numpy_makes_of_its_definition(
    options: dict[str, Any],
    low: float,
    high: float,
    window: tuple[int, int, int, int],
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(0)
    gt = rng.uniform(0.2, 12, (2, 480, 640)).astype(np.float32)
    prediction = (gt * np.exp(rng.normal(0, 0.2, gt.shape))).astype(np.float32)
    gt[rng.random(gt.shape) < 0.3] = 0
    prediction[rng.random(gt.shape) < 0.1] = 0
    for number in range(2):
        frame(tmp_path, prediction[number], gt[number], str(number))
    top, bottom, left, right = window
    truth = np.zeros_like(gt)
    truth[:, top:bottom, left:right] = gt[:, top:bottom, left:right]
    truth[(gt <= low) | (gt >= high)] = 0
    coverage = np.mean(prediction[truth > 0] > 0)
    if "protocol" in options:
        prediction = np.clip(prediction, np.float32(low), high)  # empty ones too, as BTS does
    rows = [brute(*each) for each in zip(prediction, truth, strict=True)]
    result = scored(tmp_path, **options)
    assert result.mean == {
        measure.key: pytest.approx(np.mean([row[measure.key] for row in rows]), rel=1e-9)
        for measure in MEASURES
    }
    assert result.counts["coverage"] == pytest.approx(coverage)


def test_an_interval_ends_at_what_the_measure_can_be_and_few_groups_have_none(
    tmp_path: Path,
) -> None:
    for name, depth in zip("abcdefgh", [2.0] * 6 + [2.1, 9.0], strict=True):
        frame(tmp_path, [[depth]], [[2]], name)
        frame(tmp_path / "groups", [[depth]], [[2]], f"{'fg'[name > 'd']}/{name}")
    found = scored(tmp_path).interval or {}
    assert (found["rmse"][0], found["delta1"][1]) == (0.0, 1.0)
    assert found["rmse"][1] > 7 / 8 > found["delta1"][0]
    result = scored(tmp_path / "groups")
    assert result.interval is None
    assert says(result, "no interval: 2 groups of frames are too few")
    assert [each.group for each in result.frames] == ["f"] * 4 + ["g"] * 4


def test_integer_files_are_read_by_option_then_by_themselves_then_by_protocol(
    tmp_path: Path,
) -> None:
    for folder in ("out", "gt"):
        code_image(tmp_path / folder / "a.png", np.full((480, 640), 1000))
    by_option = scored(tmp_path, pred_scale=1000.0, gt_scale=1000.0)
    assert (by_option.mean["mae"], by_option.frames[0].inputs["gt"].scale) == (0, 1000)
    assert says(scored(tmp_path, protocol="nyu-eigen"), "÷ 1000; --gt-scale to change")
    depth_file(tmp_path / "out" / "a.png", np.ones((480, 640)), scale=100)
    own = scored(tmp_path, protocol="nyu-eigen")
    assert own.mean["rmse"] == 0
    assert says(own, "÷ 100 (from the file)")


@pytest.mark.parametrize(("side", "option"), [("gt", "--gt-scale"), ("out", "--pred-scale")])
def test_a_scale_that_was_assumed_and_is_wrong_stops_and_names_the_option(
    tmp_path: Path, side: str, option: str
) -> None:
    depth = np.random.default_rng(0).integers(1, 9, (6, 8)).astype(np.float32)
    for folder in ("gt", "out"):
        depth_file(tmp_path / folder / "a.npy", depth)
    (tmp_path / side / "a.npy").unlink()
    code_image(tmp_path / side / "a.png", depth * 1000)
    with pytest.raises(InputError, match=rf"{option} 1000 \(now 256\)"):
        scored(tmp_path)
    field = option[2:].replace("-", "_")
    assert scored(tmp_path, **{field: 1000.0}).mean["rmse"] == 0
    assert says(scored(tmp_path, **{field: 256.0}), "a scale is probably wrong")


def test_scored_pixels_with_a_sparse_point_are_counted_and_can_be_excluded(tmp_path: Path) -> None:
    gt = np.random.default_rng(0).uniform(1, 4, (10, 10)).astype(np.float32)
    points = np.where(np.arange(100).reshape(10, 10) < 5, gt, 0)
    prediction = np.where(points > 0, points, gt + 1)
    prediction[0, 4] = 0  # not scored
    frame(tmp_path, prediction, gt)
    sparse, record = depth_file(tmp_path / "sparse.npy", points), tmp_path / "out" / "a.json"
    FrameRecord(inputs={"sparse": FileRecord(path=str(sparse))}).write(record)
    assert says(scored(tmp_path), "4 of the scored pixels have a point of the sparse input")
    without = scored(tmp_path, exclude_sparse=True)
    assert (scores_of(without.frames[0])["known"], without.mean["mae"]) == (95, pytest.approx(1))
    assert not says(without, "sparse input")
    sparse.write_bytes(b"spoilt")
    for _ in range(2):  # points that cannot be read, then none that are named
        assert scores_of(scored(tmp_path).frames[0])["given"] is None
        with pytest.raises(InputError, match="no frame could be scored"):
            scored(tmp_path, exclude_sparse=True)
        record.unlink(missing_ok=True)


def test_points_that_were_drawn_from_the_ground_truth_are_drawn_again_to_be_excluded(
    tmp_path: Path,
) -> None:
    gt = np.random.default_rng(0).uniform(1, 4, (10, 10)).astype(np.float32)
    drawn = as_depth_image(sample_points(gt, SamplePattern(count=30), 7))
    path = frame(tmp_path, np.where(drawn > 0, gt, gt + 1), gt)
    sampled = FileRecord(path=str(path), sampled=Sampling(kind="uniform", count=30, seed=7))
    for size, given in (((9, 9), None), (None, None), ((10, 10), 30)):
        record = FrameRecord(inputs={"sparse": sampled}, size=size)
        record.write(tmp_path / "out" / "a.json")
        assert scores_of(scored(tmp_path).frames[0])["given"] == given
    without = scored(tmp_path, exclude_sparse=True)
    assert (without.counts["pixels"], without.mean["mae"]) == (70, pytest.approx(1))


def test_a_prediction_in_model_units_is_warned_of_unless_it_is_scaled(two: Path) -> None:
    FrameRecord(unit="model units").write(two / "out" / "a.json")
    assert says(scored(two), "warning: 1 prediction in model units")
    frame(two, [[8, 9]], [[5, 5]], "ü b")
    result = scored(two, scale_by="median")
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
    for name in "abc":
        gt = rng.uniform(2, 9, (20, 30)) if name != "b" else np.full((20, 30), 2.0)
        frame(tmp_path, gt * rng.uniform(0.9, 1.1, gt.shape), gt, name)
    default = scored(tmp_path)
    more = scored(tmp_path, columns=("mae", "boundary_f1"), depth_limits=(4.0, 6.0))
    assert list(more.mean)[: len(default.mean)] == list(default.mean)
    assert default.mean.items() <= more.mean.items()
    first, second, third = (scores_of(each)["rmse_far"] for each in more.frames)
    assert math.isnan(second)  # a wall in 2 m has no far pixels
    assert more.mean["rmse_far"] == pytest.approx((first + third) / 2)
    assert scores_of(more.frames[1])["boundary_f1"] == 0
    assert [measure.key for measure in more.shown] == ["mae", "boundary_f1"]


@pytest.mark.parametrize("of", ["list", "record", "nothing"])
def test_distances_of_a_wide_camera_are_scored_as_depth(of: str, tmp_path: Path) -> None:
    depth = np.random.default_rng(0).uniform(2, 4, (48, 64)).astype(np.float32)
    x, y = (np.arange(64) - 31.5) / 32, (np.arange(48) - 23.5) / 32  # 90° across
    frame(tmp_path, depth + 1, depth * np.sqrt(1 + x**2 + y[:, None] ** 2))
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64, 3), np.uint8))
    intrinsics = [[32.0, 0.0, 31.5], [0.0, 32.0, 23.5], [0.0, 0.0, 1.0]]
    (tmp_path / "calib.txt").write_text(f"K: {np.ravel(intrinsics).tolist()}")
    calib = "calib.txt" if of == "list" else ""
    (tmp_path / "list.csv").write_text(f"image,gt,calib,name,group\na.png,gt/a.npy,{calib},a,b")
    camera = CameraRecord.of(Camera(intrinsics=np.array(intrinsics)), None)
    record = FrameRecord(size=(64, 48), camera=camera if of == "record" else None)
    record.write(tmp_path / "out" / "a.json")
    request = EvalRequest(
        prediction=tmp_path / "out", ground_truth=tmp_path / "list.csv", gt_range=True
    )
    if of == "nothing":
        with pytest.raises(InputError, match="calib"):
            evaluate(request)
    else:
        found = evaluate(request)
        assert found.mean["mae"] == pytest.approx(1, abs=1e-6)
        assert found.frames[0].inputs["gt"].read_as == "float32 NPY, distances"
