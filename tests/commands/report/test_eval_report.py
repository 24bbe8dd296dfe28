"""Reports of evaluations: the content of the page and its images."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.evaluate import Evaluation, evaluate
from pnpdepth_cli.commands.report.eval_report import write_eval_report
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import write_depth
from tests.commands.report_pages import everything, frames_of, images_of, page_data

NAMES = ("a", "b <i>", "c\nd")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for number, name in enumerate(NAMES):
        gt = rng.uniform(1, 9, (60, 80)).astype(np.float32)
        for folder, depth in (("out", gt + 0.1 * (number + 1)), ("gt", gt)):
            (tmp_path / folder).mkdir(exist_ok=True)
            write_depth(tmp_path / folder / f"{name}.npy", depth.astype(np.float32))
    return tmp_path


def reported(root: Path, **options: Any) -> Evaluation:
    result = evaluate(EvalRequest(prediction=root / "out", ground_truth=root / "gt", **options))
    write_eval_report(root / "report", result)
    return result


def panel(root: Path, name: str, view: str) -> np.ndarray:
    key = frames_of(root / "report")[name]["key"]
    data = images_of(root / "report")[f"{key}_{view}.jpg"]
    return np.asarray(Image.open(io.BytesIO(data))).astype(int)


def test_the_page_has_the_units_of_the_protocol(root: Path) -> None:
    reported(root, protocol="kitti")
    data = page_data(root / "report")
    assert data["tables"][0]["rows"][0][:2] == ["RMSE [mm] ↓", "200.0"]
    (rmse,) = (column for column in data["columns"] if column["key"] == "rmse")
    assert (rmse["shown_unit"], rmse["shown_factor"]) == ("mm", 1000)


def test_unscored_frames_are_listed_with_their_reason(root: Path) -> None:
    (root / "out/a.npy").unlink()
    (root / "out/b <i>.npy").write_bytes(b"broken")
    reported(root)
    data = page_data(root / "report")
    assert [name for name, _ in data["without"]] == ["a", "b <i>"]
    assert data["without"][0][1] == "there is no prediction"
    text = (root / "report/index.html").read_text()
    assert "Not scored: 1 without prediction, 1 with a faulty file" in text
    assert list(frames_of(root / "report")) == ["c\nd"]


def test_both_sides_have_one_scale_and_the_map_is_orange_where_too_far_and_dark_where_unknown(
    root: Path,
) -> None:
    prediction = np.full((60, 80), 4, np.float32)
    prediction[:, 40:] = 5
    gt = np.full((60, 80), 4, np.float32)
    gt[:20] = 0
    write_depth(root / "gt/a.npy", gt)
    write_depth(root / "out/a.npy", prediction)
    reported(root)
    first, second = panel(root, "a", "first"), panel(root, "a", "second")
    half = first.shape[1] // 2 - 8
    assert np.abs(first[-40:, :half] - second[-40:, :half]).max() < 8
    assert frames_of(root / "report")["a"]["scale_m"] == [4, 5]
    shown = panel(root, "a", "map")
    height, width = shown.shape[:2]
    unknown = shown[: height // 4].mean((0, 1))
    right = shown[height // 2 :, : width // 3].mean((0, 1))
    far = shown[height // 2 :, 2 * width // 3 :].mean((0, 1))
    assert unknown.max() < 80
    assert right.min() > 180
    assert far == pytest.approx([220, 105, 0], abs=6)
    values = frames_of(root / "report")["a"]["map"]
    assert values["ends"] == ["too near by 1 m or more", "too far by 1 m or more"]
    assert values["unknown"] == "not scored"


def test_the_image_is_shown_where_the_predictions_record_names_one(root: Path) -> None:
    image = np.full((60, 80, 3), (0, 0, 255), np.uint8)
    cv2.imwrite(str(root / "img.png"), image)
    cv2.imwrite(str(root / "other.png"), image[:30])
    for name, file in (("a", "img.png"), ("b <i>", "other.png"), ("c\nd", "none.png")):
        inputs = {"image": FileRecord(path=str(root / file))}
        FrameRecord(inputs=inputs).write(root / f"out/{name}.json")
    reported(root)
    views = [frame["views"] for frame in frames_of(root / "report").values()]
    assert ["image" in each for each in views] == [True, False, False]
    assert panel(root, "a", "image").mean((0, 1)) == pytest.approx([255, 0, 0], abs=3)


def test_a_standard_deviation_has_rows_of_its_calibration(root: Path) -> None:
    for name in NAMES:
        gt = np.load(root / "gt" / f"{name}.npy")
        (root / "out" / f"{name}.npy").unlink()
        write_depth(root / "out" / f"{name}_depth.npy", gt + np.float32(0.15))
        np.save(root / "out" / f"{name}_sigma.npy", np.full_like(gt, 0.1))
    reported(root)
    (table,) = page_data(root / "report")["tables"]
    rows = {row[0]: row[1] for row in table["rows"]}
    assert rows["errors within 1σ (normal: 68.3 %)"] == "0.0%"
    assert rows["errors within 2σ (normal: 95.4 %)"] == "100.0%"


def test_what_the_development_kit_fills_in_is_shown_filled(root: Path) -> None:
    depth = np.full((60, 80), 4, np.float32)
    write_depth(root / "gt/a.npy", depth)
    depth[:, 20:40] = 0
    write_depth(root / "out/a.npy", depth)
    reported(root, protocol="kitti-devkit")
    assert page_data(root / "report")["labels"]["first"] == "Prediction (filled in)"
    assert frames_of(root / "report")["a"]["map"]["unknown"] is None
    shown = panel(root, "a", "first")
    assert np.abs(shown - shown[0, 0]).max() < 6


def test_a_file_that_goes_after_scoring_costs_one_frame_its_images(root: Path) -> None:
    result = reported(root)
    before = everything(root / "report")
    (root / "out/a.npy").unlink()
    write_eval_report(root / "report", result)
    frames, after = frames_of(root / "report"), everything(root / "report")
    assert frames["a"]["key"] is None
    assert "a.npy" in frames["a"]["notes"][-1]
    assert frames["c\nd"]["key"]
    assert len(after) == len(before) * 2 // 3 + 1
    assert set(after) < set(before)


def test_a_report_is_the_same_bytes_each_time_and_other_files_stay(root: Path) -> None:
    reported(root)
    before = everything(root / "report")
    (root / "report" / "notes.txt").write_text("mine")
    reported(root)
    assert everything(root / "report") == before | {"notes.txt": b"mine"}
