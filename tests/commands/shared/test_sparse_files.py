"""project, sample and simulate, through files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.commands.project import project_scan
from pnpdepth_cli.commands.sample import sample_depth
from pnpdepth_cli.commands.shared.sparse_files import Written
from pnpdepth_cli.commands.simulate import simulate_scan
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.stored_depth import read_stored_sparse
from pnpdepth_cli.errors import InputError, OutputError, PnpDepthError, UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, read_depth
from pnpdepth_cli.io.point_files import read_sparse
from tests.commands.frames import ScanOnDisk, scan_on_disk


@pytest.fixture
def frame(tmp_path: Path) -> ScanOnDisk:
    return scan_on_disk(tmp_path)


def recorded(written: Written) -> dict[str, Any]:
    """The record beside what was written."""
    return dict(json.loads(written[2][0].with_suffix(".json").read_text()))


def projected(frame: ScanOnDisk, output: str = "sparse.csv", **more: Any) -> dict[str, Any]:
    files = {"scan": frame.scan, "image": frame.image, "output": frame.folder / output}
    return recorded(project_scan(**(files | {"options": ScanOptions(calib=frame.calib)} | more)))


@pytest.mark.parametrize("suffix", [".csv", *DEPTH_SUFFIXES])
def test_a_projected_scan_lands_where_it_was_made_to(frame: ScanOnDisk, suffix: str) -> None:
    record = projected(frame, f"sparse{suffix}")
    assert record["size"] == [64, 48]
    assert record["points"] == {
        "count": 150,
        "fraction_of_pixels": 150 / (64 * 48),
        "nearest": pytest.approx(frame.depth.min()),
        "farthest": pytest.approx(frame.depth.max()),
        "dropped": record["points"]["dropped"],
    }
    if suffix == ".csv":
        got = read_sparse(frame.folder / "sparse.csv", size=(60, 100))[0]
        np.testing.assert_allclose(got.xy, frame.xy, atol=1e-3)
        np.testing.assert_allclose(got.depth, frame.depth, atol=1e-4)
        return
    column, row = np.floor(frame.xy + 0.5).astype(int).T
    got = read_depth(frame.folder / f"sparse{suffix}").values
    assert np.count_nonzero(got) == 150
    np.testing.assert_allclose(got[row, column], frame.depth, atol=0.002)


def refused(frame: ScanOnDisk, error: type[PnpDepthError], message: str, **more: object) -> None:
    before = sorted(frame.folder.rglob("*"))
    with pytest.raises(error) as caught:
        projected(frame, **more)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sorted(frame.folder.rglob("*")) == before


def test_an_image_of_another_camera_is_an_error_or_gets_a_warning(frame: ScanOnDisk) -> None:
    small, wide = frame.folder / "small.png", frame.folder / "wide.png"
    Image.new("RGB", (20, 15)).save(small)
    Image.new("RGB", (128, 48)).save(wide)
    refused(frame, InputError, "small.png is 20×15, which does not contain", image=small)
    record = projected(frame, image=wide)
    assert any(note.startswith("warning: the principal point") for note in record["notes"])
    frame.calib.write_text(frame.calib.read_text() + "size: [64, 48]\n")
    refused(frame, InputError, "is 64×48", image=wide, output="b.csv")


def test_results_are_replaced_only_with_overwrite(frame: ScanOnDisk) -> None:
    projected(frame)
    refused(frame, OutputError, "exists; --overwrite")
    projected(frame, overwrite=True)
    calib = frame.folder / "calib.json"
    calib.write_text('{"K": [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}')
    into = {"output": "calib.csv", "overwrite": True, "options": ScanOptions(calib=calib)}
    refused(frame, OutputError, "calib.json is one of the inputs", **into)
    refused(frame, OutputError, frame.gt.name, output=f"{frame.gt.name}/s.png")
    refused(frame, OutputError, ".jpg", output="s.jpg")
    assert (frame.folder / "sparse_overlay.png").is_file()
    with pytest.raises(UsageError):  # options of a scan
        read_stored_sparse(frame.gt, ScanOptions(extrinsics=frame.calib))


def test_the_seed_is_in_the_record_and_decides_every_byte(frame: ScanOnDisk) -> None:
    one, other = frame.folder / "a.png", frame.folder / "b.png"
    for path in (one, other):
        record = recorded(sample_depth(frame.gt, path, SamplePattern(count=100), seed=11))
        assert record["seed"] == 11
    assert one.read_bytes() == other.read_bytes()
    written = read_depth(one)
    assert (np.count_nonzero(written.values), written.reading.scale) == (100, 256)


def test_fewer_features_than_requested_are_reported(frame: ScanOnDisk) -> None:
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[12:36, 16:48] = 255
    cv2.imwrite(str(frame.image), pixels)
    pattern = SamplePattern(kind="features", count=3000)
    record = recorded(sample_depth(frame.gt, frame.folder / "e.png", pattern, image=frame.image))
    assert record["points"]["count"] < 3000
    assert any("of the 3,000 points asked for" in note for note in record["notes"])


def test_a_simulated_sensor_of_ones_own_measures_the_truth(frame: ScanOnDisk) -> None:
    fan = {"beams": 21, "vertical_fov": (20, -20)}
    record = recorded(simulate_scan(frame.gt, frame.calib, frame.folder / "out.csv", **fan))
    got = read_sparse(frame.folder / "out.csv", size=(60, 100))[0]
    np.testing.assert_allclose(got.depth, 4 + 0.02 * got.xy[:, 0], atol=0.02)
    assert (record["sensor"]["name"], record["sensor"]["max_range"]) == ("21 beams", None)
    assert len(got.depth) > 500
